"""Starts the mapping process, shows its progress, and turns its failures into errors.

Native code can abort, hang or fill the memory; in a process of its own it does no harm to others.
"""

from __future__ import annotations

import logging
import math
import queue
import re
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path

from recon_cli.errors import ExitCode, ReconError, SfmError, format_count, name_command
from recon_cli.machine import POLL_SECONDS
from recon_cli.processes import start_module
from recon_cli.progress import Bar, Progress
from recon_cli.sfm import database
from recon_cli.sfm.job import LOCK, Event, MappingJob, Phase, PlaceJob, parse
from recon_cli.workspace.atomic import write_json
from recon_cli.workspace.disk import refuse_full_disk
from recon_cli.workspace.steps import StepFolder, make_way
from recon_cli.workspace.summaries import PlacedPart

_DOING = {
    "features": ("finding features", "frame"),
    "matches": ("matching frames", "pair"),
    "skeleton": ("following frames", "frame"),
    "coarse": ("matching coarse features", "pair"),
    "first": ("placing first cameras", "frame"),
    "mapping": ("placing cameras", "frame"),
    "bridge": ("matching learned features", "pair"),
    "joining": ("joining segments", "segment"),
    "undistorted": ("undistorting frames", "frame")}
# The step of a phase, where the names differ.
_STEP = {"skeleton": "features", "coarse": "matches", "first": "matches", "mapping": "model",
         "bridge": "model", "joining": "model"}
LOG = "log.txt"
logger = logging.getLogger("recon")
_LOG_TAIL = 64 * 1024  # bytes
_GLOG = re.compile(r"^[IWEF]\d{8} [\d:.]+ +\d+ \S+\] ")  # severity, time, thread, place in the code


class Monitor:
    """Shows one bar a phase, and calls `record` with (done, total) of what would survive a crash.

    Each step counts as many units as there are frames. `on_idle` is called once, when what follows
    keeps one core busy: the mapper, which must give the same bytes for any number of threads.
    """

    def __init__(
        self, job: MappingJob | PlaceJob, progress: Progress, record: Callable[[int, int], None],
        on_idle: Callable[[], None],
    ) -> None:
        self._job, self._progress, self._record = job, progress, record
        self._on_idle: Callable[[], None] | None = on_idle
        self._phase: Phase | None = None
        self._bar: Bar | None = None
        self._count = self._durable = 0
        self._open = ExitStack()

    def __enter__(self) -> Monitor:
        return self

    def __exit__(self, *exc: object) -> None:
        self._open.close()

    @property
    def doing(self) -> str:
        """What the process is doing, in words."""
        if self._phase is None:
            return "starting"
        text, unit = _DOING[self._phase.name]
        return f"{text} ({self._count} of {format_count(self._phase.total, unit)} done)"

    def show(self, event: Phase | int) -> None:
        """Shows that a phase begins, or how many units of it are done."""
        if isinstance(event, Phase):
            self._open.close()
            text, unit = _DOING[event.name]
            self._phase, self._count = event, event.done
            self._bar = self._open.enter_context(
                self._progress.bar(text, event.total, unit=unit, done=event.done))
            self._record_durable(event)
        elif self._phase is not None and self._bar is not None and event > self._count:
            self._bar.advance(event - self._count)
            self._count = event
            self._record_durable(self._phase)
        self._note_idle()

    def _note_idle(self) -> None:
        phase, on_idle = self._phase, self._on_idle
        if on_idle is None or phase is None:
            return
        if phase.name == "mapping" or (phase.name == "matches" and self._count >= phase.total):
            self._on_idle = None
            on_idle()

    def _record_durable(self, phase: Phase) -> None:
        """Records finished steps, and images or pairs in the database."""
        frames, steps = len(self._job.names), self._job.steps
        step = steps.index(_STEP.get(phase.name, phase.name))
        durable = phase.name in ("features", "matches")
        share = min(1.0, self._count / max(1, phase.total)) if durable else 0.0
        # A further attempt matches again, which does not undo earlier progress.
        self._durable = max(self._durable, round((step + share) * frames))
        self._record(self._durable, len(steps) * frames)


class CrashError(SfmError):
    """The mapping process crashed for reasons unrelated to the capture."""


class TimeUpError(SfmError):
    """The mapping process took more than --max-minutes."""


def run_job(
    job: MappingJob, *, progress: Progress, record: Callable[[int, int], None],
    on_idle: Callable[[], None],
) -> None:
    """Runs a job in a process of its own; its results are in the step log. See also `Monitor`.

    Where the time is up, the best of the attempts that have ended is the result.
    SfmError if no model can be trusted or no attempt has ended in time; CrashError if the process
    crashed; FormatError if a frame cannot be read; WorkspaceError if another process works in the
    folder; OSError as met in the process: the disk is full or not writable.
    """
    try:
        _run(job, job.max_minutes, Monitor(job, progress, record, on_idle))
    except TimeUpError as error:
        if not job.tried.steps:
            raise
        logger.warning("sfm: %s The best model so far is taken.", error.message)
        _run(replace(job, max_minutes=0.0), job.max_minutes,
             Monitor(job, progress, record, on_idle))


