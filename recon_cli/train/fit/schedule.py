"""When things happen in a run: a recipe's shares turned into steps.

Intervals that give the optimizer time to settle (densification, the recovery from an opacity
reset) are counted in steps and have a floor; everything else scales with the run.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from recon_cli.config.protocols import STEPS, follow
from recon_cli.config.stages import RunConfig

_LAST_FIFTH = 0.8  # where a recipe names no final phase of its own
_GAIN = 0.02  # dB; the PSNR varies by .03 between reports, and the final phase gives .2 to .4
_WINDOW = 0.1  # of the run's steps, in which so much must be gained


def next_iteration(
    schedule: Schedule, iteration: int, history: list[tuple[int, float]]
) -> int | None:
    """Returns the step at which the final phase begins if the run goes there now, else None.

    It does where the best validation PSNR of the last tenth of the run is less than .02 dB above
    the best one before, once densification has ended and the state for pruning is kept. `history`
    holds (iteration, validation PSNR in dB) so far, ascending.
    """
    first, steps, recipe = schedule.first, schedule.steps, schedule.recipe
    final = first + round(min(recipe.final_from, _LAST_FIFTH) * steps)
    settled = max(first + recipe.densify_until * steps, schedule.mid)
    if not settled < iteration < final:
        return None
    since = iteration - _WINDOW * steps
    before = [psnr for at, psnr in history if at <= since]
    lately = [psnr for at, psnr in history if at > since]
    if not before or not lately or max(lately) - max(before) >= _GAIN:
        return None
    return final


@dataclass(frozen=True)
class Recipe:
    """The plan of one strategy; shares are of the run's steps."""

    densify_from: float  # share from which Gaussians are added and deleted
    densify_until: float  # share up to which
    full_at: float  # share at which the count reaches its cap
    levels: tuple[tuple[float, int], ...]  # (share, factor): reduces images up to that share
    sh_at: tuple[float, float, float]  # shares at which the degree of the colours rises by one
    sh_every: int  # the higher degrees are moved every so many steps
    opacity_decay: float  # opacities are multiplied by this at each densification
    resets: bool  # opacities are lowered to .01 now and then, as in the reference
    # Gaussians of the least error that make room for others, of all: at one densification at most,
    # and in the course of a run. The one alone would replace all of them in a long one.
    replaced_at_once: float
    replaced: float
    # of the means' rate: the extent of the cameras, or their nearness to the points
    means_unit: Literal["extent", "nearness"]
    # factors of the options of these names: short runs have to go as far as the reference's 30,000
    means_rate: float = 1.0
    means_restart_rate: float = 1.0  # of the means' rate in a continued run: they hardly move
    scales_rate: float = 1.0
    sh_rate: float = 1.0
    sh_rest_rate: float = 1.0  # of the higher degrees, each time that they are moved
    momentum: float = 0.9  # of the Gaussians' Adam: beta 1
    means_final: float = 0.01  # last rate of the means over the first; exponential between
    final_from: float = 1.0  # share from which all other rates fall
    final_rate: float = 1.0  # to which they fall at the end, of their own; exponential
    backdrop: float = 0.0  # grey level behind all Gaussians, 0 to 1


# Kerbl et al. 2023 and INRIA's defaults: 500, 15,000 and 1,000 of 30,000 iterations
REFERENCE = Recipe(
    densify_from=500 / 30_000, densify_until=0.5, full_at=0.5, levels=(),
    sh_at=(1000 / 30_000, 2000 / 30_000, 3000 / 30_000), sh_every=1, opacity_decay=1.0,
    resets=True, replaced_at_once=0.0, replaced=0.0, means_unit="extent")
BUDGET = Recipe(
    densify_from=0.03, densify_until=0.6, full_at=0.54, levels=((0.4, 2),),
    sh_at=(0.15, 0.3, 0.45), sh_every=4, opacity_decay=0.99, resets=False,
    replaced_at_once=0.03, replaced=0.4, means_unit="nearness", means_rate=7.0,
    means_restart_rate=0.7, scales_rate=4.0, sh_rate=2.0, sh_rest_rate=4.0, momentum=0.8,
    final_from=0.8, final_rate=0.1,
    backdrop=0.33)
RECIPES = {"reference": REFERENCE, "budget": BUDGET}


_RESET_FLOOR = 1000  # steps; after a reset at a rate of .05 a picture needs some hundred to return
# Steps that the falling rates must have: fewer settle nothing, and only cost what the fall takes.
# Forty steps at 96 pixels end at 14.3 dB without a fall, at 13.9 with one over the last eight.
_FALL_FLOOR = 50
_SH_EVERY = 1000  # steps of the reference between two degrees, in a run of any length


