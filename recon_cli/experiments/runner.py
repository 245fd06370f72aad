"""The runner of all experiments: variants x repeats, and training runs as records that resume.

`run_grid` is the loop of every experiment. `Runner` fills it with training runs, each scored as its
.ply stores the model, on original pixels of views that it was not trained on. A finished run is a
line of runs.jsonl, flushed before the next run starts.
"""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from recon_cli import __version__
from recon_cli.config.settings import Settings
from recon_cli.config.stages import ComputeConfig, RunConfig
from recon_cli.context import StageContext, TrainCallback
from recon_cli.errors import ConfigError, FormatError
from recon_cli.evaluation.reference_views import mean_score
from recon_cli.evaluation.scores import MeanScore
from recon_cli.experiments.clock import Clock, Host, examine
from recon_cli.experiments.scenes import ExperimentScene, load_for_training, open_scene
from recon_cli.experiments.variants import MidPrune, TrainingRun, Variant
from recon_cli.pipeline.execute import render_context
from recon_cli.progress import Progress
from recon_cli.scene.splats import Splats
from recon_cli.scene.train_view import TrainView
from recon_cli.splats.ply import read_ply, write_ply
from recon_cli.stages import stage
from recon_cli.train.fit.initialize import first_state
from recon_cli.train.fit.loop import fit
from recon_cli.train.fit.schedule import RecoverySchedule
from recon_cli.train.fit.state import TrainState
from recon_cli.train.fit.task import Task
from recon_cli.train.parts.table import model_parts
from recon_cli.train.plan import first_count
from recon_cli.train.prune.prune_loop import RATIO, PruneRun, prune_loop, remaining, rounds_within
from recon_cli.workspace.json_record import sha256_json
from recon_cli.workspace.steps import StepFolder

RECORDS_FILE = "runs.jsonl"
STEPS = 3000  # of a run: about half a minute on two cores, and enough to tell recipes apart
PILOT_STEPS = 200  # the number of Gaussians changes twice in them at the usual interval of 100
_WARM_STEPS = 10  # for caches and threads; the kernels are compiled before
_SECTIONS = ("ingest", "denoise", "sfm", "train")  # that --set may change
# training options that have command-line options of their own here, or no effect
_OWN = {"iterations", "max_size", "max_gaussians", "seed", "densify", "mid", "checkpoint_every",
        "quality", "minutes", "early_stop", "sh_degree"}

_Variant = TypeVar("_Variant")
_Repeat = TypeVar("_Repeat")
_Result = TypeVar("_Result")


def run_grid(
    variants: Mapping[str, _Variant], repeats: Sequence[_Repeat],
    measure: Callable[[_Variant, _Repeat], _Result],
) -> dict[str, tuple[_Result, ...]]:
    """Returns the measurements of each variant by its name; in each repeat all take turns."""
    results: dict[str, list[_Result]] = {name: [] for name in variants}
    for repeat in repeats:
        for name, variant in variants.items():
            results[name].append(measure(variant, repeat))
    return {name: tuple(by_repeat) for name, by_repeat in results.items()}


@dataclass(frozen=True)
class ExperimentRequest:
    """The options that all training experiments share."""

    scenes: tuple[Path, ...]  # workspaces, or data sets with poses
    seeds: int  # runs of each variant
    base: RunConfig  # options that all variants share, size and cap included
    settings: Settings = field(default_factory=dict)  # of ingest, denoise and sfm for data sets
    compute: ComputeConfig = field(default_factory=ComputeConfig)

    def load(
        self, paths: Mapping[str, Path], scratch: Path, split: str, progress: Progress
    ) -> tuple[Host, Iterator[ExperimentScene]]:
        """Returns this machine and the scenes, each loaded when it is asked for.

        Data sets become workspaces in `scratch`.
        """
        ctx = render_context(self.compute, progress)
        host = examine(ctx.threads, ctx.device)
        return host, (load_for_training(
            open_scene(name, path, scratch, self.settings, self.compute, progress), split,
            self.base, ctx) for name, path in paths.items())


def base_config(
    settings: Settings, *, max_size: int, max_gaussians: int, validation: float | None = None
) -> RunConfig:
    """Returns the options that all variants share; --set may set `validation` where it is None.

    Raises:
        ConfigError: --set changes a stage that is not run, or a field with its own option.
    """
    for section in settings.keys() - set(_SECTIONS):
        if settings[section]:
            raise ConfigError(
                f"--set {section}.{next(iter(settings[section]))} has no effect here.",
                hint=f"Options of {', '.join(_SECTIONS)} can be set.")
    values: dict[str, Any] = dict(settings.get("train", {}))
    own = _OWN if validation is None else _OWN | {"validation"}
    for name in sorted(own & values.keys()):
        raise ConfigError(
            f"--set train.{name} has no effect here.",
            hint="See --help for sizes, steps and seeds; recipes define densification.")
    if validation is not None:
        values["validation"] = validation
    return RunConfig(  # without early stopping: every run takes exactly its steps
        **values, iterations=STEPS, max_size=max_size, max_gaussians=max_gaussians,
        early_stop=False)


