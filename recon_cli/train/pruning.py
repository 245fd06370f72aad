"""Which Gaussians go, how many when, and at what rates the others recover.

All by rank, never by a threshold: equal scores would otherwise go as a group. Scores of single
Gaussians say nothing about pairs: of two that stand in for each other both look dispensable, and
removed together they leave a hole. So the removal goes in rounds, with recovery and new scores in
between.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from recon_cli.scene.train_view import TrainView
from recon_cli.train.densify.statistics import Gathered
from recon_cli.train.fit import Task
from recon_cli.train.importance import Importance, add_views
from recon_cli.train.schedule import Schedule
from recon_cli.train.state import TrainState

RATIO = 0.5  # that is removed where no limit is given
# Share of the recovery by which the last round is over; what is left mends it. docs/pruning.md
LAST_ROUND = 0.5
_LEAST_ROUNDS, _MOST_ROUNDS = 3, 8  # more gained nothing. docs/pruning.md

# Trains a state up to a step; the scores of those steps go where the third argument says.
Advance = Callable[[TrainState, int, Importance | None], None]


@dataclass(frozen=True)
class Removal:
    """One round of a plan.

    Attributes:
        after: recovery steps before it.
        count: Gaussians that stay.
    """

    after: int
    count: int


@dataclass(frozen=True, kw_only=True)
class Recovery(Schedule):
    """A run of its own, but for its coarse beginning: all learning rates start anew.

    The rates at which training ended let no Gaussian move into the gap that its neighbour left.

    Attributes:
        first: step at which the recovery begins.
        until: step at which it ends.
    """

    first: int
    until: int

    def share(self, iteration: int) -> float:
        """Returns how much of the recovery is done after a step, 0 to 1."""
        return min(1.0, (iteration - self.first) / max(1, self.until - self.first))

    def level(self, iteration: int) -> int:  # noqa: ARG002
        """Returns 1: images are never reduced."""
        return 1

    def sh_degree(self, iteration: int) -> int:  # noqa: ARG002
        """Returns the degree in use, which is the highest."""
        return self.config.sh_degree

    def gathers(self, iteration: int) -> bool:  # noqa: ARG002
        """Returns False: nothing grows back."""
        return False


def remaining(n: int, ratio: float) -> int:
    """Returns how many of n Gaussians stay when a share of `ratio` goes; at least one."""
    return max(1, n - int(ratio * n))


def rounds_within(recovery: int, views: int) -> int:
    """Returns how many rounds a recovery has room for: one an epoch, 3 to 8.

    An epoch between two removals scores every view by its training steps alone.
    """
    return min(_MOST_ROUNDS, max(_LEAST_ROUNDS, int(LAST_ROUND * recovery) // max(1, views)))


def removals(n: int, target: int, rounds: int, recovery: int) -> tuple[Removal, ...]:
    """Returns the plan that leads from n Gaussians to `target`.

    Each round removes the same share of what is there. They are evenly spread up to LAST_ROUND of
    the recovery, so that training steps come before the first one and score it; a single round
    comes at once. Rounds that would remove nothing are left out.

    Args:
        n: Gaussians now.
        target: Gaussians at the end, 1 to n.
        rounds: at most this many.
        recovery: steps in all.
    """
    plan: list[Removal] = []
    for k in range(rounds):
        after = round(LAST_ROUND * recovery * (k + 1) / rounds) if rounds > 1 else 0
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
    state.gathered = Gathered.zeros(len(kept), kept.means.device)


def scored(
    state: TrainState, task: Task, until: int, *, name: str, beta: float, advance: Advance
) -> Tensor:
    """Trains up to `until` and returns the score [N] that the last epoch's own passes give.

    Every training view counts once: those that the steps at hand do not reach are rendered.

    Args:
        state: changed in place.
        task: views and plan.
        until: total number of steps.
        name: of the score.
        beta: exponent of the volume in the paper's score.
        advance: trains; it must not save the state while scores are gathered.
    """
    found = Importance.of_score(name, len(state.splats), state.splats.means.device)
    if not found.needs_views:
        advance(state, until, None)
    else:
        epoch = task.schedule.epoch(len(task.train))
        advance(state, max(state.iteration, until - epoch), None)
        left = list(range(len(task.train)))
        if state.iteration < until:
            state.queue = []  # a new epoch, in which no view comes twice
            advance(state, until, found)
            left = state.queue
        add_views(
            found, state.splats, [_as_trained(state, task, i) for i in sorted(left)],
            sh_degree=task.schedule.sh_degree(max(1, state.iteration)), backend=task.backend)
    return found.score(name, state.splats, beta=beta, generator=state.generator)


def _as_trained(state: TrainState, task: Task, index: int) -> TrainView:
    """Returns a training view with its camera as it was refined."""
    view = task.train[index]
    if state.poses is None:
        return view
    return dataclasses.replace(view, camera=state.poses.camera(index, view.camera))
