"""A long capture in overlapping segments, each mapped by a job of its own.

A segment is a mapping job on some of the frames, in a folder laid out as that of the stage: it runs
by a command of its own, here or on another machine, keeps the steps that it finished, and fails
alone. `join_segments` makes one model of them.
"""

from __future__ import annotations

import dataclasses
import itertools
import shutil
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from recon_cli.errors import (
    BackendError,
    ConfigError,
    ExitCode,
    FormatError,
    ReconError,
    SfmError,
    WorkspaceError,
)
from recon_cli.io.tracks import Tracks
from recon_cli.jobs.executor import Command, Executor
from recon_cli.jobs.shared_jobs import JobEnd, SharedJob, run_jobs
from recon_cli.progress import NullProgress, Progress, limit_rate
from recon_cli.sfm.features.keyframes import choose_keyframes
from recon_cli.sfm.job import SPLIT, MappingJob
from recon_cli.sfm.limits import FEW_FRAMES, MIN_STRETCH
from recon_cli.sfm.mapping.process import CrashError, run_job
from recon_cli.sfm.results import SplitResult, StepResult
from recon_cli.workspace.atomic import read_json, write_json
from recon_cli.workspace.layout import disk_errors
from recon_cli.workspace.steps import StepFolder

Names = tuple[str, ...]

# Frames of a segment, and those that it has in common with the next one. Shorter segments spend
# more on what they share, longer ones are fewer jobs.
LENGTH, SEGMENT_OVERLAP = 150, 25
TRIES = 2  # of a mapping process that is killed, perhaps for want of memory beside others
COMMAND = "map-segment"  # of recon, which takes JOB
# in the folder of a segment: what to do, how much of it is done, and what the command printed
JOB, PROGRESS, OUTPUT = "segment.json", "progress.json", "output.txt"
_ERRORS: dict[int, type[ReconError]] = {
    kind.exit_code: kind for kind in (FormatError, BackendError, WorkspaceError)}

# Gives what runs so many commands, and the threads that each of them has.
Start = Callable[[int], tuple[Executor, int]]


