"""The mapping process: `python -m recon_cli.sfm.worker JOB`, started by `process` alone.

It speaks on its standard output (see `protocol`), logs to its standard error, and lives no longer
than its parent: the end of its standard input ends it, in the midst of whatever it does.
"""

from __future__ import annotations

import faulthandler
import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import filelock

from recon_cli.errors import ReconError, WorkspaceError
from recon_cli.sfm import align_world, database, fallbacks, features, known_poses, undistort
from recon_cli.sfm.job import LOCK, Job, Reporter
from recon_cli.sfm.step_log import Ledger, Result

LOCK_SECONDS = 30.0  # an orphan of a killed run is gone within a second or two

_FOLDERS = ("model", "sparse", "undistorted")  # steps that write a folder of their name


def work(job: Job, report: Reporter) -> None:
    """Does every step that is not finished yet.

    Raises:
        SfmError: no model came out, or none to trust.
        FormatError: a frame cannot be read.
    """
    deadline = time.monotonic() + 60 * job.max_minutes
    actions = _actions(job, report, deadline)
    ledger = Ledger(job.out)
    if "features" in job.steps:
        _prepare_database(job, ledger)
    for step in job.steps:
        if ledger.result(step) is not None:
            continue
        ledger.forget_from(step)
        if step in ("features", "matches"):  # the models of finished rungs build on these
            shutil.rmtree(job.rungs, ignore_errors=True)
        start = time.monotonic()
        result = actions[step]()
        result["seconds"] = round(time.monotonic() - start, 2)
        ledger.finish(step, result, job.out / step if step in _FOLDERS else None)


def _actions(job: Job, report: Reporter, deadline: float) -> dict[str, Callable[[], Result]]:
    """Returns what is done in each step."""
    cameras: dict[str, Callable[[], Result]] = {
        "matches": lambda: fallbacks.match_first(job, report),
        "model": lambda: fallbacks.climb(job, report, deadline=deadline),
    }
    if job.known_poses:
        cameras = {
            "matches": lambda: known_poses.match(job, report),
            "model": lambda: known_poses.build(job, report),
        }
    return {
        "features": lambda: features.extract(job, report),
        **cameras,
        "sparse": lambda: align_world.place_model(job),
        "undistorted": lambda: undistort.undistort(job, report),
    }


def _prepare_database(job: Job, ledger: Ledger) -> None:
    """Keeps the database of an interrupted run where it is intact, else starts a new one."""
    if not database.is_sound(job.database, job.names, len(job.groups)):
        ledger.forget_from("features")
        features.create_database(job)
    for step in ("features", "matches"):
        result = ledger.result(step)
        # Further rungs of the ladder add pairs.
        if result is not None and result["rows"] > database.progress(job.database, step):
            ledger.forget_from(step)


def _end_with_parent() -> None:
    """Ends this process when its standard input does, which is when its parent is gone."""

    def watch() -> None:
        while os.read(0, 1):  # not sys.stdin, whose lock the interpreter wants at its own end
            pass
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _take_stdout() -> BinaryIO:
    """Returns the pipe to the parent; what native code prints from now on goes to the log."""
    stream = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    return stream


def main() -> None:
    """Runs the job named on the command line and reports what the parent shall raise."""
    report = Reporter(_take_stdout())
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to answer
    faulthandler.enable()
    _end_with_parent()
    job = Job.read(Path(sys.argv[1]))
    try:
        with filelock.FileLock(job.out / LOCK, timeout=LOCK_SECONDS):
            work(job, report)
    except filelock.Timeout:
        report.failed(WorkspaceError(
            f"Another process still works in {job.out}.", hint="End it, then run this again."))
    except (ReconError, OSError) as error:
        report.failed(error)


if __name__ == "__main__":
    main()
