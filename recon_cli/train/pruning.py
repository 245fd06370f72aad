"""Which Gaussians go, how many when, and at what rates the others recover.

All by rank, never by a threshold: equal scores would otherwise go as a group. Scores of single
Gaussians say nothing about pairs: of two that stand in for each other both look dispensable, and
removed together they leave a hole. So the removal goes in rounds, with recovery and new scores in
between.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from recon_cli.train.densify import Pull
from recon_cli.train.schedule import Schedule
from recon_cli.train.state import TrainState

# Share of the recovery by which the last round is over; what is left mends it. docs/pruning.md
LAST_ROUND = 0.5


@dataclass(frozen=True)
class Removal:
    """One round of a plan.

    Attributes:
        after: recovery steps before it.
        count: Gaussians that stay.
    """

    after: int
    count: int


@dataclass(frozen=True)
class Recovery(Schedule):
    """A run that starts anew at `first`: its means move as far as in a run of their own.

    The rate at which training ended lets no Gaussian move into the gap that its neighbour left.

    Attributes:
        first: step at which the recovery begins.
        until: step at which it ends.
    """

    first: int
    until: int

    def means_rate(self, iteration: int) -> float:
        """Returns the learning rate of the means in units of the scene extent."""
        done = (iteration - self.first) / max(1, self.until - self.first)
        return super().means_rate(round(done * self.config.iterations))


def remaining(n: int, ratio: float) -> int:
    """Returns how many of n Gaussians stay when a share of `ratio` goes; at least one."""
    return max(1, n - int(ratio * n))


def removals(n: int, target: int, rounds: int, recovery: int) -> tuple[Removal, ...]:
    """Returns the plan that leads from n Gaussians to `target`.

    Each round removes the same share of what is there. The first one comes at once, the last one
    at LAST_ROUND of the recovery. Rounds that would remove nothing are left out.

    Args:
        n: Gaussians now.
        target: Gaussians at the end, 1 to n.
        rounds: at most this many.
        recovery: steps in all.
    """
    plan: list[Removal] = []
    for k in range(rounds):
        after = round(LAST_ROUND * recovery * k / max(1, rounds - 1))
        count = target if k == rounds - 1 else round(n * (target / n) ** ((k + 1) / rounds))
        if count < (plan[-1].count if plan else n):
            plan.append(Removal(after, count))
    return tuple(plan)


def survivors(score: Tensor, count: int) -> Tensor:
    """Returns the rows [K] of the `count` highest scores, ascending.

    Of equal scores the later rows go first. At least one row stays.
    """
    order = torch.argsort(score, descending=True, stable=True)
    return order[: max(1, count)].sort().values


def remove(state: TrainState, rows: Tensor) -> None:
    """Goes on with the Gaussians at `rows` alone; they keep their moments."""
    kept = state.splats.select(rows)
    state.optimizer.replace(kept, rows)
    state.pull = Pull.zeros(len(kept), kept.means.device)