def shared_options(base: RunConfig) -> dict[str, Any]:
    """Returns the options that all variants share, without those that each run sets."""
    return {name: value for name, value in base.hashed_fields().items()
            if name not in _OWN - {"max_size", "max_gaussians", "sh_degree"}}


@dataclass(frozen=True)
class CurvePoint:
    """The state of a run after some steps."""

    iteration: int
    seconds: float  # wall time of training alone
    cpu_seconds: float  # of training alone, of all threads
    gaussians: int
    bytes: int  # of the .ply
    psnr_db: float  # mean over the scored views
    ssim: float


@dataclass(frozen=True)
class Record:
    """One finished run."""

    points: tuple[CurvePoint, ...]  # in order of steps; only the last one if read from a file
    machine: str  # seconds of two machines do not compare
    parts: str = ""  # optional parts of the model that were on, and the pixels trained on

    @property
    def last(self) -> CurvePoint:
        """The end of the run."""
        return self.points[-1]


Runs = Mapping[str, tuple[Record, ...]]  # by variant, then by seed


@dataclass(frozen=True)
class SceneRuns:
    """All runs on one scene."""

    views: int  # that were scored
    width: int  # of the first of them in pixels
    height: int
    runs: Mapping[str, Runs]  # by comparison

    @staticmethod
    def from_loaded(loaded: ExperimentScene, runs: Mapping[str, Runs]) -> SceneRuns:
        """Returns the runs on a scene."""
        camera = loaded.scored[0].camera
        return SceneRuns(len(loaded.scored), camera.width, camera.height, runs)

    def size_record(self) -> dict[str, int]:
        """Returns number and size of the views as JSON."""
        return {"views": self.views, "width": self.width, "height": self.height}


def key_of(loaded: ExperimentScene, run: TrainingRun) -> str:
    """Returns the key of a run: all that affects its result. Threads affect only seconds."""
    versions = [__version__, *(stage(name).version for name in ("train", "prune", "evaluate"))]
    return sha256_json({
        "scene": loaded.folders.digest, "arm": run.variant.record(),
        "config": run.config.hashed_fields(), "versions": versions, "backend": loaded.ctx.backend,
        "device": loaded.ctx.device})


def open_records(folder: Path) -> StepFolder:
    """Returns the finished runs in a folder, by key.

    FormatError where its file holds something else, or runs of another version of recon.
    """
    path = folder / RECORDS_FILE
    records = StepFolder(folder, path)
    try:
        if path.exists():
            records.refuse_damaged_log()
            records.find_damage()  # cuts off a line that was being written
    except ValueError as error:
        raise FormatError(
            f"{error}, or of another version of recon.",
            hint=f"Remove that line, or move {path} elsewhere; its runs are then repeated.",
        ) from error
    return records


@dataclass(frozen=True)
class Figure:
    """A number of a run at one of its points."""

    label: str  # in tables
    digits: int  # after the decimal point
    value: Callable[[CurvePoint], float]


FIGURES = {
    "psnr_db": Figure("PSNR dB", 2, lambda point: point.psnr_db),
    "ssim": Figure("SSIM", 4, lambda point: point.ssim),
    "steps": Figure("steps", 0, lambda point: point.iteration),
    "gaussians": Figure("Gaussians", 0, lambda point: point.gaussians),
    "megabytes": Figure("MB", 1, lambda point: point.bytes / 1e6),
    "seconds": Figure("s", 1, lambda point: point.seconds),
    "cpu_seconds": Figure("CPU s", 1, lambda point: point.cpu_seconds)}


