"""One optimization step: some views' gradients, their mean, and its effects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from recon_cli.errors import TrainingError
from recon_cli.render import Statistics
from recon_cli.render.contract import StepOptions
from recon_cli.render.response import ResponseGradient
from recon_cli.scene.train_view import TrainView
from recon_cli.train.densification import STRATEGIES
from recon_cli.train.gradient import gradient_step
from recon_cli.train.importance import Importance
from recon_cli.train.state import DensificationStats, TrainState
from recon_cli.train.task import Task

_SKIPPED = 0.02  # share of the run's steps that may come to nothing
_SKIPPED_FLOOR = 5


@dataclass(frozen=True, eq=False)
class _BatchResult:
    """Of the B views of a step, all but the gradients of the Gaussians."""

    loss: NDArray[np.float64]  # [B]
    visible: NDArray[np.float64]  # [B] 1 where the view saw a Gaussian
    response: list[ResponseGradient | None]  # by the camera's response; None where it has none

    @staticmethod
    def zeros(views: int) -> _BatchResult:
        """Returns the result of no view."""
        return _BatchResult(np.zeros(views), np.zeros(views), [None] * views)


class Stepper:
    """Takes the steps of a call of `fit.fit`; `importance` gets the scores of their views."""

    def __init__(self, state: TrainState, task: Task, importance: Importance | None) -> None:
        self._state, self._task, self._importance = state, task, importance
        self._compute = gradient_step(task.backend, task.device)
        self._strategy = STRATEGIES[task.schedule.config.densify]

    def step(self) -> float:
        """Takes a step and returns its loss, the mean over its views.

        Raises:
            TrainingError: too many losses were not finite, or no Gaussian is left.
        """
        state, task = self._state, self._task
        iteration = state.iteration + 1
        batch = [next_view(state, task) for _ in range(task.schedule.config.batch_views)]
        result = self._gather(batch, iteration)
        state.iteration = iteration
        loss = float(result.loss.mean())
        if not np.isfinite(loss):
            state.optimizer.discard()
            skip(state, task)
            return loss
        if result.visible.any():
            self._move(batch, result, iteration)
        self._strategy.control(state, task)
        return loss

    def _gather(self, batch: list[int], iteration: int) -> _BatchResult:
        """Looks at the views and leaves their mean gradient."""
        state, task = self._state, self._task
        moves_sh = task.schedule.moves_sh(iteration)
        result, gathers = _BatchResult.zeros(len(batch)), task.schedule.gathers(iteration)
        several = len(batch) > 1
        # added in a sum of its own: one by one would round otherwise
        gathered = state.gathered if not several else DensificationStats.zeros(
            len(state.splats), task.device)
        for place, index in enumerate(batch):
            view = task.pyramid.view(index, task.schedule.level(iteration))
            statistics = self._look(view, index, place, result, iteration)
            if statistics is None:
                continue
            if gathers and (view.depth is None or not task.schedule.depth_weight(iteration)):
                gathered.add(
                    statistics, view.camera.width, view.camera.height,
                    variance=self._strategy.variance)
            if several:
                state.optimizer.accumulate(1 / len(batch), sh_rest=moves_sh)
        if several:
            state.optimizer.take_accumulated(sh_rest=moves_sh)
            if gathers:
                state.gathered.join(gathered)
        return result

    def _look(
        self, view: TrainView, index: int, place: int, result: _BatchResult, iteration: int
    ) -> Statistics | None:
        """Leaves the gradients of one view; None where they are not part of the step."""
        state, importance = self._state, self._importance
        schedule = self._task.schedule
        degree = schedule.sh_degree(iteration)
        options = StepOptions(
            degree, schedule.config.ssim_weight,
            details=schedule.gathers(iteration) and self._strategy.variance,
            scores=importance is not None and importance.weighs,
            loo=importance is not None and importance.leaves_out,
            harmonics=schedule.moves_sh(iteration), depth_weight=schedule.depth_weight(iteration))
        response = None if state.photometry is None else state.photometry.response(index)
        result.loss[place], statistics = self._compute(state.optimizer, view, options, response)
        if statistics is None or not np.isfinite(result.loss[place]):
            return None
        result.visible[place] = 1
        if importance is not None:
            importance.add(statistics)
        if response is not None:
            result.response[place] = self._compute.response_gradient
        return statistics

    def _move(self, batch: list[int], result: _BatchResult, iteration: int) -> None:
        """Moves all parameters against their gradients."""
        state, schedule = self._state, self._task.schedule
        for place, index in enumerate(batch):
            if not result.visible[place]:
                continue
            gradient = result.response[place]
            if state.photometry is not None and gradient is not None:
                state.photometry.step(index, gradient, schedule.share(iteration))
        state.optimizer.step(
            schedule.means_rate(iteration), sh_rest=schedule.moves_sh(iteration),
            factor=schedule.rate_factor(iteration))


def next_view(state: TrainState, task: Task) -> int:
    """Returns the view whose turn it is; every epoch has an order of its own."""
    while not state.queue:
        state.queue = torch.randperm(len(task.train), generator=state.generator).tolist()
    return state.queue.pop()


def skip(state: TrainState, task: Task, steps: int = 1) -> None:
    """Counts steps whose loss is not finite; raises TrainingError where there were too many."""
    state.skipped += steps
    most = max(_SKIPPED_FLOOR, int(_SKIPPED * task.schedule.config.iterations))
    if state.skipped > most:
        raise TrainingError(
            f"The loss is not finite at step {state.iteration}, as at {state.skipped - 1} steps "
            f"before it; at most {most} are allowed.",
            hint="Lower the learning rates, or run `recon train --again` with another --seed.")
