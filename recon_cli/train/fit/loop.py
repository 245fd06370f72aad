"""The loop that fits Gaussians to views, and nothing else: no files, no terminal."""

from __future__ import annotations

import time
from collections.abc import Sequence

from recon_cli.context import TrainCallback, TrainReport
from recon_cli.evaluation.reference_views import mean_psnr_on_device
from recon_cli.train.fit.importance import Importance
from recon_cli.train.fit.schedule import Schedule, next_iteration
from recon_cli.train.fit.state import TrainState
from recon_cli.train.fit.stepper import choose_stepper
from recon_cli.train.fit.task import Task

_REPORT_EVERY = 100  # steps between reports on the validation views, at least
_REPORTS = 40  # of a long run; each costs a picture of every validation view


def fit(
    state: TrainState, task: Task, until: int, callbacks: Sequence[TrainCallback] = (),
    importance: Importance | None = None,
) -> None:
    """Trains `state` until it has done `until` steps, counting those already done.

    Callbacks are called in order; where none needs a step, the host may run ahead of the device.
    `importance` gets the scores of every step's view from the passes that train.

    Raises:
        TrainingError: the loss is not finite, or no Gaussian is left.
    """
    start, cpu_start = time.perf_counter(), time.process_time()
    every = report_every(task.schedule)
    advance = choose_stepper(state, task, importance, lambda i: (
        i == until or i % every == 0 or any(callback.needs_step(i) for callback in callbacks)))
    while state.iteration < until:
        loss = advance()
        if state.iteration % every == 0 or state.iteration == until:
            psnr = validation_psnr(state, task)
            regular = state.iteration % every == 0
            skip_to = _choose_next_iteration(state, task, psnr) if regular else None
            report = TrainReport(
                state.iteration, loss, psnr, len(state.splats), time.perf_counter() - start,
                time.process_time() - cpu_start, skip_to)
            for callback in callbacks:
                callback.on_report(report)
            if skip_to is not None:
                state.skipped_phase = state.iteration, skip_to
                state.iteration = skip_to
        for callback in callbacks:
            callback.on_step(state.iteration, state.splats)


def _choose_next_iteration(state: TrainState, task: Task, psnr: float | None) -> int | None:
    """Returns the iteration to which the run skips now, None where it just continues."""
    if psnr is None or not task.schedule.config.early_stop or state.skipped_phase:
        return None
    state.validation_history.append((state.iteration, psnr))
    return next_iteration(task.schedule, state.iteration, state.validation_history)


def report_every(schedule: Schedule) -> int:
    """Returns the steps between two reports, a multiple of a hundred."""
    return _REPORT_EVERY * max(1, schedule.config.iterations // (_REPORTS * _REPORT_EVERY))


def validation_psnr(state: TrainState, task: Task) -> float | None:
    """Returns the mean PSNR in dB of the validation views (masks applied), None without any."""
    if not task.validation:
        return None
    degree = task.schedule.sh_degree(max(1, state.iteration))
    falloffs = None if state.photometry is None else state.photometry.falloffs
    return mean_psnr_on_device(state.splats, task.validation, degree, task.backend, falloffs)