class Runner:
    """Makes training runs, or takes them from the records, if there are any."""

    def __init__(
        self, base: RunConfig, progress: Progress, machine: str = "",
        records: StepFolder | None = None,
    ) -> None:
        self._base, self._progress = base, progress
        self._machine, self._records = machine, records

    def pilot_seconds(
        self, loaded: ExperimentScene, variants: Sequence[Variant], *, most: int = PILOT_STEPS
    ) -> dict[str, float]:
        """Returns the approximate seconds of a step by variant; the pilots also warm caches.

        They take PILOT_STEPS, or `most` where the runs are shorter.
        """
        seconds = {}
        label = f"{loaded.folders.name}: pilots"
        with self._progress.bar(label, len(variants), unit="variant") as bar:
            for variant in variants:
                point = run_pilot(loaded, variant, min(PILOT_STEPS, most))
                seconds[variant.name] = point.seconds / min(PILOT_STEPS, most)
                bar.advance()
        return seconds

    def run_all(
        self, loaded: ExperimentScene, variants: Sequence[Variant], seeds: int,
        steps: Mapping[str, int], *, label: str,
        score_at: Callable[[int], Sequence[int]] = lambda _steps: (),
    ) -> Runs:
        """Returns the runs of every variant with every seed, 0 to seeds - 1.

        `steps` are by variant; `score_at` maps a run's steps to those after which it is scored.
        """
        with self._progress.bar(label, seeds * sum(steps.values()), unit="step") as bar:

            def measure(variant: Variant, seed: int) -> Record:
                bar.note(f"{variant.label}, seed {seed}")
                run = TrainingRun(variant, self._base, steps[variant.name], seed)
                record = self.find_record(loaded, run)
                if record is None:
                    return self.make(loaded, run, score_at(run.iterations), bar.advance)
                bar.advance(run.iterations)
                return record

            return run_grid({variant.name: variant for variant in variants}, range(seeds), measure)

    def find_record(self, loaded: ExperimentScene, run: TrainingRun) -> Record | None:
        """Returns an earlier run, None where there is none or nothing is recorded."""
        value = self._records.result(key_of(loaded, run)) if self._records else None
        return None if value is None else Record(
            (CurvePoint(**value["point"]),), value["machine"], value["parts"])

    def make(
        self, loaded: ExperimentScene, run: TrainingRun, score_at: Sequence[int],
        on_step: Callable[[], None],
    ) -> Record:
        """Makes and records a run."""
        points = run_trial(loaded, run, score_at, on_step=on_step)
        config = loaded.task(run).schedule.config
        parts = [f"{config.images} images", f"degree {config.sh_degree}",
                 *(name for name, value in model_parts(config).items() if value == "on")]
        record = Record(points, self._machine, ", ".join(parts))
        if self._records:
            self._records.finish(key_of(loaded, run), {
                "point": asdict(record.last), "machine": record.machine, "parts": record.parts,
                "scene": loaded.folders.name, "arm": run.variant.name, "seed": run.seed})
        return record


def score_as_ply(
    splats: Splats, views: Sequence[TrainView], sh_degree: int, ctx: StageContext
) -> tuple[MeanScore, int]:
    """Returns the scores of a model as its .ply stores it, and the bytes of that file."""
    with tempfile.TemporaryDirectory(prefix="recon-score-") as folder:
        path = Path(folder) / "splats.ply"
        write_ply(path, splats)
        size = path.stat().st_size
        written = read_ply(path).map(lambda tensor: tensor.to(ctx.device))
    return mean_score(written, views, sh_degree, ctx.backend), size


class _StepCallback(TrainCallback):
    """Calls a function after each step."""

    def __init__(self, after_step: Callable[[int], None]) -> None:
        self._after_step = after_step

    def needs_step(self, iteration: int) -> bool:  # noqa: ARG002
        """Returns True: the progress bar counts every step."""
        return True

    def on_step(self, iteration: int, splats: Splats) -> None:  # noqa: ARG002
        """Calls the function."""
        self._after_step(iteration)


def run_trial(
    loaded: ExperimentScene, run: TrainingRun, score_at: Sequence[int], *,
    on_step: Callable[[], None],
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
    clock = Clock(loaded.ctx.device)

    def take_score() -> None:
        wall, cpu = clock.seconds()
        with clock.pause():
            splats = state.splats.map(lambda tensor: tensor.detach())
            degree = task.schedule.sh_degree(max(1, state.iteration))
            score, size = score_as_ply(splats, loaded.scored, degree, loaded.ctx)
        points.append(CurvePoint(
            state.iteration, round(wall, 3), round(cpu, 3), len(splats), size, score.psnr_db,
            score.ssim))

    def after_step(iteration: int) -> None:
        on_step()
        if iteration in stops:
            take_score()

    callbacks = (_StepCallback(after_step),)
    if 0 in stops:
        take_score()
    prune = run.variant.prune
    if prune is None:
        fit(state, task, run.iterations, callbacks)
    else:  # at least one step is left for recovery
        fit(state, task, min(run.iterations - 1, round(prune.at * run.iterations)), callbacks)
        ratio = RATIO if prune.config.ratio is None else prune.config.ratio
        prune_loop(_prune_run(state, task, prune, run.iterations, callbacks),
                   remaining(len(state.splats), ratio))
    return tuple(points)


def _prune_run(
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


def run_pilot(loaded: ExperimentScene, variant: Variant, steps: int = PILOT_STEPS) -> CurvePoint:
    """Returns the end of a short run of the whole recipe, after a few steps that warm caches."""
    for iterations in (_WARM_STEPS, steps):
        points = run_trial(
            loaded, TrainingRun(variant, loaded.base, iterations, 0), (), on_step=lambda: None)
    return points[-1]
