"""Steps that the host starts on a device without waiting for the one before to end.

Host and device meet where something must be decided: at each densification, each report, and
whenever somebody wants to see the state. What went wrong in between the device has written down:
a loss that was not finite moved nothing, and a step that its buffers had no room for stopped it and
all that follow. Those are taken back here and taken again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import numpy as np
import torch

from recon_cli.train.importance import Importance
from recon_cli.train.state import TrainState
from recon_cli.train.step import DeferredStep, gradient_step
from recon_cli.train.stepping import Stepper, control, next_view, skip
from recon_cli.train.strategies import STRATEGIES

if TYPE_CHECKING:
    from recon_cli.train.fit import Task

_FARTHEST = 100  # steps between two meetings, so that Ctrl-C and a progress bar need not wait


@dataclass(frozen=True, eq=False)
class _Before:
    """What the host knew before a step.

    Attributes:
        iteration: steps done.
        queue: views to come.
        generator: state of the source of random choices.
    """

    iteration: int
    queue: list[int]
    generator: torch.Tensor


def advancing(
    state: TrainState, task: Task, importance: Importance | None, looks: Callable[[int], bool]
) -> Callable[[], float]:
    """Returns a function that takes a step or several and returns the loss of the last one.

    Args:
        state: changed in place.
        task: views and plan.
        importance: as in `Stepper`.
        looks: whether somebody wants to see the state after a step.
    """
    alone = task.ranks.alone and task.schedule.config.batch_views == 1
    plain = importance is None and state.exposure is None and state.poses is None
    quiet = not STRATEGIES[task.schedule.config.densify].each_step
    if task.backend == "triton" and alone and plain and quiet:
        return Ahead(state, task, looks).advance
    return Stepper(state, task, importance).step


class Ahead:
    """Takes the steps of one call of `fit.fit`, one view each, ahead of the device.

    Args:
        state: changed in place.
        task: views and plan.
        looks: whether somebody wants to see the state after a step.
    """

    def __init__(self, state: TrainState, task: Task, looks: Callable[[int], bool]) -> None:
        self._state, self._task, self._looks = state, task, looks
        self._compute = cast(DeferredStep, gradient_step(task.backend, task.device))
        self._variance = STRATEGIES[task.schedule.config.densify].variance
        self._trail: list[_Before] = []

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
            account = self._compute.close()
            if account.stopped is not None:
                self._take_back(account.stopped)
            self._trail.clear()
            skip(state, task, account.skipped)
            if account.stopped is not None:
                continue
            if np.isfinite(account.loss):  # as in `Stepper.step`
                control(state, task)
            return account.loss

    def _start(self) -> None:
        """Starts one step."""
        state, schedule = self._state, self._task.schedule
        self._trail.append(_Before(
            state.iteration, list(state.queue), state.generator.get_state()))
        iteration = state.iteration + 1
        view = self._task.pyramid.view(next_view(state, self._task), schedule.level(iteration))
        gathers = schedule.gathers(iteration)
        statistics = self._compute.start(
            state.optimizer, view, schedule.sh_degree(iteration), schedule.config.ssim_weight,
            variance=gathers and self._variance)
        if gathers:
            state.gathered.add(statistics, view.camera.width, view.camera.height)
        state.optimizer.step(
            schedule.means_rate(iteration), sh_rest=schedule.moves_sh(iteration),
            factor=schedule.rate_factor(iteration), counted=self._compute.counted)
        state.iteration = iteration

    def _meets(self, iteration: int) -> bool:
        schedule = self._task.schedule
        return (self._looks(iteration) or len(self._trail) >= _FARTHEST
                or schedule.densifies(iteration) or schedule.resets(iteration)
                or iteration == schedule.review)

    def _take_back(self, happened: int) -> None:
        """Returns to the state after the first steps of the trail; the others changed nothing."""
        before = self._trail[happened]
        self._state.iteration, self._state.queue = before.iteration, before.queue
        self._state.generator.set_state(before.generator)