def count_segments(frames: int, asked: str) -> int:
    """Returns how many segments so many frames are mapped in; 1: they are mapped as one.

    `asked` is auto, off or a number; ConfigError if it is more than the frames allow.
    """
    if asked == "off":
        return 1
    if asked == "auto":
        step = LENGTH - SEGMENT_OVERLAP
        return 1 if frames <= FEW_FRAMES else -(-(frames - SEGMENT_OVERLAP) // step)
    most = max(1, frames // MIN_STRETCH)
    if int(asked) > most:
        raise ConfigError(
            f"{frames} frames are too few for {asked} segments of at least {MIN_STRETCH} frames.",
            hint=f"Give at most --segments {most}.")
    return int(asked)


def count_mapped(job: MappingJob) -> int:
    """Returns how many frames of a job cameras are sought for first: the keyframes of a video."""
    if job.tracks is None:
        return len(job.names)
    tracks = Tracks.read(job.tracks)
    return len(choose_keyframes(tracks)) if len(tracks.names) == len(job.names) else len(job.names)


def overlap(frames: int, count: int) -> int:
    """Returns how many frames two segments in a row have in common: fewer of few frames."""
    return min(SEGMENT_OVERLAP, frames // (2 * count))


def split_by_time(names: Sequence[str], count: int) -> tuple[Names, ...]:
    """Returns the names of each segment, in their order; all segments are about equally long."""
    common = overlap(len(names), count)
    cuts = [round(index * (len(names) - common) / count) for index in range(count + 1)]
    return tuple(tuple(names[start:end + common])
                 for start, end in itertools.pairwise(cuts))


@dataclass(frozen=True)
class SegmentRuns:
    """What became of the segments of a job."""

    job: MappingJob  # of the capture, which joins them
    failed: Mapping[int, str]  # why some have no model, by index
    cpu_seconds: Mapping[str, float]  # that each step took, in all segments together


def map_segments(
    job: MappingJob, count: int, start: Start, *, progress: Progress,
    record: Callable[[int, int], None],
) -> SegmentRuns:
    """Maps a job in segments by commands of their own; those that have a model are kept.

    A segment that fails stops no other. SfmError if all do, or the time is up; BackendError if the
    machines cannot be reached any more; otherwise raises what `run_job` raises.
    """
    deadline = time.monotonic() + 60 * job.max_minutes
    if all(name in job.times for name in job.names):
        parts = split_by_time(job.names, count)
    else:
        job = dataclasses.replace(job, split=count)
        run_job(dataclasses.replace(job, last=SPLIT), progress=progress, record=record,
                on_idle=lambda: None)
        split = StepFolder(job.out).find(SPLIT, SplitResult)
        assert split is not None, "the mapping process ended without a split"
        parts = split.segments
    job = dataclasses.replace(job, segments=parts)
    executor, threads = start(len(parts))
    try:
        jobs = [_segment_job(job, index, threads) for index in range(len(parts))]
        failed = _run_all(jobs, executor, deadline, progress, record)
    finally:
        executor.close()
    if len(failed) == len(parts):
        raise SfmError(f"None of the {len(parts)} segments could be mapped: {failed[0]}",
                       hint="Try --segments off, more frames, or a slower walk.")
    cpu: dict[str, float] = defaultdict(float)
    for each, step in itertools.product(jobs, jobs[0].steps):
        result = StepFolder(each.out).find(step, StepResult)
        cpu[step] += result.cpu_seconds if result else 0.0
    left = (deadline - time.monotonic()) / 60
    if left <= 0:
        raise SfmError(f"The segments were not mapped within {job.max_minutes:g} minutes.",
                       hint="Allow more time with --max-minutes: finished segments are kept.")
    return SegmentRuns(job.after(job.max_minutes - left), failed, cpu)


def remove_segments(job: MappingJob) -> None:
    """Deletes the folders of the segments."""
    shutil.rmtree(job.segment(0).parent, ignore_errors=True)


def _segment_job(job: MappingJob, index: int, threads: int) -> MappingJob:
    """Returns the job of a segment; its folder is emptied where it holds one of other frames."""
    names, folder = job.segments[index], job.segment(index)
    groups = [dataclasses.replace(group, names=tuple(sorted(set(group.names).intersection(names))))
              for group in job.groups]
    segment = dataclasses.replace(
        job, out=folder, groups=tuple(group for group in groups if group.names), threads=threads,
        segments=(), split=0, is_segment=True)
    listed = folder / "frames.txt"
    text = "".join(f"{name}\n" for name in names)
    if not job.split and not (listed.is_file() and listed.read_bytes() == text.encode()):
        shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True, exist_ok=True)
    if job.tracks is not None:
        tracks = Tracks.read(job.tracks)
        chosen = {row: name for row, name in enumerate(tracks.names) if name in set(names)}
        segment = dataclasses.replace(segment, tracks=folder / "tracks.safetensors")
        tracks.select(chosen).write(folder / "tracks.safetensors")
    listed.write_bytes(text.encode())
    return segment


def _run_all(
    jobs: Sequence[MappingJob], executor: Executor, deadline: float, progress: Progress,
    record: Callable[[int, int], None],
) -> dict[int, str]:
    """Returns why segments failed, by index."""
    total = sum(len(job.names) for job in jobs)

    def shared(index: int) -> SharedJob:
        job, file = jobs[index], jobs[index].out / JOB

        def look() -> tuple[float, str]:
            share = _share(job)
            return share, f"{share * len(job.names):.0f}/{len(job.names)} frames"

        def prepare() -> str:
            left = (deadline - time.monotonic()) / 60
            if left <= 0:
                return "no time was left for it"
            job.after(job.max_minutes - left).write(file)
            return ""

        command = Command((COMMAND, str(file)), job.out, job.out / OUTPUT)
        return SharedJob(f"segment {index}", command, look, len(job.names), prepare)

    def refuse(shared: SharedJob, end: JobEnd) -> None:
        # Not a failure of the capture, but of the machine.
        if 0 < end.code < ExitCode.SIGNAL and end.code != SfmError.exit_code:
            raise _ERRORS.get(end.code, SfmError)(
                f"{shared.name.capitalize()} could not be mapped: {end.reason}",
                hint=f"Finished segments are kept. Its output is in {shared.command.log}.")

    ends = run_jobs(
        [shared(index) for index in range(len(jobs))], executor, progress, report=refuse,
        record=lambda share: record(int(share * total), 2 * total))  # the join is the other half
    return {index: end.reason for index, end in enumerate(ends) if end.reason}


def _share(job: MappingJob) -> float:
    """Returns how much of a segment is done."""
    if StepFolder(job.out).is_finished(job.last):
        return 1.0
    try:
        done, total = read_json(job.out / PROGRESS, list)
        return float(done) / float(total)
    except (FormatError, TypeError, ValueError, ZeroDivisionError):  # it has not begun
        return 0.0


def map_segment(file: Path) -> None:
    """Runs the job of a segment, whose file is given; what another process can see of it is there.

    Raises what `run_job` raises.
    """
    job = MappingJob.read(file)
    record = limit_rate(lambda *parts: write_json(job.out / PROGRESS, parts))
    with disk_errors(job.out, "mapping a segment"):
        for left in reversed(range(TRIES)):
            try:
                run_job(job, progress=NullProgress(), record=record, on_idle=lambda: None)
                break
            except CrashError:
                if not left:
                    raise
