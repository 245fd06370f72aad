"""One run of one arm on one scene: trained, stopped here and there, scored off the clock."""

from __future__ import annotations

import dataclasses
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import torch

from recon_cli.config.stages import RunConfig
from recon_cli.context import StageContext
from recon_cli.errors import ConfigError
from recon_cli.evaluation.reference_views import MASK_HINT, load_reference_views, mean_score
from recon_cli.experiments.scenes import Place, refuse_unscored
from recon_cli.experiments.variants import Arm, Prune
from recon_cli.io.ply import read_ply, write_ply
from recon_cli.scene.scene import Scene
from recon_cli.scene.splats import Splats
from recon_cli.scene.train_view import TrainView
from recon_cli.train.feature_trials import PARTS
from recon_cli.train.fit import Task, fit
from recon_cli.train.importance import Importance
from recon_cli.train.initialize import first_state
from recon_cli.train.plan import first_count
from recon_cli.train.planning import model_parts, parts_needed
from recon_cli.train.pruning import (
    RATIO,
    Recovery,
    remaining,
    removals,
    remove,
    rounds_within,
    scored,
    survivors,
)
from recon_cli.train.runner import load_task
from recon_cli.train.schedule import Schedule
from recon_cli.train.state import TrainState


class TrainingClock:
    """Counts wall and CPU seconds from its making on, but for its pauses.

    Args:
        device: "cpu" or "cuda", whose queue is waited for.
    """

    def __init__(self, device: str) -> None:
        self._device = device
        self._zero = self._now()

    def seconds(self) -> tuple[float, float]:
        """Returns the seconds on the wall, and those of all threads of this process."""
        wall, cpu = self._now()
        return wall - self._zero[0], cpu - self._zero[1]

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Leaves out the time of the block."""
        began = self._now()
        try:
            yield
        finally:
            ended = self._now()
            self._zero = (self._zero[0] + ended[0] - began[0], self._zero[1] + ended[1] - began[1])

    def _now(self) -> tuple[float, float]:
        if self._device == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter(), time.process_time()


@dataclass(frozen=True)
class Score:
    """How good and how large a model is.

    Attributes:
        psnr_db: mean over the views.
        ssim: mean over the views.
        gaussians: count.
        bytes: of its .ply.
    """

    psnr_db: float
    ssim: float
    gaussians: int
    bytes: int


def score(splats: Splats, views: Sequence[TrainView], sh_degree: int, ctx: StageContext) -> Score:
    """Returns the scores of a model as its .ply holds it.

    Args:
        splats: the model.
        views: to score.
        sh_degree: in use.
        ctx: backend and device.
    """
    with tempfile.TemporaryDirectory(prefix="recon-score-") as folder:
        path = Path(folder) / "splats.ply"
        write_ply(path, splats)
        size = path.stat().st_size
        written = read_ply(path).map(lambda tensor: tensor.to(ctx.device))
    mean = mean_score(written, views, sh_degree, ctx.backend)
    return Score(mean.psnr_db, mean.ssim, len(splats), size)


class Advance(Protocol):
    """Trains a state by a task up to a step; the scores of its steps go into `importance`."""

    def __call__(self, task: Task, until: int, importance: Importance | None = None) -> None:
        """Trains."""


def prune_rest(
    state: TrainState, task: Task, prune: Prune, until: int, advance: Advance
) -> None:
    """Removes the Gaussians that matter least to the training views and trains the rest.

    Args:
        state: changed in place.
        task: views and plan of the run.
        prune: which Gaussians go.
        until: step at which the run ends.
        advance: trains the state.
    """
    config, first = prune.config, state.iteration
    recovery = until - first
    calm = task
    if prune.restarts:
        plan = Recovery(task.schedule.config, first=first, until=until)
        calm = dataclasses.replace(task, schedule=plan)
    rounds = config.rounds or rounds_within(recovery, len(task.train))
    n, ratio = len(state.splats), RATIO if config.ratio is None else config.ratio
    for removal in removals(n, remaining(n, ratio), rounds, recovery):
        score = scored(
            state, calm, first + removal.after, name=config.score, beta=config.beta,
            advance=lambda _state, to, importance: advance(calm, to, importance))
        remove(state, survivors(score, removal.count))
    advance(calm, until)


PILOT_STEPS = 200  # the count changes twice in them at the usual hundred steps
_WARM_STEPS = 10  # caches and threads; the kernels are compiled before


@dataclass(frozen=True)
class Point:
    """How a run stands at one step.

    Attributes:
        iteration: steps done.
        seconds: of training alone, on the wall.
        cpu_seconds: of training alone, of all threads.
        gaussians: count.
        bytes: of the .ply that would be written.
        psnr_db: mean over the scored views.
        ssim: mean over the scored views.
    """

    iteration: int
    seconds: float
    cpu_seconds: float
    gaussians: int
    bytes: int
    psnr_db: float
    ssim: float


@dataclass(frozen=True)
class Run:
    """What is run: one arm from one seed for so many steps.

    Attributes:
        arm: how it is trained.
        base: options that all arms share.
        iterations: steps.
        seed: of every random choice.
    """

    arm: Arm
    base: RunConfig
    iterations: int
    seed: int

    @property
    def config(self) -> RunConfig:
        """The options of this run."""
        return self.arm.config(self.base, iterations=self.iterations, seed=self.seed)


@dataclass(frozen=True, eq=False)
class Stand:
    """A scene in memory, ready to be trained on by any arm.

    Attributes:
        place: its folders.
        scene: its views and points.
        scored: the views that scores come from, with their original pixels.
        base: options that all arms share.
        ctx: where to compute.
    """

    place: Place
    scene: Scene
    scored: Sequence[TrainView]
    base: RunConfig
    ctx: StageContext

    @property
    def name(self) -> str:
        """Of the scene."""
        return self.place.name

    @cached_property
    def parts(self) -> dict[str, Any]:
        """The parts of the model that the scene needs, as `recon train` finds them by trials."""
        task = self._loaded(self.base)
        return model_parts(parts_needed(task, self.scene, self.ctx, harmonics=True).config)

    def task(self, run: Run) -> Task:
        """Returns the task of a run; training itself looks at no view that it does not fit."""
        config = run.config
        left = [name for name in PARTS if getattr(config, name) == "auto"]
        left += ["sh_degree"] if run.arm.tries_degree else []
        if left:  # not before it is asked for: it may take trials
            config = dataclasses.replace(config, **{name: self.parts[name] for name in left})
        return dataclasses.replace(
            self._loaded(config), validation=[], schedule=Schedule(config))

    def _loaded(self, config: RunConfig) -> Task:
        images = "denoised" if config.images == "denoised" else "original"
        if images not in self._tasks:
            self._tasks[images] = load_task(self.scene, config, self.ctx)
        return dataclasses.replace(self._tasks[images], schedule=Schedule(config))

    @cached_property
    def _tasks(self) -> dict[str, Task]:
        return {}


def stand(place: Place, scored: str, base: RunConfig, ctx: StageContext) -> Stand:
    """Returns a scene with the views in memory that scores come from.

    Args:
        place: its folders.
        scored: "test" or "validation": which views are scored.
        base: options that all arms share.
        ctx: where to compute.

    Raises:
        ReconstructionError: no held-out view has a camera.
        ConfigError: there are no validation views, the views are too small, or masks leave none.
    """
    scene = place.load(base)
    refuse_unscored(place, scene, test=scored == "test")
    views = load_reference_views(
        scene.test if scored == "test" else scene.validation, base.max_size, ctx)
    if not views:
        raise ConfigError(f"The masks of {place.name} leave no view to score.", hint=MASK_HINT)
    return Stand(place, scene, views, base, ctx)


def run_trial(
    where: Stand, run: Run, looks: Sequence[int], *, on_step: Callable[[], None]
) -> tuple[Point, ...]:
    """Trains and returns how the run stood after the steps in `looks`, and at its end.

    Args:
        where: the scene.
        run: what is trained.
        looks: steps after which the model is scored; 0 is before the first.
        on_step: called after each step.

    Raises:
        TrainingError: memory is short, or training diverged.
    """
    task = where.task(run)
    state = first_state(
        task, where.scene.points, where.scene.colors,
        most=first_count(task.schedule.config, len(where.scene.points)))
    stops = sorted({*looks, run.iterations})
    points: list[Point] = []
    clock = TrainingClock(where.ctx.device)

    def look() -> None:
        seconds, cpu_seconds = clock.seconds()
        with clock.paused():
            found = _score(where, state, task)
        points.append(Point(
            state.iteration, round(seconds, 3), round(cpu_seconds, 3), found.gaussians,
            found.bytes, found.psnr_db, found.ssim))

    def advance(task: Task, until: int, importance: Importance | None = None) -> None:
        while state.iteration < until:
            stop = min(until, *(stop for stop in stops if stop > state.iteration))
            fit(state, task, stop, on_step=lambda _state: on_step(),
                on_report=lambda _report: None, importance=importance)
            if stop in stops:
                look()

    if 0 in stops:
        look()
    if run.arm.prune is not None:
        advance(task, _cut(run.arm.prune, run.iterations))
        prune_rest(state, task, run.arm.prune, run.iterations, advance)
    else:
        advance(task, run.iterations)
    return tuple(points)


def _cut(prune: Prune, iterations: int) -> int:
    """Returns the step after which an arm prunes; at least one is left to recover."""
    return min(iterations - 1, round(prune.at * iterations))


def _score(where: Stand, state: TrainState, task: Task) -> Score:
    return score(
        state.splats.map(lambda tensor: tensor.detach()), where.scored,
        task.schedule.sh_degree(max(1, state.iteration)), where.ctx)


def pilot(where: Stand, arm: Arm, base: RunConfig, *, on_step: Callable[[], None]) -> Point:
    """Returns the end of a short run, whose seconds say what a step of the arm costs here.

    It goes through the whole plan of the recipe. A few steps ahead warm the caches.
    """
    for iterations in (_WARM_STEPS, PILOT_STEPS):
        found = run_trial(where, Run(arm, base, iterations, 0), (), on_step=on_step)
    return found[-1]
