"""The prune of an arm, as the stage does it in mid-training, and the rest of the run."""

from __future__ import annotations

import dataclasses
from typing import Protocol

from recon_cli.bench.training.arms import Prune
from recon_cli.train.fit import Task
from recon_cli.train.importance import Importance
from recon_cli.train.pruning import (
    RATIO,
    Recovery,
    remaining,
    removals,
    remove,
    rounds_within,
    scored,
    survivors,
)
from recon_cli.train.state import TrainState


class Advance(Protocol):
    """Trains a state by a task up to a step; the scores of its steps go into `importance`."""

    def __call__(self, task: Task, until: int, importance: Importance | None = None) -> None:
        """Trains."""


def prune_rest(
    state: TrainState, task: Task, prune: Prune, until: int, advance: Advance
) -> None:
    """Removes the Gaussians that matter least to the training views and trains the rest.

    Args:
        state: changed in place.
        task: views and plan of the run.
        prune: which Gaussians go.
        until: step at which the run ends.
        advance: trains the state.
    """
    config, first = prune.config, state.iteration
    recovery = until - first
    calm = task
    if prune.restarts:
        plan = Recovery(task.schedule.config, first=first, until=until)
        calm = dataclasses.replace(task, schedule=plan)
    rounds = config.rounds or rounds_within(recovery, len(task.train))
    n, ratio = len(state.splats), RATIO if config.ratio is None else config.ratio
    for removal in removals(n, remaining(n, ratio), rounds, recovery):
        score = scored(
            state, calm, first + removal.after, name=config.score, beta=config.beta,
            advance=lambda _state, to, importance: advance(calm, to, importance))
        remove(state, survivors(score, removal.count))
    advance(calm, until)
