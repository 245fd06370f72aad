"""One optimization step: some views' gradients, their mean, and its effects.

On a device the host starts steps without waiting for the one before to end. They synchronize at
each densification, each report, and whenever a callback reads the state. The device records
failures in between: a loss that was not finite moved nothing, and a step without room in the
buffers stopped itself and all that follow. Those are rolled back and taken again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from torch import Tensor

from recon_cli.errors import TrainingError, name_command
from recon_cli.render import Statistics
from recon_cli.render.contract import StepOptions
from recon_cli.render.response import ResponseGradient
from recon_cli.scene.statistics import at_least
from recon_cli.scene.train_view import TrainView
from recon_cli.train.fit.densification import STRATEGIES, Strategy
from recon_cli.train.fit.gradient import DeferredStep, gradient_step
from recon_cli.train.fit.importance import Importance
from recon_cli.train.fit.schedule import Schedule
from recon_cli.train.fit.state import DensificationStats, TrainState
from recon_cli.train.fit.task import Task
from recon_cli.train.parts.table import step_options

_SKIPPED = (5, 0.02)  # steps that may come to nothing: at least, and of the run's
_FARTHEST = 100  # steps between two meetings, so that Ctrl-C and a progress bar need not wait


@dataclass(frozen=True)
class _StepPlan:
    """What the schedule asks of one step."""

    options: StepOptions
    gathers: bool  # statistics for densification
    level: int  # by which images are reduced
    means_rate: float
    factor: float  # of all other rates

    @staticmethod
    def from_schedule(
        schedule: Schedule, iteration: int, strategy: Strategy,
        importance: Importance | None = None,
    ) -> _StepPlan:
        """Returns the plan of an iteration; `importance` gets the scores of its views."""
        gathers = schedule.gathers(iteration)
        options = StepOptions(
            schedule.sh_degree(iteration), schedule.config.ssim_weight,
            details=gathers and strategy.variance,
            scores=importance is not None and importance.weighs,
            loo=importance is not None and importance.leaves_out,
            harmonics=schedule.moves_sh(iteration), **step_options(schedule, iteration))
        return _StepPlan(options, gathers, schedule.level(iteration),
                         schedule.means_rate(iteration), schedule.rate_factor(iteration))


class _MeanGradient:
    """The views of one step taken together: their mean gradient, and what densification needs."""

    def __init__(self, state: TrainState, plan: _StepPlan, views: int, *, variance: bool) -> None:
        self._state, self._plan, self._views, self._variance = state, plan, views, variance
        # added in a sum of its own: one by one would round otherwise
        self._gathered = state.gathered if views == 1 else DensificationStats.zeros(
            len(state.splats), state.splats.means.device)

    def add(self, statistics: Statistics, view: TrainView) -> None:
        """Adds a view, whose gradients are those of the optimizer."""
        if self._plan.gathers and (view.depth is None or not self._plan.options.depth_weight):
            self._gathered.add(
                statistics, view.camera.width, view.camera.height, variance=self._variance)
        if self._views > 1:
            self._state.optimizer.accumulate(
                1 / self._views, sh_rest=self._plan.options.harmonics)

    def leave(self, share: Tensor | None = None) -> None:
        """Leaves the mean in the optimizer, and a share of the statistics in the state."""
        if self._views == 1:
            return
        self._state.optimizer.take_accumulated(sh_rest=self._plan.options.harmonics)
        if self._plan.gathers:
            self._state.gathered.join(
                self._gathered if share is None else self._gathered.times(share))


class Stepper:
    """Takes the steps of a call of `fit.fit`; `importance` gets the scores of their views."""

    def __init__(
        self, state: TrainState, task: Task, importance: Importance | None = None
    ) -> None:
        self._state, self._task, self._importance = state, task, importance
        self._compute = gradient_step(task.backend, task.device)
        self._strategy = STRATEGIES[task.schedule.config.densify]

    def step(self) -> float:
        """Takes a step and returns its loss, the mean over its views.

        Raises:
            TrainingError: too many losses were not finite, or no Gaussian is left.
        """
        state, task = self._state, self._task
        count = task.schedule.config.batch_views
        plan = self._plan(state.iteration + 1)
        batch = [next_view(state, task) for _ in range(count)]
        mean = _MeanGradient(state, plan, count, variance=self._strategy.variance)
        losses, responses = np.zeros(count), dict[int, ResponseGradient | None]()
        for place, index in enumerate(batch):
            view = task.pyramid.view(index, plan.level)
            response = None if state.photometry is None else state.photometry.response(index)
            losses[place], statistics = self._compute(
                state.optimizer, view, plan.options, response)
            if statistics is None or not np.isfinite(losses[place]):
                continue  # not a part of the step
            responses[place] = None if response is None else self._compute.response_gradient
            if self._importance is not None:
                self._importance.add(statistics)
            mean.add(statistics, view)
        mean.leave()
        state.iteration += 1
        loss = float(losses.mean())
        if not np.isfinite(loss):
            state.optimizer.discard()
            skip(state, task)
            return loss
        for place, gradient in responses.items():
            if state.photometry is not None and gradient is not None:
                state.photometry.step(
                    batch[place], gradient, task.schedule.share(state.iteration))
        if responses:
            self._move(plan)
        self._strategy.control(state, task)
        return loss

    def _plan(self, iteration: int) -> _StepPlan:
        return _StepPlan.from_schedule(
            self._task.schedule, iteration, self._strategy, self._importance)

    def _move(self, plan: _StepPlan, counted: Tensor | None = None) -> None:
        """Moves the Gaussians against their gradients."""
        self._state.optimizer.step(
            plan.means_rate, sh_rest=plan.options.harmonics, factor=plan.factor, counted=counted)


@dataclass(frozen=True, eq=False)
class _Before:
    """The host's state before a step."""

    iteration: int  # steps done
    queue: list[int]  # views to come
    generator: torch.Tensor  # state of the source of random choices


