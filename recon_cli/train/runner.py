"""What the train and prune stages share: views from disk, checkpoints, the log, a clean Ctrl-C."""

from __future__ import annotations

import dataclasses
import json
import logging
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import torch

from recon_cli.config.stages import RunConfig
from recon_cli.context import StageContext
from recon_cli.errors import TrainingError
from recon_cli.evaluation.metrics import leaves_enough
from recon_cli.evaluation.reference_views import MASK_HINT, notice_hidden, sizes_of
from recon_cli.io.images import fit_camera, read_masked_image
from recon_cli.machine import free_memory_bytes
from recon_cli.render.contract import NEAR
from recon_cli.scene.scene import Scene, View
from recon_cli.scene.train_view import TrainView
from recon_cli.train.distributed.data_parallel import fit_together
from recon_cli.train.fit import Report, Task
from recon_cli.train.importance import Importance
from recon_cli.train.memory import MemoryEstimate, estimate, refuse_what_does_not_fit, room
from recon_cli.train.schedule import Schedule
from recon_cli.train.state import LONG_SAVE, SAVE_SHARE, TrainState, save_state
from recon_cli.workspace.atomic import read_json, write_bytes

LOG = "log.jsonl"


def seconds_at(log: Path, iteration: int, *, clock: str = "seconds") -> float:
    """Returns the training seconds that a log counts up to an iteration, by one of its clocks."""
    seconds = 0.0
    for line in log.read_text(encoding="utf-8").splitlines() if log.exists() else []:
        row = json.loads(line)
        if row["iteration"] <= iteration:
            seconds = float(row[clock])
    return seconds


class Log:
    """One JSON line a report; what a crash left behind the checkpoint is cut off."""

    def __init__(self, path: Path, iteration: int, earlier_seconds: float) -> None:
        self._path = path
        lines = path.read_text(encoding="utf-8").splitlines(True) if path.exists() else []
        # a kill in mid-write leaves a last line without its end
        whole = [line for line in lines if line.endswith("\n")]
        kept = [line for line in whole if json.loads(line)["iteration"] <= iteration]
        if not kept:  # a branch starts where the other run stood
            first = {"iteration": iteration, "seconds": earlier_seconds, "cpu_seconds": 0.0}
            kept = [json.dumps(first) + "\n"]
        write_bytes(path, "".join(kept).encode())
        self._earlier = seconds_at(path, iteration)
        self._earlier_cpu = seconds_at(path, iteration, clock="cpu_seconds")

    def add(self, report: Report) -> None:
        """Appends a report; its seconds count from the very start of training."""
        self._write(dataclasses.asdict(report), report.seconds, report.cpu_seconds)

    def spend(self, iteration: int, seconds: float, cpu_seconds: float) -> None:
        """Counts time in which no step was taken."""
        self._write({"iteration": iteration}, seconds, cpu_seconds)

    def _write(self, row: dict[str, object], seconds: float, cpu_seconds: float) -> None:
        row["seconds"] = round(self._earlier + seconds, 3)
        row["cpu_seconds"] = round(self._earlier_cpu + cpu_seconds, 3)
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")


CHECKPOINT = "checkpoint.safetensors"

logger = logging.getLogger("recon")






def load_task(scene: Scene, config: RunConfig, ctx: StageContext) -> Task:
    """Returns the training task at the training size, images in memory as uint8.

    Raises:
        TrainingError: fewer than two views are left to train on, or memory is short.
    """
    _refuse_too_few_views(scene)
    _refuse_tiny_units(scene)
    _check_memory(scene, config, ctx)
    train = load_views(scene.train, config, ctx)
    if len(train) < 2:
        raise TrainingError(
            f"The masks leave only {len(train)} views to train on; at least 2 are needed.",
            hint=MASK_HINT)
    if ctx.device == "cuda":
        train = [view.page_locked() for view in train]
    error = None if scene.error_px is None else scene.error_px / scene.train[0].camera.fx
    return Task(
        train, load_views(scene.validation, config, ctx), Schedule(config), scene.extent,
        ctx.backend, torch.device(ctx.device), camera_error=error)


def _refuse_too_few_views(scene: Scene) -> None:
    if len(scene.train) < 2:
        raise TrainingError(
            f"{len(scene.train)} views are left to train on; at least 2 are needed.",
            hint="Run `recon ingest` with a smaller --holdout, such as every:8.")


def _refuse_tiny_units(scene: Scene) -> None:
    """Raises TrainingError where half of the scene lies in front of the rasterizer's near plane."""
    if scene.nearness < NEAR:
        raise TrainingError(
            f"Half of the points are nearer than {scene.nearness:.2g} units to a camera, and what "
            f"is nearer than {NEAR:g} is not drawn: the units of this scene are too large.",
            hint="Give it a scale with `recon sfm --scale-between A B METRES`, or scale the poses "
            "of the data set.")


def load_views(
    views: Sequence[View], config: RunConfig, ctx: StageContext
) -> list[TrainView]:
    """Returns the views at the training size, without those whose mask leaves next to nothing."""
    loaded, hidden = [], []
    for view in views:
        camera = fit_camera(view.camera, config.max_size)
        path = view.denoised if config.images == "denoised" else view.original
        image, mask = read_masked_image(path, view.mask, camera.width, camera.height)
        if leaves_enough(mask):
            loaded.append(TrainView(camera, image, mask))
        else:
            hidden.append(view.name)
    notice_hidden(hidden, "not trained on", ctx)
    return loaded








def gaussians_that_fit(scene: Scene, config: RunConfig, ctx: StageContext) -> int:
    """Returns how many Gaussians memory has room for, before the images are loaded.

    Raises:
        TrainingError: fewer than two views are left to train on.
    """
    _refuse_too_few_views(scene)
    one = _memory(scene, config, ctx, gaussians=1)
    return room(one, _free_bytes(ctx))


