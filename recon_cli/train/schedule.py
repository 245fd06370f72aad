"""When things happen in a run: a recipe's shares turned into steps.

Intervals that give the optimizer time to settle (densification, the recovery from an opacity
reset) are counted in steps and have a floor; everything else scales with the run.
"""

from __future__ import annotations

from dataclasses import dataclass

from recon_cli.config import RunConfig
from recon_cli.train.recipe import RECIPES, Recipe

_REFERENCE = 30_000  # iterations of INRIA's default run
_RESET_EVERY = 3000
_RESET_FLOOR = 1000  # steps; after a reset at a rate of .05 a picture needs some hundred to return
# Steps that the falling rates must have: fewer settle nothing, and only cost what the fall takes.
# Forty steps at 96 pixels end at 14.3 dB without a fall, at 13.9 with one over the last eight.
_FALL_FLOOR = 50
_SH_EVERY = 1000  # steps of the reference between two degrees, in a run of any length


@dataclass(frozen=True)
class Schedule:
    """The plan of one run; iterations count from 1.

    Attributes:
        config: the run's options.
        recipe: of the strategy that the options name.
    """

    config: RunConfig
    recipe: Recipe = None  # type: ignore[assignment]  # filled in below

    def __post_init__(self) -> None:
        if self.recipe is None:
            object.__setattr__(self, "recipe", RECIPES[self.config.densify])

    def share(self, iteration: int) -> float:
        """Returns how much of the run is done after a step, 0 to 1."""
        return min(1.0, iteration / self.config.iterations)

    def epoch(self, views: int) -> int:
        """Returns the steps in which no view need come twice; at least one."""
        return max(1, views // self.config.batch_views)

    @property
    def reset_every(self) -> int:
        """Steps from one opacity reset to the next."""
        return max(_RESET_FLOOR, round(_RESET_EVERY * self.config.iterations / _REFERENCE))

    @property
    def mid(self) -> int:
        """The iteration whose state is kept for pruning."""
        return max(1, round(self.config.mid * self.config.iterations))

    @property
    def review(self) -> int:
        """The step after which Gaussians may lose their harmonics: none is added any more.

        Not after `mid`: a pruned branch must not reorder the Gaussians whose scores it gathers.
        """
        return int(self.recipe.densify_until * self.config.iterations)

    def level(self, iteration: int) -> int:
        """Returns the factor by which images are reduced in this step."""
        before = self.share(iteration - 1)
        return next((factor for share, factor in self.recipe.levels if before < share), 1)

    def sh_degree(self, iteration: int) -> int:
        """Returns the degree in use; the reference raises it every 1,000 steps or sooner."""
        before = iteration - 1
        if self.recipe.resets:
            every = max(1, min(_SH_EVERY, self.config.iterations // 10))
            return min(self.config.sh_degree, before // every)
        return min(self.config.sh_degree,
                   sum(before >= share * self.config.iterations for share in self.recipe.sh_at))

    def means_rate(self, iteration: int) -> float:
        """Returns the learning rate of the means in units of the scene extent."""
        first = self.recipe.means_rate * self.config.means_rate
        return float(first * self.recipe.means_final**self.share(iteration))

    def rate_factor(self, iteration: int) -> float:
        """Returns the factor of all other learning rates."""
        start = self.recipe.final_from
        if (1 - start) * self.config.iterations < _FALL_FLOOR:
            return 1.0
        done = max(0.0, (self.share(iteration) - start) / (1 - start))
        return float(self.recipe.final_rate**done)

    def moves_sh(self, iteration: int) -> bool:
        """Tells whether the higher degrees are moved in this step."""
        return self.sh_degree(iteration) > 0 and iteration % self.recipe.sh_every == 0

    def densifies(self, iteration: int) -> bool:
        """Tells whether Gaussians are added and deleted after this step."""
        start = max(self.config.densify_every,
                    round(self.recipe.densify_from * self.config.iterations))
        return (self.gathers(iteration) and iteration >= start
                and iteration % self.config.densify_every == 0)

    def gathers(self, iteration: int) -> bool:
        """Tells whether densification still needs this step's gradients."""
        return iteration < self.recipe.densify_until * self.config.iterations

    def target(self, iteration: int, first: int) -> int:
        """Returns the count that a budget allows after this step, from `first` up to the cap."""
        start, full = self.recipe.densify_from, self.recipe.full_at
        done = min(1.0, max(0.0, (self.share(iteration) - start) / (full - start)))
        most = self.config.max_gaussians
        return min(most, first + int((most - first) * done))

    def resets(self, iteration: int) -> bool:
        """Tells whether opacities are lowered after this step."""
        return (self.recipe.resets and self.gathers(iteration)
                and iteration % self.reset_every == 0)

    def deletes_large(self, iteration: int) -> bool:
        """Tells whether Gaussians that cover too much are deleted as well."""
        return self.recipe.resets and iteration > self.reset_every