@dataclass(frozen=True)
class Schedule:
    """The plan of one run; iterations count from 1."""

    config: RunConfig  # the run's options
    own_recipe: Recipe | None = None  # in place of that of the strategy
    first: int = 0  # step after which it begins; shares are of the steps from there

    @property
    def recipe(self) -> Recipe:
        """The plan that shares are taken from."""
        return self.own_recipe or RECIPES[self.config.densify]

    @property
    def length(self) -> int:
        """Steps that intervals and shares count by: the run's, or those that a protocol names."""
        protocol = follow(self.config.protocol)
        return STEPS if protocol and protocol.whole_schedule else self.config.iterations

    @property
    def steps(self) -> int:
        """Steps from the first to the last of that length."""
        return self.length - self.first

    def share(self, iteration: int) -> float:
        """Returns how much of the run is done after a step, 0 to 1."""
        return min(1.0, (iteration - self.first) / max(1, self.steps))

    def epoch(self, views: int) -> int:
        """Returns the steps in which no view need come twice; at least one."""
        return max(1, views // self.config.batch_views)

    @property
    def reset_every(self) -> int:
        """Steps from one opacity reset to the next: 3,000 of the 30,000 of the reference."""
        return max(_RESET_FLOOR, round(self.length / 10))

    @property
    def mid(self) -> int:
        """The iteration whose state is kept for pruning."""
        mid = self.first + max(1, round(self.config.mid * self.steps))
        return mid if self.length == self.config.iterations else min(mid, self.config.iterations)

    def level(self, iteration: int) -> int:
        """Returns the factor by which images are reduced in this step."""
        before = self.share(iteration - 1)
        return next((factor for share, factor in self.recipe.levels if before < share), 1)

    def sh_degree(self, iteration: int) -> int:
        """Returns the degree in use; the reference raises it every 1,000 steps or sooner."""
        before = iteration - 1
        if self.recipe.resets:
            every = max(1, min(_SH_EVERY, self.length // 10))
            return min(self.config.sh_degree, before // every)
        return min(self.config.sh_degree,
                   sum(before >= share * self.config.iterations for share in self.recipe.sh_at))

    def means_rate(self, iteration: int) -> float:
        """Returns the learning rate of the means in units of `Task.means_unit`."""
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
                    round(self.recipe.densify_from * self.steps))
        return (self.gathers(iteration) and iteration - self.first >= start
                and iteration % self.config.densify_every == 0)

    @property
    def replaced(self) -> float:
        """Share of the Gaussians that one densification replaces by others."""
        every = self.config.densify_every
        times = sum(map(self.densifies, range(every, self.config.iterations + 1, every)))
        return min(self.recipe.replaced_at_once, self.recipe.replaced / max(1, times))

    def gathers(self, iteration: int) -> bool:
        """Tells whether densification still needs this step's gradients."""
        return iteration - self.first < self.recipe.densify_until * self.steps

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


@dataclass(frozen=True)
class ContinuedSchedule(Schedule):
    """The plan of steps after the end of another run: one of their own, from a finished model.

    Learning rates start anew, and the count grows to the cap of the whole run; images are in full
    size and colours of full degree from the first step. The longer run's plan, taken up where the
    shorter one ended, gives less: on office, 1,000 steps carried on to 2,000 end at 31.1 dB by it,
    at 31.5 dB by this one, and 2,000 in one go at 31.7 dB.
    """

    def level(self, iteration: int) -> int:  # noqa: ARG002
        """Returns 1: images are never reduced."""
        return 1

    def means_rate(self, iteration: int) -> float:
        """Returns the learning rate of the means in units of `Task.means_unit`."""
        return self.recipe.means_restart_rate * super().means_rate(iteration)

    def sh_degree(self, iteration: int) -> int:  # noqa: ARG002
        """Returns the degree in use, which is the highest."""
        return self.config.sh_degree


def make_schedule(config: RunConfig, continues_at: int | None) -> Schedule:
    """Returns the schedule of a run; `continues_at` as in plan.json, None for one that begins."""
    if continues_at is None:
        return Schedule(config)
    return ContinuedSchedule(config, first=continues_at)


@dataclass(frozen=True, kw_only=True)
class RecoverySchedule(ContinuedSchedule):
    """A recovery after pruning: steps after the end of another run in which nothing grows back."""

    until: int  # step at which it ends

    @property
    def steps(self) -> int:
        """Steps from the first to the last."""
        return self.until - self.first

    def gathers(self, iteration: int) -> bool:  # noqa: ARG002
        """Returns False: nothing grows back."""
        return False
