"""Pruning in rounds: which Gaussians go, how many when, and the loop that removes and fine-tunes.

Gaussians are removed by rank, because a threshold would remove equal scores as a group. Two that
stand in for each other both score low, and removing both leaves a hole: each round removes a part,
and the next one scores what has recovered. `prune_run` keeps the progress on disk.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from recon_cli.context import TrainCallback
from recon_cli.train.fit.densification import replace_splats
from recon_cli.train.fit.importance import Importance, add_views
from recon_cli.train.fit.loop import fit
from recon_cli.train.fit.state import TrainState
from recon_cli.train.fit.task import Task

RATIO = 0.5  # that is removed where no limit is given
# Share of the recovery by which the last round is over; what is left mends it. docs/pruning.md
LAST_ROUND = 0.5
ROUND_COUNTS = (3, 8)  # least and most, which gained as much as more. docs/pruning.md


@dataclass(frozen=True)
class Removal:
    """One round of a plan."""

    after: int  # recovery steps before it
    count: int  # Gaussians that stay


def remaining(n: int, ratio: float) -> int:
    """Returns how many of n Gaussians stay when a share of `ratio` goes; at least one."""
    return max(1, n - int(ratio * n))


def rounds_within(recovery: int, views: int) -> int:
    """Returns how many rounds (3 to 8) a recovery has room for: one for each epoch."""
    return min(ROUND_COUNTS[1], max(ROUND_COUNTS[0], int(LAST_ROUND * recovery) // max(1, views)))


def plan_removals(n: int, target: int, rounds: int, recovery: int) -> tuple[Removal, ...]:
    """Returns the rounds that lead from n Gaussians to `target`, each removing the same share.

    They are evenly spread up to LAST_ROUND of the recovery; a single round comes at once. Rounds
    that would remove nothing are left out.
    """
    plan: list[Removal] = []
    for k in range(rounds):
        after = round(LAST_ROUND * recovery * (k + 1) / rounds) if rounds > 1 else 0
        count = target if k == rounds - 1 else round(n * (target / n) ** ((k + 1) / rounds))
        if count < (plan[-1].count if plan else n):
            plan.append(Removal(after, count))
    return tuple(plan)


def survivors(score: Tensor, count: int) -> Tensor:
    """Returns the rows [K] of the `count` highest scores, ascending; of equals the first rows."""
    order = torch.argsort(score, descending=True, stable=True)
    return order[: max(1, count)].sort().values


def remove(state: TrainState, rows: Tensor) -> None:
    """Keeps only the Gaussians at `rows`, with their moments."""
    replace_splats(state, state.splats.select(rows), rows)


class PruneRun:
    """Prunes a model in memory in rounds; `score` and `beta` are those of `Importance.score`."""

    def __init__(
        self, state: TrainState, task: Task, first: int, until: int, *, rounds: int,
        score: str = "loo", beta: float = 0.1, callbacks: Sequence[TrainCallback] = (),
    ) -> None:
        self.state, self.task, self.first, self.until = state, task, first, until
        self.rounds, self.callbacks = rounds, callbacks
        self._score, self._beta = score, beta
        self.count_before = len(state.splats)  # the first removal
        self.removals_done = 0

    def advance(self, until: int, importance: Importance | None = None) -> None:
        """Trains up to a step; `importance` gets the scores of these steps."""
        fit(self.state, self.task, until, self.callbacks, importance)

    def score(self, until: int) -> Tensor:
        """Trains up to a step and returns the score [N] from one pass over each training view."""
        state, task = self.state, self.task
        device = state.splats.means.device
        importance = Importance.of_score(self._score, len(state.splats), device)
        if not importance.needs_views:
            self.advance(until)
        else:
            epoch = task.schedule.epoch(len(task.train))
            self.advance(max(state.iteration, until - epoch))
            unseen = list(range(len(task.train)))
            if state.iteration < until:
                state.queue = []  # a new epoch, in which no view comes twice
                self.advance(until, importance)
                unseen = state.queue
            add_views(
                importance, state.splats, [task.train[i] for i in sorted(unseen)],
                sh_degree=task.schedule.sh_degree(max(1, state.iteration)), backend=task.backend)
        return importance.score(
            self._score, state.splats, beta=self._beta, generator=state.generator)

    def remove(self, score: Tensor, count: int) -> None:
        """Removes all but the `count` Gaussians of the highest scores."""
        remove(self.state, survivors(score, count))
        self.removals_done += 1


def prune_loop(run: PruneRun, target: int) -> None:
    """Removes all but `target` Gaussians in the rounds that are left, and trains to the end."""
    n = run.count_before
    plan = plan_removals(n, min(n, target), run.rounds, run.until - run.first)
    for removal in plan[run.removals_done:]:
        run.remove(run.score(run.first + removal.after), removal.count)
    run.advance(run.until)
