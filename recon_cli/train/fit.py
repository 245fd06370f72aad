"""The loop that fits Gaussians to views, and nothing else: no files, no terminal."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from recon_cli.errors import TrainingError
from recon_cli.render import render
from recon_cli.train.densify import (
    DensifyRule,
    Pull,
    densify,
    lowered_opacities,
)
from recon_cli.train.importance import Importance
from recon_cli.train.schedule import Schedule
from recon_cli.train.state import TrainState
from recon_cli.train.step import GradientStep, TrainView, gradient_step

_LARGE_SCALE = 0.1  # x extent; larger Gaussians are deleted once opacities were reset
_REPORT_EVERY = 100  # steps between looks at the validation views


@dataclass(frozen=True)
class Report:
    """How the run stands.

    Attributes:
        iteration: steps done.
        loss: of this step.
        validation_psnr_db: mean over the validation views; None where there are none.
        gaussians: count.
        seconds: of this call, so far.
    """

    iteration: int
    loss: float
    validation_psnr_db: float | None
    gaussians: int
    seconds: float


@dataclass(frozen=True, eq=False)
class Task:
    """What is fitted and by which plan.

    Attributes:
        train: views that gradients come from.
        validation: views that are only looked at.
        schedule: when things happen.
        extent: of the scene, world units.
        backend: name of the rasterizer.
        device: where the tensors live.
    """

    train: list[TrainView]
    validation: list[TrainView]
    schedule: Schedule
    extent: float
    backend: str
    device: torch.device


def fit(
    state: TrainState,
    task: Task,
    until: int,
    *,
    on_step: Callable[[TrainState], None],
    on_report: Callable[[Report], None],
    importance: Importance | None = None,
) -> None:
    """Runs `state` on until it has done `until` steps.

    Args:
        state: changed in place.
        task: views and plan.
        until: total number of steps, those already done included.
        on_step: called after each step; may save the state.
        on_report: called every hundred steps and at the end.
        importance: gets the scores of every step's view, from the very passes that train.

    Raises:
        TrainingError: the loss is not finite, or no Gaussian is left.
    """
    start = time.perf_counter()
    compute = gradient_step(task.backend)
    while state.iteration < until:
        loss = _step(state, task, compute, importance)
        if state.iteration % _REPORT_EVERY == 0 or state.iteration == until:
            on_report(Report(
                state.iteration, loss, validation_psnr(state, task), len(state.splats),
                time.perf_counter() - start))
        on_step(state)


def _step(
    state: TrainState, task: Task, compute: GradientStep, importance: Importance | None
) -> float:
    """Takes one optimization step and returns its loss."""
    if not state.queue:
        state.queue = torch.randperm(len(task.train), generator=state.generator).tolist()
    view = task.train[state.queue.pop()]
    iteration = state.iteration + 1
    degree = task.schedule.sh_degree(iteration)
    loss, statistics = compute(
        state.optimizer, view, degree, task.schedule.config.ssim_weight,
        scores=importance is not None)
    if not np.isfinite(loss):
        raise TrainingError(
            f"The loss is not finite at step {iteration}.",
            hint="Lower the learning rates, or run `recon train --again` with another --seed.")
    if statistics is not None:
        if importance is not None:
            importance.add(statistics)
        if task.schedule.gathers(iteration):
            state.pull.add(statistics, view.camera.width, view.camera.height)
        state.optimizer.step(task.schedule.means_rate(iteration), sh_rest=degree > 0)
    state.iteration = iteration
    _control_density(state, task)
    return loss


def _control_density(state: TrainState, task: Task) -> None:
    """Clones, splits, deletes and resets where the schedule says so."""
    schedule, config = task.schedule, task.schedule.config
    if schedule.densifies(state.iteration):
        large = _LARGE_SCALE * task.extent if schedule.deletes_large(state.iteration) else None
        rule = DensifyRule(
            config.densify_gradient, config.densify_scale * task.extent, config.min_opacity,
            large, config.max_gaussians)
        splats, source = densify(state.splats, state.pull, rule, state.generator)
        if len(splats) == 0:
            raise TrainingError(
                f"No Gaussian is left at step {state.iteration}.",
                hint="Lower --min-opacity, or check the cameras with another viewer.")
        state.optimizer.replace(splats, source)
        state.pull = Pull.zeros(len(splats), task.device)
    if schedule.resets(state.iteration):
        kept = torch.arange(len(state.splats), device=task.device)
        state.optimizer.replace(lowered_opacities(state.splats), kept)
        state.optimizer.forget("logit_opacities")


def validation_psnr(state: TrainState, task: Task) -> float | None:
    """Returns the mean PSNR over the validation views in dB, None where there are none.

    Of a masked view the pixels that count are scored.
    """
    if not task.validation:
        return None
    degree = task.schedule.sh_degree(max(1, state.iteration))
    values = []
    with torch.no_grad():
        for view in task.validation:
            rgb = render(state.splats, view.camera, torch.zeros(3, device=task.device), degree,
                         backend=task.backend).rgb
            errors = (rgb.clamp(0, 1) - view.pixels(task.device)).square()
            counting = view.counting(task.device)
            error = (errors if counting is None else errors[counting]).mean().item()
            values.append(-10 * np.log10(max(error, 1e-10)))
    return float(np.mean(values))