def _memory(
    scene: Scene, config: RunConfig, ctx: StageContext, *, gaussians: int
) -> MemoryEstimate:
    views = (*scene.train, *scene.validation)
    width, height = sizes_of([fit_camera(view.camera, config.max_size) for view in views])[0]
    return estimate(
        views=len(views), width=width, height=height, gaussians=gaussians,
        fused=ctx.backend == "numba", sh_degree=config.sh_degree,
        masks=sum(view.mask is not None for view in views))


def _free_bytes(ctx: StageContext) -> int:
    return (torch.cuda.mem_get_info()[0] if ctx.device == "cuda"
            else free_memory_bytes() // ctx.ranks.local)


def _check_memory(scene: Scene, config: RunConfig, ctx: StageContext) -> None:
    """Says what the run will take, and refuses what does not fit.

    Raises:
        TrainingError: there is not enough memory.
    """
    needed = _memory(scene, config, ctx, gaussians=config.max_gaussians)
    free = _free_bytes(ctx)
    logger.info("training takes %s at most; %.0f MB are free", needed.described(), free / 1e6)
    refuse_what_does_not_fit(needed, free)


def write_config(folder: Path, config: RunConfig) -> None:
    """Writes the options of a run beside its checkpoints."""
    write_bytes(folder / "config.json", json.dumps(config.hashed_fields(), indent=1).encode())


def read_config(folder: Path) -> RunConfig:
    """Returns the options that `write_config` wrote."""
    values = read_json(folder / "config.json")
    names = {item.name for item in dataclasses.fields(RunConfig)}
    return RunConfig(**{name: value for name, value in values.items() if name in names})


@contextmanager
def _deferred_interrupt() -> Iterator[list[int]]:
    """Yields a list that fills when Ctrl-C is pressed, so that a step is never cut in half.

    A second Ctrl-C interrupts at once. Outside the main thread signals are left alone.
    """
    pressed: list[int] = []

    def handle(number: int, _frame: object) -> None:
        if pressed:
            raise KeyboardInterrupt
        pressed.append(number)

    try:
        before = signal.signal(signal.SIGINT, handle)
    except ValueError:  # not the main thread
        yield pressed
        return
    try:
        yield pressed
    finally:
        signal.signal(signal.SIGINT, before)


class Pace:
    """Keeps large checkpoints of fast steps from taking the time that the steps should have.

    It changes when a state is saved, and never what is.

    Args:
        clock: seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock, self._last, self._took = clock, clock(), 0.0

    def allows(self) -> bool:
        """Tells whether another checkpoint keeps to its share of the time."""
        return self._took <= LONG_SAVE or (
            SAVE_SHARE * (self._clock() - self._last) >= self._took)

    @contextmanager
    def saving(self) -> Iterator[None]:
        """Times a checkpoint."""
        begin = self._clock()
        yield
        self._last = self._clock()
        self._took = self._last - begin


def run_fit(
    state: TrainState,
    task: Task,
    until: int,
    out: Path,
    ctx: StageContext,
    *,
    label: str,
    first: int = 0,
    earlier_seconds: float = 0.0,
    keep: dict[int, str] | None = None,
    end: int | None = None,
    checkpoint: str = CHECKPOINT,
    importance: Importance | None = None,
) -> None:
    """Fits until `until` steps with all of `ctx.ranks`, saving the state in `out` as it goes.

    Args:
        state: changed in place.
        task: views and plan.
        until: total number of steps.
        out: partial folder of the stage.
        ctx: progress, record and watcher.
        label: of the progress bar.
        first: step at which this stage's own work begins.
        earlier_seconds: training seconds before that.
        keep: file names under which the state after certain steps is kept.
        end: step at which this stage's own work ends; `until` where it is None.
        checkpoint: file name of the state that a later run goes on from.
        importance: gets the scores of these steps. They are in no checkpoint, so none is written
            while they are gathered.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed; the state has been saved.
    """
    log = Log(out / LOG, state.iteration, earlier_seconds)
    every, counted = task.schedule.config.checkpoint_every, [state.iteration]
    pace = Pace()
    with _deferred_interrupt() as pressed, ctx.progress.bar(
        label, (end or until) - first, unit="step", done=state.iteration - first
    ) as bar:
        def on_step(now: TrainState) -> None:
            bar.advance(now.iteration - counted[0])
            counted[0] = now.iteration
            ctx.watcher.step(now.iteration, now.splats)
            if keep and now.iteration in keep:
                save_state(out / keep[now.iteration], now)
            due = now.iteration % every == 0 and pace.allows()
            if importance is None and (due or pressed):
                with pace.saving():
                    save_state(out / checkpoint, now)
                ctx.record(now.iteration - first, (end or until) - first)
            if pressed:
                raise KeyboardInterrupt

        def on_report(report: Report) -> None:
            log.add(report)
            value = report.validation_psnr_db
            ctx.watcher.report(report.iteration, value)
            shown = "" if value is None else f", validation {value:.2f} dB"
            bar.note(f"loss {report.loss:.4f}{shown}, {report.gaussians:,} Gaussians")
            if report.goes_on_at is not None:
                logger.info("the validation views gain nothing more after step %d: the run goes "
                            "on at step %d, with falling rates", report.iteration,
                            report.goes_on_at)

        ctx.watcher.begin(
            label, end or until, [view.camera for view in task.train], state.splats)
        fit_together(
            state, dataclasses.replace(task, ranks=ctx.ranks), until, on_step=on_step,
            on_report=on_report, importance=importance, threads=ctx.threads,
            looks=lambda now: now % every == 0 or now in (keep or ()))
