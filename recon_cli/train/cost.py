"""The expected time of a run, from a few timed steps, reports and checkpoints before it."""

from __future__ import annotations

import math
import statistics
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from recon_cli.context import TrainCallback
from recon_cli.deadline import Clock, Deadline
from recon_cli.scene.splats import Splats
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

@dataclass(frozen=True)
class LevelCost:
    """Milliseconds of one step at one resolution: fixed + each x thousands of Gaussians."""

    level: int  # factor by which images are reduced
    fixed_ms: float  # for the pixels
    each_ms: float  # for every thousand Gaussians

    def ms(self, count: float) -> float:
        """Returns the milliseconds of a step with so many Gaussians."""
        return self.fixed_ms + self.each_ms * count / 1000


@dataclass(frozen=True)
class CostModel:
    """The time that the parts of a run take on this machine."""

    levels: tuple[LevelCost, ...]  # of the steps, finest first
    report: LevelCost  # of one look at all validation views
    save_ms: float  # of one checkpoint, for every thousand Gaussians
    seconds: float  # that the calibration took

    def run_seconds(self, schedule: Schedule, first: int) -> float:
        """Returns the seconds of all steps of a schedule that begins with `first` Gaussians."""
        costs = {cost.level: cost for cost in self.levels}
        config, total = schedule.config, 0.0
        every, saves = report_every(schedule), config.checkpoint_every
        for begin, end, count in counts(schedule, first):
            steps = end - begin
            total += steps * (step := costs[schedule.level((begin + end) // 2 + 1)].ms(count))
            total += steps / every * self.report.ms(count)
            save = self.save_ms * count / 1000
            most = SAVE_SHARE * step if save > 1000 * LONG_SAVE else math.inf
            total += steps * min(save / saves, most)
        return total / 1000


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
) -> CostModel:
    """Returns the times of the parts of a run, by a few timed steps at each level, coarsest first.

    About `seconds` are spent; after twice that, the remaining levels are told from the one before.
    The cap of the schedule is the larger count that is timed. `scratch` is a file for a checkpoint,
    which is deleted again.
    """
    deadline = Deadline(2 * seconds, clock)
    factors = {factor for _, factor in task.schedule.recipe.levels}
    wanted = sorted({1, *factors}, reverse=True)
    probe = _Probe(task, points, colors, clock, each=seconds / (2 * len(wanted)))
    levels: list[LevelCost] = []
    for level in wanted:
        if levels and deadline.left <= 0:
            levels.append(_scale_cost(levels[-1], level))
        else:
            levels.append(probe.level(level))
    report = probe.report() if deadline.left > 0 else _guess_report(levels[-1], task)
    save_ms = probe.save_ms(scratch)
    return CostModel(tuple(reversed(levels)), report, save_ms, deadline.spent)


def _scale_cost(cost: LevelCost, level: int) -> LevelCost:
    """Returns the cost of a finer level: a part grows with the pixels, the other with the side."""
    side = cost.level / level  # `living`: .14 ms a thousand Gaussians at a quarter, .32 at half
    return LevelCost(level, cost.fixed_ms * side**2, cost.each_ms * side)


def _guess_report(finest: LevelCost, task: Task) -> LevelCost:
    """Returns a third of a step for each validation view: the forward pass."""
    share = len(task.validation) / 3
    return LevelCost(1, finest.fixed_ms * share, finest.each_ms * share)


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

    def level(self, level: int) -> LevelCost:
        """Returns the cost of a step at a level, from those at two counts."""
        for view in set(self._views):
            self._task.pyramid.view(view, level)
        return self._line(level, self._step_ms(self.small, level), self._step_ms(self.large, level))

    def _line(self, level: int, few: float, many: float) -> LevelCost:
        small, large = len(self.small) / 1000, len(self.large) / 1000
        each = max(0.0, (many - few) / (large - small)) if large > small else 0.0
        return LevelCost(level, max(0.0, few - each * small), each)

    def _state(self, splats: Splats) -> TrainState:
        task = self._task
        return new_state(splats, task.schedule.config, task.means_unit, backend=task.backend)

    def _step_ms(self, splats: Splats, level: int) -> float:
        """Returns the mean of a few steps in the middle of a level; at least of one."""
        state = self._state(splats)
        state.iteration = _middle(self._task.schedule, level)
        state.queue = list(self._views)
        timer = _StepTimer(self._now, self._each)
        with suppress(_Enough):
            fit(state, self._task, state.iteration + len(self._views), (timer,))
        times = [1e3 * (end - begin) for begin, end in pairwise(timer.marks)]
        return statistics.fmean(times[_WARM:])

    def report(self) -> LevelCost:
        """Returns the cost of a look at all validation views, from one at the first of them."""
        values = []
        for splats in (self.small, self.large):
            state = self._state(splats)
            state.iteration = _LENGTH
            begin = self._now()
            validation_psnr(state, replace(self._task, validation=self._looks))
            values.append(1e3 * (self._now() - begin) * self._factor)
        return self._line(1, *values)

    def save_ms(self, scratch: Path) -> float:
        """Returns the milliseconds that a checkpoint takes for every thousand Gaussians."""
        state = self._state(self.small)
        begin = self._now()
        save_state(scratch, state)
        delete(scratch)
        return 1e3 * (self._now() - begin) / (len(self.small) / 1000)

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
