"""Starts the mapping process, shows how far it is, and makes errors of its ways to fail.

Native code can abort, hang or fill the memory; in a process of its own it takes nothing with it.
"""

from __future__ import annotations

import os
import queue
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from recon_cli.errors import SfmError
from recon_cli.mapping import protocol
from recon_cli.mapping.job import LOCK, Job
from recon_cli.mapping.monitor import Monitor
from recon_cli.progress import Progress

LOG = "log.txt"
POLL_SECONDS = 0.25
_LOG_TAIL = 64 * 1024  # bytes
_GLOG = re.compile(r"^[IWEF]\d{8} [\d:.]+ +\d+ \S+\] ")  # severity, time, thread, place in the code


def run_job(
    job: Job,
    *,
    progress: Progress,
    record: Callable[[int, int], None],
) -> None:
    """Runs a job in a process of its own; its results stand in the ledger.

    Args:
        job: what to do, and after how many minutes the process is killed.
        progress: for a bar a phase.
        record: called with (done, total) of what would survive a crash.

    Raises:
        SfmError: there is no model to trust, the time is up, or the process died.
        FormatError: a frame cannot be read.
        WorkspaceError: another process works in the same folder.
        OSError: as met in the process: the disk is full or not writable.
    """
    max_minutes = job.max_minutes
    deadline = time.monotonic() + 60 * max_minutes
    file = job.out / "job.json"
    job.write(file)
    try:
        with _started(job, file) as child, Monitor(job, progress, record) as monitor:
            for event in _events(child):
                if isinstance(event, protocol.Failed):
                    raise event.error
                if time.monotonic() > deadline:
                    raise _too_late(max_minutes, monitor)
                monitor.show(event)
            try:
                code = child.wait(timeout=max(1.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired as error:  # native code may hang on its way out
                raise _too_late(max_minutes, monitor) from error
            if code != 0:
                raise _crashed(job.out / LOG, code, monitor)
    finally:
        for leftover in (file, job.out / LOCK):
            leftover.unlink(missing_ok=True)


@contextmanager
def _started(job: Job, file: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Yields the running process and kills it on leaving, however that happens."""
    threads = str(job.threads)
    # In the stage's folder, for `python -m` looks for modules in the current one first.
    with (job.out / LOG).open("ab") as log, subprocess.Popen(
        [sys.executable, "-m", "recon_cli.mapping.worker", str(file)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, cwd=job.out,
        env={**os.environ, "OMP_NUM_THREADS": threads, "OPENBLAS_NUM_THREADS": threads},
    ) as child:
        try:
            yield child
        finally:
            child.kill()


def _events(child: subprocess.Popen[bytes]) -> Iterator[protocol.Event | None]:
    """Yields what the process says until it falls silent, and None whenever a while has passed."""
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
        yield protocol.parse(line)


def _too_late(max_minutes: float, monitor: Monitor) -> SfmError:
    return SfmError(
        f"The cameras were not found within {max_minutes:g} minutes: it was {monitor.doing}.",
        hint="Allow more time with --max-minutes (features and matches found so far are kept), or "
        "make it quicker with fewer frames (recon ingest --frames N) or --max-features 1024.")


def _crashed(log: Path, code: int, monitor: Monitor) -> SfmError:
    how = f"was ended by {_signal_name(-code)}" if code < 0 else f"stopped with exit code {code}"
    hint = "Run it again: features and matches found so far are kept."
    if code == -signal.SIGKILL:
        hint = (
            "The system may have been short of memory; try --max-features 1024 or fewer frames "
            "(recon ingest --frames N).")
    return SfmError(
        f"The mapping process {how} while it was {monitor.doing}. Its log {log} ends with: "
        f"{gist(log)}", hint=hint)


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def gist(log: Path) -> str:
    """Returns the last line of a log that tells of an error, else its last line."""
    with log.open("rb") as file:
        file.seek(max(0, log.stat().st_size - _LOG_TAIL))
        text = file.read().decode(errors="replace")
    lines = [line.strip() for line in text.splitlines()]
    lines = [line for line in lines if line and not line.startswith("@")]  # native stack frames
    telling = [
        line for line in lines
        if line.startswith(("E2", "F2")) or re.search(r"\b\w*Error\b|\*\*\* SIG|Fatal", line)
    ]
    last = (telling or lines or ["nothing."])[-1]
    return _GLOG.sub("", last)
