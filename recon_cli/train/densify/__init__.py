"""Densification strategies behind one interface: what happens to the count after a step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from recon_cli.errors import TrainingError
from recon_cli.scene.splats import Splats
from recon_cli.train.densification_stats import DensificationStats
from recon_cli.train.densify import budget, reference
from recon_cli.train.state import TrainState
from recon_cli.train.task import Task

_LARGE_SCALE = 0.1  # x extent; larger Gaussians are deleted once opacities were reset


@dataclass(frozen=True)
class Strategy:
    """How the count changes during a run.

    Attributes:
        control: called after each step; adds and deletes Gaussians when the schedule says so.
        variance: it needs the variance of the gradient over each Gaussian's pixels.
    """

    control: Callable[[TrainState, Task], None]
    variance: bool = False


def replaced(state: TrainState, splats: Splats, source: torch.Tensor) -> None:
    """Goes on with other Gaussians; `source` as in `SplatOptimizer.replace`.

    Raises:
        TrainingError: none is left.
    """
    if len(splats) == 0:
        raise TrainingError(
            f"No Gaussian is left at step {state.iteration}.",
            hint="Lower --min-opacity, or check the cameras with another viewer.")
    state.optimizer.replace(splats, source)
    state.gathered = DensificationStats.zeros(len(splats), splats.means.device)


def _reference(state: TrainState, task: Task) -> None:
    """Clones, splits, deletes and resets (Kerbl et al. 2023, section 5)."""
    schedule, config = task.schedule, task.schedule.config
    if schedule.densifies(state.iteration):
        large = _LARGE_SCALE * task.extent if schedule.deletes_large(state.iteration) else None
        rule = reference.DensifyRule(
            config.densify_gradient, config.densify_scale * task.extent, config.min_opacity,
            large, config.max_gaussians)
        replaced(state, *reference.densify(state.splats, state.gathered, rule, state.generator))
    if schedule.resets(state.iteration):
        kept = torch.arange(len(state.splats), device=task.device)
        state.optimizer.replace(reference.lowered_opacities(state.splats), kept)
        state.optimizer.forget("logit_opacities")


def _budget(state: TrainState, task: Task) -> None:
    """Splits where the error is, up to the count that the schedule allows."""
    schedule = task.schedule
    if schedule.densifies(state.iteration):
        rule = budget.BudgetRule(
            schedule.target(state.iteration, state.first_count), schedule.config.min_opacity,
            schedule.recipe.opacity_decay)
        replaced(state, *budget.densify(
            state.splats, state.gathered.variance, rule, state.generator))


STRATEGIES = {
    "reference": Strategy(_reference),
    "budget": Strategy(_budget, variance=True),
}
