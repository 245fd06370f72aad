"""Steps that the host starts on a device without waiting for the one before to end.

They synchronize at each densification, each report, and whenever a callback reads the state. The
device records failures in between: a loss that was not finite moved nothing, and a step without
room in the buffers stopped itself and all that follow. Those are rolled back and taken again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from torch import Tensor

from recon_cli.render import Statistics
from recon_cli.render.contract import StepOptions
from recon_cli.scene.camera import Camera
from recon_cli.train.densification import STRATEGIES
from recon_cli.train.gradient import DeferredStep, gradient_step
from recon_cli.train.importance import Importance
from recon_cli.train.state import DensificationStats, TrainState
from recon_cli.train.stepper import Stepper, next_view, skip
from recon_cli.train.task import Task

_FARTHEST = 100  # steps between two meetings, so that Ctrl-C and a progress bar need not wait


@dataclass(frozen=True, eq=False)
class _Before:
    """The host's state before a step."""

    iteration: int  # steps done
    queue: list[int]  # views to come
    generator: torch.Tensor  # state of the source of random choices


def choose_trainer(
    state: TrainState, task: Task, importance: Importance | None, looks: Callable[[int], bool]
) -> Callable[[], float]:
    """Returns a function that takes one step or several and returns the loss of the last one.

    `looks` tells whether somebody wants to see the state after a step.
    """
    plain = importance is None and state.photometry is None
    if task.backend == "triton" and plain:
        return AsyncTrainer(state, task, looks).advance
    return Stepper(state, task, importance).step


class AsyncTrainer:
    """Takes the steps of one call of `fit.fit` ahead of the device."""

    def __init__(self, state: TrainState, task: Task, looks: Callable[[int], bool]) -> None:
        self._state, self._task, self._looks = state, task, looks
        self._compute = cast(DeferredStep, gradient_step(task.backend, task.device))
        self._strategy = STRATEGIES[task.schedule.config.densify]
        self._trail: list[_Before] = []
        self._batch = _Batch(
            self._compute, task.schedule.config.batch_views, variance=self._strategy.variance)

    def advance(self) -> float:
        """Takes steps up to the next at which the host is needed, and returns its loss.

        Raises:
            TrainingError: too many losses were not finite, or no Gaussian is left.
        """
        state, task = self._state, self._task
        while True:
            self._start()
            if not self._meets(state.iteration):
                continue
            loss, skipped, happened = self._batch.close()
            if happened is not None:
                self._rollback(happened)
            self._trail.clear()
            skip(state, task, skipped)
            if happened is not None:
                continue
            if np.isfinite(loss):  # as in `Stepper.step`
                self._strategy.control(state, task)
            return loss

    def _start(self) -> None:
        """Starts one step."""
        state, schedule = self._state, self._task.schedule
        self._trail.append(_Before(state.iteration, list(state.queue), state.generator.get_state()))
        iteration = state.iteration + 1
        gathers, moves_sh = schedule.gathers(iteration), schedule.moves_sh(iteration)
        options = StepOptions(
            schedule.sh_degree(iteration), schedule.config.ssim_weight,
            details=gathers and self._strategy.variance, harmonics=moves_sh,
            depth_weight=schedule.depth_weight(iteration))
        self._batch.begin(state)
        for _ in range(schedule.config.batch_views):
            view = self._task.pyramid.view(next_view(state, self._task), schedule.level(iteration))
            statistics = self._compute.start(state.optimizer, view, options)
            plain = view.depth is None or not options.depth_weight
            self._batch.add(state, statistics if gathers and plain else None, view.camera,
                            moves_sh=moves_sh)
        counted = self._batch.end(state, gathers=gathers, moves_sh=moves_sh)
        state.optimizer.step(
            schedule.means_rate(iteration), sh_rest=moves_sh,
            factor=schedule.rate_factor(iteration), counted=counted)
        state.iteration = iteration

    def _meets(self, iteration: int) -> bool:
        schedule = self._task.schedule
        return (self._looks(iteration) or len(self._trail) >= _FARTHEST
                or schedule.densifies(iteration) or schedule.resets(iteration))

    def _rollback(self, happened: int) -> None:
        """Returns to the state after the first steps of the trail; the others changed nothing."""
        before = self._trail[happened]
        self._state.iteration, self._state.queue = before.iteration, before.queue
        self._state.generator.set_state(before.generator)


class _Batch:
    """The views of one step taken together on the device, as `Stepper` does on the host."""

    def __init__(self, compute: DeferredStep, views: int, *, variance: bool) -> None:
        self._compute, self._views, self._variance = compute, views, variance
        like = compute.status.numbers
        # of several views: losses of this step, and steps that came to nothing
        self._loss, self._skipped = like.new_zeros(()), like.new_zeros(())

    def begin(self, state: TrainState) -> None:
        """Begins a step."""
        if self._views == 1:
            return
        self._gathered = DensificationStats.zeros(len(state.splats), state.splats.means.device)
        self._seen = torch.zeros_like(self._compute.counted)
        self._before = self._compute.status.skipped.clone()
        self._loss.zero_()

    def add(
        self, state: TrainState, statistics: Statistics | None, camera: Camera, *, moves_sh: bool
    ) -> None:
        """Adds one view; `statistics` are None where densification needs none."""
        several = self._views > 1
        if statistics is not None:
            gathered = self._gathered if several else state.gathered
            gathered.add(statistics, camera.width, camera.height, variance=self._variance)
        if several:
            state.optimizer.accumulate(1 / self._views, sh_rest=moves_sh)
            self._seen |= self._compute.counted
            self._loss += self._compute.status.loss

    def end(self, state: TrainState, *, gathers: bool, moves_sh: bool) -> Tensor:
        """Leaves the mean gradient, and returns [1] int32 whether the step counts."""
        if self._views == 1:
            return self._compute.counted
        status = self._compute.status
        going, sound = status.going, status.skipped == self._before
        state.optimizer.take_accumulated(sh_rest=moves_sh)
        if gathers:  # of a step that is taken again nothing may stay
            state.gathered.join(self._gathered.times(going))
        self._skipped += going & ~sound
        return self._seen * (going & sound)

    def close(self) -> tuple[float, int, int | None]:
        """Waits; returns the loss, skipped steps, and steps before a stop (None without one)."""
        report = self._compute.close()
        happened = None if report.stopped is None else report.stopped // self._views
        if self._views == 1:
            return report.loss, report.skipped, happened
        loss, skipped = torch.stack([self._loss / self._views, self._skipped]).tolist()
        self._skipped.zero_()
        return loss, int(skipped), happened
