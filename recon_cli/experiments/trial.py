"""One training run of one variant on one scene: stopped here and there, and scored off the clock.

Scores are of the model as its .ply holds it, on views with their original pixels that it was not
trained on.
"""

from __future__ import annotations

import dataclasses
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch

from recon_cli.config.stages import RunConfig
from recon_cli.context import StageContext, TrainCallback
from recon_cli.errors import ConfigError, ReconstructionError
from recon_cli.evaluation.reference_views import (
    MASK_HINT,
    MeanScore,
    ReferenceView,
    load_reference_views,
    load_scene,
    mean_score,
)
from recon_cli.experiments.scenes import SceneFolders
from recon_cli.experiments.variants import MidPrune, Variant
from recon_cli.io.ply import read_ply, write_ply
from recon_cli.scene.scene import Scene
from recon_cli.scene.splats import Splats
from recon_cli.scene.train_view import TrainView
from recon_cli.train.feature_trials import PARTS
from recon_cli.train.fit import fit
from recon_cli.train.initialize import first_state
from recon_cli.train.plan import first_count
from recon_cli.train.planning import model_parts, parts_needed
from recon_cli.train.prune_loop import RATIO, PruneRun, prune_loop, remaining, rounds_within
from recon_cli.train.schedule import RecoverySchedule, Schedule
from recon_cli.train.state import TrainState
from recon_cli.train.task import Task
from recon_cli.train.train_data import load_task

PILOT_STEPS = 200  # the count changes twice in them at the usual hundred steps
_WARM_STEPS = 10  # caches and threads; the kernels are compiled before


class TrainingClock:
    """Counts wall and CPU seconds from its creation on, but for its pauses; waits for a GPU."""

    def __init__(self, device: str) -> None:
        self._device = device
        self._zero = self._now()

    def seconds(self) -> tuple[float, float]:
        """Returns the wall seconds, and the CPU seconds of all threads of this process."""
        wall, cpu = self._now()
        return wall - self._zero[0], cpu - self._zero[1]

    @contextmanager
    def pause(self) -> Iterator[None]:
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
class CurvePoint:
    """The state of a run after some steps."""

    iteration: int
    seconds: float  # of training alone, on the wall
    cpu_seconds: float  # of training alone, of all threads
    gaussians: int
    bytes: int  # of the .ply that would be written
    psnr_db: float  # mean over the scored views
    ssim: float


@dataclass(frozen=True)
class TrainingRun:
    """What is run: one variant from one seed for so many steps."""

    variant: Variant
    base: RunConfig  # options that all variants share
    iterations: int
    seed: int

    @property
    def config(self) -> RunConfig:
        """The options of this run."""
        return self.variant.config(self.base, iterations=self.iterations, seed=self.seed)


@dataclass(frozen=True, eq=False)
class LoadedScene:
    """A scene in memory, ready to be trained on by any variant."""

    folders: SceneFolders
    scene: Scene
    scored: Sequence[ReferenceView]
    base: RunConfig  # options that all variants share
    ctx: StageContext

    @cached_property
    def parts(self) -> dict[str, Any]:
        """The parts of the model that the scene needs, as `recon train` finds them by trials."""
        task = self._load_task(self.base)
        return model_parts(parts_needed(task, self.scene, self.ctx, harmonics=True).config)

    def task(self, run: TrainingRun) -> Task:
        """Returns the task of a run; training itself looks at no view that it does not fit."""
        config = run.config
        undecided = [name for name in PARTS if getattr(config, name) == "auto"]
        undecided += ["sh_degree"] if run.variant.tries_degree else []
        if undecided:  # only then, because it may take trials
            config = dataclasses.replace(config, **{name: self.parts[name] for name in undecided})
        return dataclasses.replace(
            self._load_task(config), validation=[], schedule=Schedule(config))

    def _load_task(self, config: RunConfig) -> Task:
        images = "denoised" if config.images == "denoised" else "original"
        if images not in self._tasks:
            self._tasks[images] = load_task(self.scene, config, self.ctx)
        return dataclasses.replace(self._tasks[images], schedule=Schedule(config))

    @cached_property
    def _tasks(self) -> dict[str, Task]:
        return {}


