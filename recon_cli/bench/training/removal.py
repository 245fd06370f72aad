"""The prune of an arm, as the stage does it in mid-training, and the rest of the run."""

from __future__ import annotations

from collections.abc import Callable

import torch

from recon_cli.bench.training.arms import Prune
from recon_cli.train.fit import Task
from recon_cli.train.gathered import Gathered
from recon_cli.train.importance import kept_rows, significance
from recon_cli.train.state import TrainState


def prune_rest(
    state: TrainState, task: Task, prune: Prune, until: int, advance: Callable[[Task, int], None]
) -> None:
    """Removes the Gaussians that matter least to the training views and trains the rest.

    Args:
        state: changed in place.
        task: views and plan of the run.
        prune: which Gaussians go.
        until: step at which the run ends.
        advance: trains the state by a task up to a step.
    """
    config = prune.config
    score = significance(
        config.score, state.splats, [view.camera for view in task.train], beta=config.beta,
        sh_degree=task.schedule.sh_degree(max(1, state.iteration)), backend=task.backend,
        generator=state.generator)
    rows = kept_rows(score, config.ratio)
    state.optimizer.replace(state.splats.select(rows), rows)
    state.gathered = Gathered.zeros(len(rows), torch.device(task.device))
    advance(task, until)