class AsyncStepper(Stepper):
    """Takes the steps of one call of `fit.fit` ahead of the device."""

    def __init__(self, state: TrainState, task: Task, needs: Callable[[int], bool]) -> None:
        super().__init__(state, task)
        self._needs = needs
        self._deferred = cast(DeferredStep, self._compute)
        self._trail: list[_Before] = []
        like = self._deferred.status.numbers
        # of several views: losses of this step, and steps that came to nothing
        self._loss, self._skipped = like.new_zeros(()), like.new_zeros(())

    def step(self) -> float:
        """Takes steps up to the next at which the host is needed, and returns its loss.

        Raises:
            TrainingError: too many losses were not finite, or no Gaussian is left.
        """
        state, task = self._state, self._task
        while True:
            self._start()
            if not self._meets(state.iteration):
                continue
            loss, skipped, happened = self._close()
            if happened is not None:
                self._rollback(happened)
            self._trail.clear()
            skip(state, task, skipped)
            if happened is not None:
                continue
            if np.isfinite(loss):  # as on the host
                self._strategy.control(state, task)
            return loss

    def _start(self) -> None:
        """Starts one step."""
        state, task = self._state, self._task
        self._trail.append(_Before(state.iteration, list(state.queue), state.generator.get_state()))
        plan, count = self._plan(state.iteration + 1), task.schedule.config.batch_views
        mean = _MeanGradient(state, plan, count, variance=self._strategy.variance)
        status = self._deferred.status
        seen: Tensor | None = None
        before = status.skipped.clone() if count > 1 else None
        if count > 1:
            self._loss.zero_()
        for _ in range(count):
            view = task.pyramid.view(next_view(state, task), plan.level)
            mean.add(self._deferred.start(state.optimizer, view, plan.options), view)
            if count > 1:
                counted = self._deferred.counted
                seen = counted.clone() if seen is None else seen | counted
                self._loss += status.loss
        if before is None or seen is None:
            self._move(plan, self._deferred.counted)
        else:
            going, sound = status.going, status.skipped == before
            mean.leave(going)  # of a step that is taken again nothing may stay
            self._skipped += going & ~sound
            self._move(plan, seen * (going & sound))
        state.iteration += 1

    def _meets(self, iteration: int) -> bool:
        schedule = self._task.schedule
        return (self._needs(iteration) or len(self._trail) >= _FARTHEST
                or schedule.densifies(iteration) or schedule.resets(iteration))

    def _close(self) -> tuple[float, int, int | None]:
        """Waits; returns the loss, skipped steps, and steps before a stop (None without one)."""
        report, views = self._deferred.close(), self._task.schedule.config.batch_views
        happened = None if report.stopped is None else report.stopped // views
        if views == 1:
            return report.loss, report.skipped, happened
        loss, skipped = torch.stack([self._loss / views, self._skipped]).tolist()
        self._skipped.zero_()
        return loss, int(skipped), happened

    def _rollback(self, happened: int) -> None:
        """Returns to the state after the first steps of the trail; the others changed nothing."""
        before = self._trail[happened]
        self._state.iteration, self._state.queue = before.iteration, before.queue
        self._state.generator.set_state(before.generator)


def choose_stepper(
    state: TrainState, task: Task, importance: Importance | None, needs: Callable[[int], bool]
) -> Callable[[], float]:
    """Returns a function that takes one step or several and returns the loss of the last one.

    `needs` tells whether somebody wants to see the state after a step.
    """
    plain = importance is None and state.photometry is None
    if task.backend == "triton" and plain:
        return AsyncStepper(state, task, needs).step
    return Stepper(state, task, importance).step


def next_view(state: TrainState, task: Task) -> int:
    """Returns the view whose turn it is; every epoch has an order of its own."""
    while not state.queue:
        state.queue = torch.randperm(len(task.train), generator=state.generator).tolist()
    return state.queue.pop()


def skip(state: TrainState, task: Task, steps: int = 1) -> None:
    """Counts steps whose loss is not finite; raises TrainingError where there were too many."""
    state.skipped += steps
    most = int(at_least(_SKIPPED, task.schedule.config.iterations))
    if state.skipped > most:
        raise TrainingError(
            f"The loss is not finite at step {state.iteration}, as at {state.skipped - 1} steps "
            f"before it; at most {most} are allowed.",
            hint=f"Lower the learning rates, or run {name_command('train --again')} with another "
            "--seed.")
