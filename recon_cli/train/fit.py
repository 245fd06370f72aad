"""The loop that fits Gaussians to views, and nothing else: no files, no terminal."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch

from recon_cli.context import ALONE, Ranks
from recon_cli.evaluation.reference_views import mean_psnr_on_device
from recon_cli.scene.train_view import TrainView
from recon_cli.train import async_trainer
from recon_cli.train.importance import Importance
from recon_cli.train.pyramid import Pyramid
from recon_cli.train.schedule import Schedule, next_iteration
from recon_cli.train.state import TrainState

_REPORT_EVERY = 100  # steps between looks at the validation views, at least
_REPORTS = 40  # of a long run; each costs a picture of every validation view


@dataclass(frozen=True)
class Report:
    """How the run stands.

    Attributes:
        iteration: steps done.
        loss: of this step.
        validation_psnr_db: mean over the validation views; None where there are none.
        gaussians: count.
        seconds: of this call, so far.
        cpu_seconds: of all threads of this process in this call, so far.
        goes_on_at: the iteration to which the run jumps now; None where it just goes on.
    """

    iteration: int
    loss: float
    validation_psnr_db: float | None
    gaussians: int
    seconds: float
    cpu_seconds: float = 0.0
    goes_on_at: int | None = None


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
        jump: (iteration, iteration at which it goes on) of the run that this one branches off;
            this one does the same.
        camera_error: how far cameras may be off, in rad; for their refinement.
        ranks: this process among those that take the steps together.
    """

    train: list[TrainView]
    validation: list[TrainView]
    schedule: Schedule
    extent: float
    backend: str
    device: torch.device
    jump: tuple[int, int] | None = None
    camera_error: float | None = None
    ranks: Ranks = ALONE

    @cached_property
    def pyramid(self) -> Pyramid:
        """The training views at every size."""
        return Pyramid(self.train, page_locked=self.device.type == "cuda")


def fit(
    state: TrainState,
    task: Task,
    until: int,
    *,
    on_step: Callable[[TrainState], None],
    on_report: Callable[[Report], None],
    importance: Importance | None = None,
    looks: Callable[[int], bool] = lambda _: True,
) -> None:
    """Runs `state` on until it has done `until` steps.

    Args:
        state: changed in place.
        task: views and plan.
        until: total number of steps, those already done included.
        on_step: called after steps at which `looks` is true, and maybe others; may save the state.
        on_report: called every hundred steps and at the end.
        importance: gets the scores of every step's view, from the very passes that train.
        looks: whether on_step must see the state after a step; the host goes ahead of a device that
            need not be waited for.

    Raises:
        TrainingError: the loss is not finite, or no Gaussian is left.
    """
    start, cpu_start = time.perf_counter(), time.process_time()
    every = report_every(task.schedule)
    advance = async_trainer.advancing(
        state, task, importance, lambda i: i == until or i % every == 0 or looks(i))
    while state.iteration < until:
        loss = advance()
        if state.iteration % every == 0 or state.iteration == until:
            psnr = validation_psnr(state, task)
            regular = state.iteration % every == 0
            goes_on_at = _goes_on_at(state, task, psnr) if regular else None
            on_report(Report(
                state.iteration, loss, psnr, len(state.splats), time.perf_counter() - start,
                time.process_time() - cpu_start, goes_on_at))
            if goes_on_at is not None:
                state.jump = state.iteration, goes_on_at
                state.iteration = goes_on_at
        on_step(state)


def _goes_on_at(state: TrainState, task: Task, psnr: float | None) -> int | None:
    """Returns the iteration to which the run jumps now, None where it just goes on."""
    if task.jump is not None:
        return task.jump[1] if state.iteration == task.jump[0] else None
    if psnr is None or not task.schedule.config.early_stop or state.jump:
        return None
    state.looks.append((state.iteration, psnr))
    return next_iteration(task.schedule, state.iteration, state.looks)


def report_every(schedule: Schedule) -> int:
    """Returns the steps between two reports, a multiple of a hundred."""
    return _REPORT_EVERY * max(1, schedule.config.iterations // (_REPORTS * _REPORT_EVERY))


def validation_psnr(state: TrainState, task: Task) -> float | None:
    """Returns the mean PSNR over the validation views in dB, None where there are none.

    Of a masked view the pixels that count are scored.
    """
    if not task.validation:
        return None
    degree = task.schedule.sh_degree(max(1, state.iteration))
    return mean_psnr_on_device(state.splats, task.validation, degree, task.backend)
