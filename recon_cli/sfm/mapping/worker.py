"""The mapping process: `python -m recon_cli.sfm.mapping.worker KIND JOB`, which `process` starts.

It reports on its standard output (see `job`), logs to its standard error, and does not outlive its
parent: the end of its standard input ends it at once.
"""

from __future__ import annotations

import faulthandler
import os
import shutil
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import cv2
import filelock

from recon_cli.errors import ReconError, WorkspaceError
from recon_cli.processes import end_with_parent
from recon_cli.sfm import database
from recon_cli.sfm.features import matching
from recon_cli.sfm.job import LOCK, ORDER, SPLIT, MappingJob, PlaceJob, Reporter
from recon_cli.sfm.mapping import fallbacks
from recon_cli.sfm.poses import known_poses
from recon_cli.sfm.results import RESULTS, CountedResult, StepResult
from recon_cli.sfm.segments import join_segments
from recon_cli.sfm.views import undistort
from recon_cli.signals import leave_to_parent
from recon_cli.workspace.atomic import read_json
from recon_cli.workspace.disk import find_space_errno
from recon_cli.workspace.steps import StepFolder

LOCK_SECONDS = 30.0  # an orphan of a killed run is gone within a second or two


def work(job: MappingJob, report: Reporter) -> None:
    """Runs unfinished steps; SfmError if no model can be trusted, FormatError for a bad frame."""
    actions: dict[str, Callable[[], StepResult]] = {
        "features": lambda: (known_poses if job.known_poses else fallbacks).find_features(
            job, report),
        "matches": lambda: (
            known_poses.match_known if job.known_poses else fallbacks.match_first)(job, report),
        SPLIT: lambda: join_segments.split_by_view_graph(job),
        "model": lambda: (
            known_poses.build_known_model if job.known_poses else fallbacks.build_model)(
                job, report)}
    log = StepFolder(job.out)
    rematch = _forget_damaged(job, log, report)
    mapped = not job.is_segment and log.is_finished("model")
    if "features" in job.steps and not mapped:  # else nothing reads it any more
        _prepare_database(job, log, report, rematch=rematch)
    for step in job.steps:
        if log.find(step, RESULTS[step]) is not None:
            continue
        _forget_from(log, step)
        start, cpu = time.monotonic(), time.process_time()
        found = actions[step]()
        result = replace(found, seconds=round(time.monotonic() - start, 2),
                         cpu_seconds=round(time.process_time() - cpu, 2))
        if step in ("features", "matches"):
            database.record_rows(job.database)
        log.finish(step, result, (
            job.parts, job.out / join_segments.REPORT) if step == "model" else ())


def _forget_from(log: StepFolder, step: str) -> None:
    """Takes back a step and all that build on it."""
    log.forget(*ORDER[ORDER.index(step):])


def _forget_damaged(job: MappingJob, log: StepFolder, report: Reporter) -> bool:
    """Forgets finished steps whose files were damaged since, and what builds on them.

    Returns whether all matches must be found anew.
    """
    step = log.find_damage()
    if step:
        report.tell(f"unfinished work is damaged: {step} is made anew")
        _forget_from(log, step)
    if step == "model" or job.tried.find_damage():
        shutil.rmtree(job.attempts, ignore_errors=True)
        _forget_from(log, "matches")
        # later attempts may have added pairs, with which the first ones would find other models
        return True
    return False


def _prepare_database(
    job: MappingJob, log: StepFolder, report: Reporter, *, rematch: bool
) -> None:
    """Keeps the database of an interrupted run where it is intact, else starts a new one."""
    sound = database.is_sound(job.database, job.names, len(job.groups))
    damaged = database.restore_rows(job.database) if sound else "features"
    if damaged and log.is_finished(damaged):
        report.tell(f"unfinished work is damaged: {damaged} are found anew")
    if damaged == "features":
        _forget_from(log, "features")
        matching.create_database(job)
    elif damaged or rematch:
        _forget_from(log, "matches")
        database.clear_matches(job.database)
    for step in ("features", "matches"):
        result = log.find(step, CountedResult)
        # Further attempts add pairs.
        if result is not None and result.rows > database.progress(job.database, step):
            _forget_from(log, step)


def _take_stdout() -> BinaryIO:
    """Returns the pipe to the parent; what native code prints from now on goes to the log."""
    stream = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    return stream


def main() -> None:
    """Runs the job of the kind and file on the command line; reports errors to the parent."""
    report = Reporter(_take_stdout())
    leave_to_parent()
    faulthandler.enable()
    end_with_parent()
    kind, file = sys.argv[1:]
    job = (PlaceJob if kind == PlaceJob.__name__ else MappingJob).from_json(
        read_json(Path(file), dict))
    cv2.setNumThreads(1)  # images are shared out among the threads of the job
    try:
        with filelock.FileLock(job.out / LOCK, timeout=LOCK_SECONDS):
            if isinstance(job, PlaceJob):
                undistort.place(job, report)
            else:
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
