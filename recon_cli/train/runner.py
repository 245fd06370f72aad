"""A training on disk: checkpoints, the log, and a clean Ctrl-C; for the train and prune stages."""

from __future__ import annotations

import dataclasses
import signal
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from recon_cli.context import StageContext
from recon_cli.train.callbacks import Checkpointer, ProgressCallback, TrainLog
from recon_cli.train.distributed.data_parallel import fit_together
from recon_cli.train.importance import Importance
from recon_cli.train.state import TrainState
from recon_cli.train.task import Task

LOG = "log.jsonl"
CHECKPOINT = "checkpoint.safetensors"


@dataclass(frozen=True)
class Segment:
    """The steps of a run that one stage takes, and the files that they leave.

    Attributes:
        out: partial folder of the stage.
        label: of the progress bar.
        until: step at its end.
        first: step at which it begins.
        earlier_seconds: training seconds before that.
        checkpoint: file name of the state that a later run goes on from.
        keep: file names under which the state after certain steps is kept.
    """

    out: Path
    label: str
    until: int
    first: int = 0
    earlier_seconds: float = 0.0
    checkpoint: str = CHECKPOINT
    keep: Mapping[int, str] = field(default_factory=dict)


@contextmanager
def _deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Yields whether Ctrl-C was pressed, so that a step is never cut in half.

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
        yield lambda: bool(pressed)
        return
    try:
        yield lambda: bool(pressed)
    finally:
        signal.signal(signal.SIGINT, before)


def run_fit(
    state: TrainState, task: Task, until: int, segment: Segment, ctx: StageContext,
    importance: Importance | None = None,
) -> None:
    """Fits until `until` steps with all of `ctx.ranks`, saving the state as it goes.

    Args:
        state: changed in place.
        task: views and plan.
        until: total number of steps.
        segment: that these steps are part of.
        ctx: progress, record and callbacks.
        importance: gets the scores of these steps. They are in no checkpoint, so none is written
            while they are gathered.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed; the state has been saved.
    """
    out, total = segment.out, segment.until - segment.first
    with _deferred_interrupt() as interrupted, ctx.progress.bar(
        segment.label, total, unit="step", done=state.iteration - segment.first
    ) as bar:
        callbacks = (
            TrainLog(out / LOG, state.iteration, segment.earlier_seconds),
            *ctx.callbacks,
            ProgressCallback(bar, state.iteration),
            Checkpointer(
                state, None if importance else out / segment.checkpoint,
                task.schedule.config.checkpoint_every,
                {iteration: out / name for iteration, name in segment.keep.items()}, interrupted,
                lambda iteration: ctx.record(iteration - segment.first, total)))
        for callback in ctx.callbacks:
            callback.on_begin(
                segment.label, segment.until, [view.camera for view in task.train], state.splats)
        fit_together(state, dataclasses.replace(task, ranks=ctx.ranks), until, callbacks,
                     importance, ctx.threads)
