"""The costs of a training on this machine, by a few timed steps, and the work of its schedule."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from recon_cli.context import TrainCallback
from recon_cli.deadline import Clock, Deadline
from recon_cli.scene.splats import Splats
from recon_cli.time_estimate import Cost, TimeEstimator, Work
from recon_cli.train.fit import densification
from recon_cli.train.fit.initialize import splats_from_points
from recon_cli.train.fit.loop import fit, report_every, validation_psnr
from recon_cli.train.fit.schedule import Schedule
from recon_cli.train.fit.state import (
    LONG_SAVE,
    SAVE_SHARE,
    TrainState,
    new_state,
    save_state,
)
from recon_cli.train.fit.task import Task
from recon_cli.workspace.atomic import delete

# Of Gaussians that stand for trained ones: with .3 a step takes what a real one does within 10%,
# with the .1 that training begins with up to 25% less (room `living`, one thread).
_OPACITY = 0.3
_STEPS = 8  # timed at each level and count: harmonics, moved in every fourth, cost some more
_WARM = 1  # steps before them: the first one makes buffers
_FEW = 3  # the smaller of the two counts is the larger one by this
_MOST = 100_000  # Gaussians that are timed; to make more takes as long as some hundred steps
_GROWTH = 0.5  # of the count at once, as in `budget`
_LENGTH = 1000  # steps of the run that stands for any other while steps are timed
_SEGMENTS = 400  # into which a run is cut; more do not change the sum by .1%

REPORT, SAVE = "report", "save"  # a look at all validation views, and a checkpoint


def step_kind(level: int) -> str:
    """Returns the name of the cost of a step on images that are reduced by this factor."""
    return f"step at 1/{level}"


def list_work(schedule: Schedule, first: int, costs: Mapping[str, Cost]) -> Iterator[Work]:
    """Yields the work of a schedule that begins with so many Gaussians; sizes are thousands.

    How often there is time for a checkpoint follows from the costs.
    """
    every, saves = report_every(schedule), schedule.config.checkpoint_every
    for begin, end, count in counts(schedule, first):
        steps, size = end - begin, count / 1000
        kind = step_kind(schedule.level((begin + end) // 2 + 1))
        yield Work(kind, steps, size)
        yield Work(REPORT, steps / every, size)
        share, save = steps / saves, costs[SAVE].seconds(size)
        if save > LONG_SAVE:
            share = min(share, SAVE_SHARE * steps * costs[kind].seconds(size) / save)
        yield Work(SAVE, share, size)


def counts(schedule: Schedule, first: int) -> list[tuple[int, int, int]]:
    """Returns the run cut into (begin, end, Gaussians), the count as the schedule lets it grow."""
    config = schedule.config
    stride = math.ceil(schedule.steps / _SEGMENTS)
    result, count, begin = [], min(first, config.max_gaussians), schedule.first
    while begin < config.iterations:
        end = min(begin + stride, config.iterations)
        result.append((begin, end, count))
        for iteration in filter(schedule.densifies, range(begin + 1, end + 1)):
            most = count + int(_GROWTH * count)
            count = max(count, min(schedule.target(iteration, first), most))
        begin = end
    return result


def calibrate(
    task: Task,
    points: NDArray[np.float64],  # [P, 3]
    colors: NDArray[np.uint8],  # [P, 3]
    *,
    scratch: Path,
    clock: Clock = time.perf_counter,
    seconds: float,
) -> TimeEstimator:
    """Returns the estimator of a run, by a few timed steps at each level, coarsest first.

    About `seconds` are spent; after twice that, the costs of the remaining levels follow from the
    one before. The cap of the schedule is the larger count that is timed. `scratch` is a file for a
    checkpoint, which is deleted again.
    """
    deadline = Deadline(2 * seconds, clock)
    factors = {factor for _, factor in task.schedule.recipe.levels}
    wanted = sorted({1, *factors}, reverse=True)
    probe = _Probe(task, points, colors, clock, each=seconds / (2 * len(wanted)))
    costs: dict[str, Cost] = {}
    for coarser, level in pairwise([wanted[0], *wanted]):
        if costs and deadline.left <= 0:
            # `living`: a thousand Gaussians take .14 ms at a quarter, .32 at half
            side = coarser / level
            costs[step_kind(level)] = costs[step_kind(coarser)].times(side**2, side)
        else:
            costs[step_kind(level)] = probe.step(level)
    pass_share = len(task.validation) / 3  # of a step, for the forward pass of each view
    costs[REPORT] = probe.report() if deadline.left > 0 else (
        costs[step_kind(1)].times(pass_share, pass_share))
    costs[SAVE] = probe.save(scratch)
    return TimeEstimator(costs, seconds=deadline.spent)


class _Enough(Exception):  # noqa: N818 - an event, not an error
    """The time for timing is used up."""


class _StepTimer(TrainCallback):
    """Marks the time after each step and ends the fit once `seconds` are used up."""

    def __init__(self, clock: Clock, seconds: float) -> None:
        self._clock, self._seconds = clock, seconds
        self.marks = [clock()]

    def needs_step(self, iteration: int) -> bool:  # noqa: ARG002
        return True

    def on_step(self, iteration: int, splats: Splats) -> None:  # noqa: ARG002
        self.marks.append(self._clock())
        if self.marks[-1] >= self.marks[0] + self._seconds and len(self.marks) > 1 + _WARM:
            raise _Enough


class _Probe:
    """Times steps on Gaussians of its own."""

    def __init__(
        self, task: Task, points: NDArray[np.float64], colors: NDArray[np.uint8], clock: Clock,
        *, each: float,
    ) -> None:
        config = task.schedule.config
        # shares decide the levels, so any length has them; nothing is added in so few steps
        plan = replace(config, iterations=_LENGTH, densify_every=2 * _LENGTH, mid=1.0)
        self._task = replace(task, validation=[], schedule=replace(task.schedule, config=plan))
        self._looks = task.validation[:1]
        self._factor = len(task.validation)
        self._clock, self._each = clock, each
        most = min(config.max_gaussians, _MOST)
        self.small, self.large = (
            _grow_splats(points, colors, count, config.sh_degree).map(
                lambda tensor: tensor.to(task.device))
            for count in (max(1, most // _FEW), most))
        views = np.linspace(0, len(task.train) - 1, _STEPS + _WARM).round().astype(int)
        self._views: list[int] = views.tolist()

    def step(self, level: int) -> Cost:
        """Returns the cost of a step at a level, from those at two counts."""
        for view in set(self._views):
            self._task.pyramid.view(view, level)
        return self._line(
            self._step_seconds(self.small, level), self._step_seconds(self.large, level))

    def _line(self, few: float, many: float) -> Cost:
        small, large = len(self.small) / 1000, len(self.large) / 1000
        each = max(0.0, (many - few) / (large - small)) if large > small else 0.0
        return Cost(max(0.0, few - each * small), each)

    def _state(self, splats: Splats) -> TrainState:
        task = self._task
        return new_state(splats, task.schedule.config, task.means_unit, backend=task.backend)

    def _step_seconds(self, splats: Splats, level: int) -> float:
        """Returns the mean of a few steps in the middle of a level; at least of one."""
        state = self._state(splats)
        state.iteration = _middle(self._task.schedule, level)
        state.queue = list(self._views)
        timer = _StepTimer(self._now, self._each)
        with suppress(_Enough):
            fit(state, self._task, state.iteration + len(self._views), (timer,))
        return statistics.fmean(
            [end - begin for begin, end in pairwise(timer.marks)][_WARM:])

    def report(self) -> Cost:
        """Returns the cost of a look at all validation views, from one at the first of them."""
        values = []
        for splats in (self.small, self.large):
            state = self._state(splats)
            state.iteration = _LENGTH
            begin = self._now()
            validation_psnr(state, replace(self._task, validation=self._looks))
            values.append((self._now() - begin) * self._factor)
        return self._line(*values)

    def save(self, scratch: Path) -> Cost:
        """Returns the cost of a checkpoint."""
        state = self._state(self.small)
        begin = self._now()
        save_state(scratch, state)
        delete(scratch)
        return Cost(each=(self._now() - begin) / (len(self.small) / 1000))

    def _now(self) -> float:
        if self._task.device.type == "cuda":  # pragma: no cover
            torch.cuda.synchronize(self._task.device)
        return self._clock()


def _middle(schedule: Schedule, level: int) -> int:
    """Returns the iteration in the middle of the steps of a level."""
    steps = [i for i in range(1, _LENGTH + 1) if schedule.level(i) == level]
    return steps[len(steps) // 2] - 1


def _grow_splats(
    points: NDArray[np.float64], colors: NDArray[np.uint8], count: int, sh_degree: int
) -> Splats:
    """Returns `count` Gaussians that cost as much as trained ones: the points', split at random."""
    splats = splats_from_points(points, colors, most=max(count, 1), seed=0, sh_degree=sh_degree)
    rule, generator = densification.BudgetRule(count, 0.0, 1.0), torch.Generator().manual_seed(0)
    while 1 < len(splats) < count:
        splats, _ = densification.densify_budget(splats, torch.ones(len(splats)), rule, generator)
    splats.logit_opacities = torch.logit(torch.full((len(splats),), _OPACITY))
    return splats
