"""When things happen in a run: the reference's 30,000 iterations scaled to any number.

Intervals that give the optimizer time to settle (densification, the recovery from an opacity
reset) are counted in steps and have a floor; everything else scales with the run.
"""

from __future__ import annotations

from dataclasses import dataclass

from recon_cli.config import DENSIFY_UNTIL, TrainConfig

_REFERENCE = 30_000  # iterations of INRIA's default run
_DENSIFY_FROM = 500
_RESET_EVERY = 3000
_SH_EVERY = 1000
_RESET_FLOOR = 1000  # steps; after a reset at a rate of .05 a picture needs some hundred to return
_FINAL_MEANS_RATE = 0.01  # of the initial one: 1.6e-4 to 1.6e-6


@dataclass(frozen=True)
class Schedule:
    """The plan of one run; iterations count from 1.

    Attributes:
        config: the run's options.
    """

    config: TrainConfig

    @property
    def scale(self) -> float:
        """Length of the run in reference runs."""
        return self.config.iterations / _REFERENCE

    @property
    def reset_every(self) -> int:
        """Steps from one opacity reset to the next."""
        return max(_RESET_FLOOR, round(_RESET_EVERY * self.scale))

    @property
    def mid(self) -> int:
        """The iteration whose state is kept for pruning."""
        return max(1, round(self.config.mid * self.config.iterations))

    def sh_degree(self, iteration: int) -> int:
        """Returns the degree in use: one more every 1,000 steps or every tenth of the run."""
        every = max(1, min(_SH_EVERY, self.config.iterations // 10))
        return min(self.config.sh_degree, (iteration - 1) // every)

    def means_rate(self, iteration: int) -> float:
        """Returns the learning rate of the means in units of the scene extent."""
        done = min(1.0, iteration / self.config.iterations)
        return float(self.config.means_rate * _FINAL_MEANS_RATE**done)

    def densifies(self, iteration: int) -> bool:
        """Tells whether Gaussians are cloned, split and deleted after this step."""
        start = max(self.config.densify_every, round(_DENSIFY_FROM * self.scale))
        return (
            start <= iteration < DENSIFY_UNTIL * self.config.iterations
            and iteration % self.config.densify_every == 0
        )

    def gathers(self, iteration: int) -> bool:
        """Tells whether densification still needs this step's gradients."""
        return iteration < DENSIFY_UNTIL * self.config.iterations

    def resets(self, iteration: int) -> bool:
        """Tells whether opacities are lowered after this step."""
        return self.gathers(iteration) and iteration % self.reset_every == 0

    def deletes_large(self, iteration: int) -> bool:
        """Tells whether Gaussians that cover too much are deleted as well."""
        return iteration > self.reset_every
