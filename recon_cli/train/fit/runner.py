"""A training on disk: checkpoints, the log, and a clean Ctrl-C; for the train and prune stages."""

from __future__ import annotations

import dataclasses
import json
import logging
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from recon_cli.context import StageContext, TrainCallback, TrainReport
from recon_cli.progress import Bar
from recon_cli.scene.splats import Splats
from recon_cli.signals import Interrupted, deferring
from recon_cli.train.fit.importance import Importance
from recon_cli.train.fit.loop import fit
from recon_cli.train.fit.state import LONG_SAVE, SAVE_SHARE, TrainState, save_state
from recon_cli.train.fit.task import Task
from recon_cli.workspace import steps
from recon_cli.workspace.atomic import write_bytes
from recon_cli.workspace.summaries import LogRow

CHECKPOINT = "checkpoint.safetensors"


@dataclass(frozen=True)
class RunSegment:
    """The steps of a run that one stage takes, and the files that they leave."""

    out: Path  # partial folder of the stage
    label: str  # of the progress bar
    until: int  # step at its end
    first: int = 0  # step at which it begins
    earlier_seconds: float = 0.0  # training seconds before that
    checkpoint: str = CHECKPOINT  # file name of the state that a later run continues
    # file names under which the state after certain steps is kept
    keep: Mapping[int, str] = field(default_factory=dict)


def run_fit(
    state: TrainState, task: Task, until: int, segment: RunSegment, ctx: StageContext,
    importance: Importance | None = None,
) -> None:
    """Fits until `until` steps, saving the state as it goes.

    No checkpoints are written while `importance` gets the scores of the steps: they hold no scores.

    Raises:
        Interrupted: a signal asked to end; the state has been saved.
    """
    out, total = segment.out, segment.until - segment.first
    with deferring() as interrupted, ctx.progress.bar(
        segment.label, total, unit="step", done=state.iteration - segment.first
    ) as bar:
        log = TrainLog(out / LogRow.FILE, state.iteration, segment.earlier_seconds)
        callbacks = (
            log,
            *ctx.callbacks,
            ProgressCallback(bar, state.iteration),
            Checkpointer(
                state, None if importance else out / segment.checkpoint,
                task.schedule.config.checkpoint_every,
                {iteration: out / name for iteration, name in segment.keep.items()}, interrupted,
                log.keep, lambda iteration: ctx.record(iteration - segment.first, total)))
        for callback in ctx.callbacks:
            callback.on_begin(
                segment.label, segment.until, [view.camera for view in task.train], state.splats)
        fit(state, task, until, callbacks, importance)


logger = logging.getLogger("recon")


def seconds_at(log: Path, iteration: int, *, clock: str = "seconds") -> float:
    """Returns the training seconds that a log counts up to an iteration, by one of its clocks."""
    seconds = 0.0
    for row in LogRow.read_all(log):
        if row.iteration <= iteration:
            seconds = float(getattr(row, clock))
    return seconds


class TrainLog(TrainCallback):
    """Writes one JSON line a report; lines after the checkpoint of a crashed run are cut off."""

    def __init__(self, path: Path, iteration: int, earlier_seconds: float) -> None:
        self._path = path
        lines = path.read_text(encoding="utf-8").splitlines(True) if path.exists() else []
        # a kill in mid-write leaves a last line without its end
        complete = [line for line in lines if line.endswith("\n")]
        valid = [line for line, row in zip(complete, LogRow.read_all(path), strict=True)
                 if row.iteration <= iteration]
        if not valid:  # a branch starts where the other run stood
            first = {"iteration": iteration, "seconds": earlier_seconds, "cpu_seconds": 0.0}
            valid = [json.dumps(first) + "\n"]
        write_bytes(path, "".join(valid).encode())
        self.keep()
        self._earlier = seconds_at(path, iteration)
        self._earlier_cpu = seconds_at(path, iteration, clock="cpu_seconds")

    def on_report(self, report: TrainReport) -> None:
        """Appends a report; its seconds count from the very start of training."""
        self._write(LogRow(**dataclasses.asdict(report)))

    def add_idle(self, iteration: int, seconds: float, cpu_seconds: float) -> None:
        """Counts time in which no step was taken, and keeps the log for a later run."""
        self._write(LogRow(iteration=iteration, seconds=seconds, cpu_seconds=cpu_seconds))
        self.keep()

    def keep(self) -> None:
        """Records the log up to here, for a later run that continues from here."""
        steps.expect_growth(self._path)

    def _write(self, row: LogRow) -> None:
        row = dataclasses.replace(
            row, seconds=round(self._earlier + row.seconds, 3),
            cpu_seconds=round(self._earlier_cpu + row.cpu_seconds, 3))
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row.to_json()) + "\n")


class ProgressCallback(TrainCallback):
    """Draws a training as a progress bar."""

    def __init__(self, bar: Bar, iteration: int) -> None:
        self._bar, self._counted = bar, iteration

    def on_step(self, iteration: int, splats: Splats) -> None:  # noqa: ARG002
        """Advances the bar."""
        self._bar.advance(iteration - self._counted)
        self._counted = iteration

    def on_report(self, report: TrainReport) -> None:
        """Shows loss, PSNR and count beside the bar."""
        psnr = report.validation_psnr_db
        validation = "" if psnr is None else f", validation {psnr:.2f} dB"
        self._bar.note(f"loss {report.loss:.4f}{validation}, {report.gaussians:,} Gaussians")
        if report.skip_to_iteration is not None:
            logger.info("the validation score is flat after step %d: the run continues at "
                        "step %d, with falling rates", report.iteration, report.skip_to_iteration)


class CheckpointThrottle:
    """Limits the time that checkpoints take; changes when a state is saved, never its content."""

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock, self._last, self._took = clock, clock(), 0.0

    def allows(self) -> bool:
        """Tells whether another checkpoint keeps to its share of the time."""
        return self._took <= LONG_SAVE or (SAVE_SHARE * (self._clock() - self._last) >= self._took)

    @contextmanager
    def saving(self) -> Iterator[None]:
        """Times a checkpoint."""
        begin = self._clock()
        yield
        self._last = self._clock()
        self._took = self._last - begin


class Checkpointer(TrainCallback):
    """Saves the state now and then, at certain steps for good, and when Ctrl-C was pressed.

    `keep` holds files by step, `every` is the least distance of checkpoints in steps. Without
    `path` there are none, as while scores are gathered. `prepare` is called before each, and
    `record` gets the steps done after it.
    """

    def __init__(
        self, state: TrainState, path: Path | None, every: int, keep: Mapping[int, Path],
        interrupted: Callable[[], int], prepare: Callable[[], None],
        record: Callable[[int], None],
    ) -> None:
        self._state, self._path, self._every, self._keep = state, path, every, keep
        self._interrupted, self._prepare, self._record = interrupted, prepare, record
        self._throttle = CheckpointThrottle()

    def needs_step(self, iteration: int) -> bool:
        """Returns whether a state is saved after this step."""
        return iteration % self._every == 0 or iteration in self._keep

    def on_step(self, iteration: int, splats: Splats) -> None:  # noqa: ARG002
        """Saves the state where that is due; raises Interrupted after a signal."""
        interrupted = self._interrupted()
        if iteration in self._keep:
            save_state(self._keep[iteration], self._state)
        due = iteration % self._every == 0 and self._throttle.allows()
        if self._path is not None and (due or interrupted):
            with self._throttle.saving():
                self._prepare()
                save_state(self._path, self._state)
            self._record(iteration)
        if interrupted:
            raise Interrupted(interrupted)
