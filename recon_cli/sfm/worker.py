"""The mapping process: `python -m recon_cli.sfm.worker JOB`, started by `process` alone.

It reports on its standard output (see `job`), logs to its standard error, and does not outlive its
parent: the end of its standard input ends it at once.
"""

from __future__ import annotations

import faulthandler
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import cv2
import filelock

from recon_cli.errors import ReconError, WorkspaceError
from recon_cli.processes import end_with_parent
from recon_cli.sfm import (
    database,
    fallbacks,
    join_segments,
    known_poses,
    matching,
    undistort,
)
from recon_cli.sfm.job import LOCK, LOG_FILE, SPLIT, MappingJob, Reporter, Result, StepLog
from recon_cli.signals import leave_to_parent
from recon_cli.workspace.disk import find_space_errno

LOCK_SECONDS = 30.0  # an orphan of a killed run is gone within a second or two

_FOLDERS = ("model", "sparse", "undistorted")  # steps that write a folder of their name


def work(job: MappingJob, report: Reporter) -> None:
    """Runs unfinished steps; SfmError if no model can be trusted, FormatError for a bad frame."""
    deadline = time.monotonic() + 60 * job.max_minutes
    actions: dict[str, Callable[[], Result]] = {
        "features": lambda: fallbacks.find_features(job, report),
        "matches": lambda: (
            known_poses.match_known if job.known_poses else fallbacks.match_first)(job, report),
        SPLIT: lambda: join_segments.split_by_view_graph(job),
        "model": lambda: (
            known_poses.build_known_model(job, report) if job.known_poses
            else fallbacks.build_model(job, report, deadline=deadline)),
        "sparse": lambda: undistort.place_model(job),
        "undistorted": lambda: undistort.undistort(job, report)}
    log = StepLog(job.out)
    if "features" in job.steps:
        _prepare_database(job, log)
    for step in job.steps:
        if log.result(step) is not None:
            continue
        log.forget_from(step)
        if step in ("features", "matches"):  # the models of finished attempts build on these
            (job.attempts / LOG_FILE).unlink(missing_ok=True)
        start, cpu = time.monotonic(), time.process_time()
        result = actions[step]()
        result["seconds"] = round(time.monotonic() - start, 2)
        result["cpu_seconds"] = round(time.process_time() - cpu, 2)
        log.finish(step, result, job.out / step if step in _FOLDERS else None)


def _prepare_database(job: MappingJob, log: StepLog) -> None:
    """Keeps the database of an interrupted run where it is intact, else starts a new one."""
    if not database.is_sound(job.database, job.names, len(job.groups)):
        log.forget_from("features")
        matching.create_database(job)
    for step in ("features", "matches"):
        result = log.result(step)
        # Further attempts add pairs.
        if result is not None and result["rows"] > database.progress(job.database, step):
            log.forget_from(step)


def _take_stdout() -> BinaryIO:
    """Returns the pipe to the parent; what native code prints from now on goes to the log."""
    stream = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    return stream


def main() -> None:
    """Runs the job named on the command line and reports errors to the parent."""
    report = Reporter(_take_stdout())
    leave_to_parent()
    faulthandler.enable()
    end_with_parent()
    job = MappingJob.read(Path(sys.argv[1]))
    cv2.setNumThreads(1)  # images are shared out among the threads of the job
    try:
        with filelock.FileLock(job.out / LOCK, timeout=LOCK_SECONDS):
            work(job, report)
    except filelock.Timeout:
        report.fail(WorkspaceError(
            f"Another process is still working in {job.out}.", hint="End it, then run this again."))
    except (ReconError, OSError) as error:
        report.fail(error)
    except Exception as error:
        number = find_space_errno(error)  # SQLite in COLMAP tells it in words
        if number is None:
            raise
        report.fail(OSError(number, os.strerror(number)))


if __name__ == "__main__":
    main()