def load_for_training(
    folders: SceneFolders, split: str, base: RunConfig, ctx: StageContext
) -> LoadedScene:
    """Returns a scene with the views in memory that scores come from: "test" or "validation".

    Raises:
        ReconstructionError: no held-out view has a camera.
        ConfigError: there are no validation views, the views are too small, or masks leave none.
    """
    scene = load_scene(folders.inputs, validation=base.validation)
    if split == "test" and not scene.test:
        raise ReconstructionError(
            f"No held-out view of {folders.name} has a camera.",
            hint="Run `recon ingest` with a --holdout such as every:8.")
    if split == "validation" and not scene.validation:
        raise ConfigError(
            f"{folders.name} has no validation views.",
            hint="Use --set train.validation=0.1, or give a scene with more views.")
    views = load_reference_views(
        scene.test if split == "test" else scene.validation, base.max_size, ctx)
    if not views:
        raise ConfigError(f"The masks of {folders.name} leave no view to score.", hint=MASK_HINT)
    return LoadedScene(folders, scene, views, base, ctx)


def score_as_ply(
    splats: Splats, views: Sequence[TrainView], sh_degree: int, ctx: StageContext
) -> tuple[MeanScore, int]:
    """Returns the scores of a model as its .ply holds it, and the bytes of that file."""
    with tempfile.TemporaryDirectory(prefix="recon-score-") as folder:
        path = Path(folder) / "splats.ply"
        write_ply(path, splats)
        size = path.stat().st_size
        written = read_ply(path).map(lambda tensor: tensor.to(ctx.device))
    return mean_score(written, views, sh_degree, ctx.backend), size


def prune_run(
    state: TrainState, task: Task, prune: MidPrune, until: int, callbacks: Sequence[TrainCallback]
) -> PruneRun:
    """Returns the run that prunes a state at its step and trains until `until`."""
    config, first = prune.config, state.iteration
    epoch = task.schedule.epoch(len(task.train))
    if prune.restarts:
        schedule = RecoverySchedule(task.schedule.config, first=first, until=until)
        task = dataclasses.replace(task, schedule=schedule)
    return PruneRun(
        state, task, first, until, rounds=config.rounds or rounds_within(until - first, epoch),
        score=config.score, beta=config.beta, callbacks=callbacks)


class _TrialCallback(TrainCallback):
    """Calls `take_score` after certain steps, and `on_step` after each."""

    def __init__(
        self, stops: Sequence[int], take_score: Callable[[], None], on_step: Callable[[], None]
    ) -> None:
        self._stops, self._take_score, self._on_step = stops, take_score, on_step

    def needs_step(self, iteration: int) -> bool:  # noqa: ARG002
        """Returns True: the progress bar counts every step."""
        return True

    def on_step(self, iteration: int, splats: Splats) -> None:  # noqa: ARG002
        """Scores the model where that is due."""
        self._on_step()
        if iteration in self._stops:
            self._take_score()


def run_trial(
    loaded: LoadedScene, run: TrainingRun, score_at: Sequence[int], *, on_step: Callable[[], None]
) -> tuple[CurvePoint, ...]:
    """Trains and returns the scores after the steps in `score_at`, 0 for the start, and at the end.

    Raises:
        TrainingError: memory is short, or training diverged.
    """
    task = loaded.task(run)
    state = first_state(
        task, loaded.scene.points, loaded.scene.colors,
        most=first_count(task.schedule.config, len(loaded.scene.points)))
    stops = sorted({*score_at, run.iterations})
    points: list[CurvePoint] = []
    clock = TrainingClock(loaded.ctx.device)

    def take_score() -> None:
        wall, cpu = clock.seconds()
        with clock.pause():
            splats = state.splats.map(lambda tensor: tensor.detach())
            degree = task.schedule.sh_degree(max(1, state.iteration))
            score, size = score_as_ply(splats, loaded.scored, degree, loaded.ctx)
        points.append(CurvePoint(
            state.iteration, round(wall, 3), round(cpu, 3), len(splats), size, score.psnr_db,
            score.ssim))

    callbacks = (_TrialCallback(stops, take_score, on_step),)
    if 0 in stops:
        take_score()
    prune = run.variant.prune
    if prune is None:
        fit(state, task, run.iterations, callbacks)
    else:  # at least one step is left for recovery
        fit(state, task, min(run.iterations - 1, round(prune.at * run.iterations)), callbacks)
        ratio = RATIO if prune.config.ratio is None else prune.config.ratio
        prune_loop(prune_run(state, task, prune, run.iterations, callbacks),
                   remaining(len(state.splats), ratio))
    return tuple(points)


def run_pilot(loaded: LoadedScene, variant: Variant) -> CurvePoint:
    """Returns the end of a short run, whose seconds say what a step of the variant costs here.

    It goes through the whole plan of the recipe. A few steps ahead warm the caches.
    """
    for iterations in (_WARM_STEPS, PILOT_STEPS):
        points = run_trial(
            loaded, TrainingRun(variant, loaded.base, iterations, 0), (), on_step=lambda: None)
    return points[-1]