def place_part(
    job: PlaceJob, *, progress: Progress, record: Callable[[int, int], None]
) -> PlacedPart:
    """Places a part in a process of its own and returns what is known of it; raises as `run_job`.

    ConfigError if a place of --scale-between is unknown; SfmError if what tells the scale
    contradicts itself.
    """
    _run(job, math.inf, Monitor(job, progress, record, lambda: None))
    placed = StepFolder(job.out).find(job.steps[-1], PlacedPart)
    assert placed is not None, "the mapping process ended without a result"
    return placed


def _run(job: MappingJob | PlaceJob, max_minutes: float, monitor: Monitor) -> None:
    """Runs a job for so many minutes at most; raises as `run_job`."""
    deadline = time.monotonic() + 60 * max_minutes
    file = job.out / "job.json"
    write_json(file, job.to_json())
    for kept in (job.out / LOG, job.out / LOCK):
        make_way(kept)
    try:
        with _start(job, file) as child, monitor:
            for event in _events(child):
                if isinstance(event, (ReconError, OSError)):
                    refuse_full_disk(job.out)  # which may be why there is no model
                    raise event
                if time.monotonic() > deadline:
                    raise _timeout_error(max_minutes, monitor)
                if isinstance(event, str):
                    logger.warning("sfm: %s", event)
                elif event is not None:
                    monitor.show(event)
            try:
                code = child.wait(timeout=max(1.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired as error:  # native code may hang on its way out
                raise _timeout_error(max_minutes, monitor) from error
            if code != 0:
                refuse_full_disk(job.out)
                raise _crash_error(job.out / LOG, code, monitor)
    except BaseException:
        if isinstance(job, MappingJob) and monitor.doing != "starting":
            with suppress(OSError):  # the error that led here says more
                database.record_rows(job.database)  # what was found before has been checked
        raise
    finally:
        for leftover in (file, job.out / LOCK):
            leftover.unlink(missing_ok=True)


@contextmanager
def _start(job: MappingJob | PlaceJob, file: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Yields the running process and kills it on leaving, however that happens.

    What several threads share is shared out in here: sums that BLAS or OpenMP split among threads
    differ with their number.
    """
    with (job.out / LOG).open("ab") as log, start_module(
        "recon_cli.sfm.mapping.worker", type(job).__name__, str(file), folder=job.out,
        out=subprocess.PIPE, errors=log, OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1",
    ) as child:
        try:
            yield child
        finally:
            child.kill()


def _events(child: subprocess.Popen[bytes]) -> Iterator[Event | None]:
    """Yields the events of the process until its output ends, and None every POLL_SECONDS."""
    lines: queue.Queue[bytes | None] = queue.Queue()
    assert child.stdout is not None
    stream = child.stdout

    def read() -> None:
        for line in stream:
            lines.put(line)
        lines.put(None)

    threading.Thread(target=read, daemon=True).start()
    while True:
        try:
            line = lines.get(timeout=POLL_SECONDS)
        except queue.Empty:
            yield None
            continue
        if line is None:
            return
        yield parse(line)


def _timeout_error(max_minutes: float, monitor: Monitor) -> TimeUpError:
    return TimeUpError(
        f"The cameras were not found within {max_minutes:g} minutes; the last step was "
        f"{monitor.doing}.",
        hint="Allow more time with --max-minutes (features and matches found so far are kept), or "
        f"use fewer frames ({name_command('ingest --frames N')}) or --max-features 1024.")


def _crash_error(log: Path, code: int, monitor: Monitor) -> CrashError:
    names = {number.value: number.name for number in signal.Signals}
    how = f"stopped with exit code {code}" if code >= 0 else (
        f"was ended by {names.get(-code, f'signal {-code}')}")
    hint = "Run it again: features and matches found so far are kept."
    if code == ExitCode.SIGNAL - ExitCode.KILLED:
        hint = (
            "The system may have run out of memory; try --max-features 1024 or fewer frames "
            f"({name_command('ingest --frames N')}).")
    return CrashError(
        f"The mapping process {how} while it was {monitor.doing}. The last error in {log}: "
        f"{last_error(log)}", hint=hint)


def last_error(log: Path) -> str:
    """Returns the last line of a log that reports an error, else its last line."""
    with log.open("rb") as file:
        file.seek(max(0, log.stat().st_size - _LOG_TAIL))
        text = file.read().decode(errors="replace")
    lines = [line.strip() for line in text.splitlines()]
    lines = [line for line in lines if line and not line.startswith("@")]  # native stack frames
    errors = [
        line for line in lines
        if line.startswith(("E2", "F2")) or re.search(r"\b\w*Error\b|\*\*\* SIG|Fatal", line)]
    return _GLOG.sub("", (errors or lines or ["nothing."])[-1])
