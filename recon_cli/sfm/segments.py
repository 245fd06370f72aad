"""A long capture in overlapping segments, each mapped by a job of its own.

A segment is a mapping job on some of the frames, in a folder laid out as that of the stage: it runs
in a process of its own, keeps the steps that it finished, and fails alone. `join_segments` makes
one model of them.
"""

from __future__ import annotations

import dataclasses
import itertools
import shutil
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass

from recon_cli.errors import ConfigError, SfmError
from recon_cli.io.tracks import Tracks
from recon_cli.progress import NullProgress, Progress
from recon_cli.sfm.job import SPLIT, MappingJob, StepLog
from recon_cli.sfm.process import CrashError, run_job

Names = tuple[str, ...]

MOST_WHOLE = 200  # frames up to which a capture is mapped as one
# Frames of a segment, and those that it has in common with the next one. Shorter segments spend
# more on what they share, longer ones are fewer jobs.
LENGTH, OVERLAP = 150, 25
LEAST = 10  # frames of a segment
# Of one core for a frame, in its segments and in the join, measured on walks of 640x360 pixels:
# docs/scaling.md.
SEGMENT_SECONDS, JOIN_SECONDS = 1.0, 0.5
TRIES = 2  # of a segment whose process is killed, perhaps for want of memory beside others


def count_segments(frames: int, asked: str) -> int:
    """Returns how many segments so many frames are mapped in; 1: they stay whole.

    `asked` is auto, off or a number; ConfigError if it is more than the frames allow.
    """
    if asked == "off":
        return 1
    if asked == "auto":
        return 1 if frames <= MOST_WHOLE else -(-(frames - OVERLAP) // (LENGTH - OVERLAP))
    most = max(1, frames // LEAST)
    if int(asked) > most:
        raise ConfigError(
            f"{frames} frames are too few for {asked} segments: each takes {LEAST} or more.",
            hint=f"Give at most --segments {most}.")
    return int(asked)


def expected_minutes(frames: int, threads: int) -> float:
    """Returns about how long sfm takes for so many frames; the join keeps to one thread."""
    at_once = min(threads, count_segments(frames, "auto"))
    return frames * (SEGMENT_SECONDS / at_once + JOIN_SECONDS) / 60


def overlap(frames: int, count: int) -> int:
    """Returns how many frames two segments in a row have in common: OVERLAP, or fewer of few."""
    return min(OVERLAP, frames // (2 * count))


def split_by_time(names: Sequence[str], count: int) -> tuple[Names, ...]:
    """Returns the names of each segment, in their order; all segments are about equally long."""
    common = overlap(len(names), count)
    cuts = [round(index * (len(names) - common) / count) for index in range(count + 1)]
    return tuple(tuple(names[start:end + common])
                 for start, end in itertools.pairwise(cuts))


@dataclass(frozen=True)
class SegmentRuns:
    """What became of the segments of a job."""

    job: MappingJob  # of the whole, which joins them
    failed: Mapping[int, str]  # why some have no model, by index
    cpu_seconds: Mapping[str, float]  # that each step took, in all segments together


def map_segments(
    job: MappingJob, count: int, slots: int | None, *, progress: Progress,
    record: Callable[[int, int], None],
) -> SegmentRuns:
    """Maps a job in segments, `slots` at once; those that have a model already are kept.

    A segment that fails stops no other. SfmError if all do, or the time is up; otherwise raises
    what `run_job` raises.
    """
    deadline = time.monotonic() + 60 * job.max_minutes
    if all(name in job.times for name in job.names):
        parts = split_by_time(job.names, count)
    else:
        job = dataclasses.replace(job, split=count)
        run_job(dataclasses.replace(job, last=SPLIT), progress=progress, record=record,
                on_idle=lambda: None)
        split = StepLog(job.out).result(SPLIT)
        assert split is not None, "the mapping process ended without a split"
        parts = tuple(map(tuple, split["segments"]))
    job = dataclasses.replace(job, segments=parts)
    slots = min(slots or job.threads, len(parts))
    jobs = [_segment_job(job, index, max(1, job.threads // slots)) for index in range(len(parts))]
    failed = _run_all(jobs, slots, deadline, progress, record)
    if len(failed) == len(parts):
        raise SfmError(f"None of the {len(parts)} segments could be mapped: {failed[0]}",
                       hint="Try --segments off, more frames, or a slower walk.")
    steps = [(step, StepLog(each.out).result(step)) for each in jobs for step in each.steps]
    cpu = dict.fromkeys((step for step, _ in steps), 0.0)
    for step, result in steps:
        cpu[step] += float((result or {}).get("cpu_seconds", 0.0))
    left = (deadline - time.monotonic()) / 60
    if left <= 0:
        raise SfmError(f"The segments were not mapped within {job.max_minutes:g} minutes.",
                       hint="Allow more time with --max-minutes: finished segments are kept.")
    return SegmentRuns(dataclasses.replace(job, max_minutes=left), failed, cpu)


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
        segments=(), split=0, last="model")
    listed = folder / "frames.txt"
    text = "".join(f"{name}\n" for name in names)
    if not job.split and not (listed.exists() and listed.read_text(encoding="utf-8") == text):
        shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True, exist_ok=True)
    if job.tracks is not None:
        tracks = Tracks.read(job.tracks)
        chosen = {row: name for row, name in enumerate(tracks.names) if name in set(names)}
        segment = dataclasses.replace(segment, tracks=folder / "tracks.safetensors")
        tracks.select(chosen).write(folder / "tracks.safetensors")
    listed.write_text(text, encoding="utf-8")
    return segment


def _run_all(
    jobs: Sequence[MappingJob], slots: int, deadline: float, progress: Progress,
    record: Callable[[int, int], None],
) -> dict[int, str]:
    """Returns why segments failed, by index."""
    total = sum(len(job.names) for job in jobs)
    shares, failed = [0.0] * len(jobs), {}
    lock, stop = threading.Lock(), threading.Event()
    with progress.bar("mapping segments", total, unit="frame") as bar:
        shown = 0

        def note(index: int, share: float) -> None:
            nonlocal shown
            with lock:
                shares[index] = max(shares[index], share)
                done = int(sum(part * len(job.names)
                               for part, job in zip(shares, jobs, strict=True)))
                bar.advance(done - shown)
                shown = done
                record(done, 2 * total)  # the join is the other half

        def run(index: int) -> str:
            reason = ""
            for _ in range(TRIES):
                limit = (deadline - time.monotonic()) / 60
                if limit <= 0:
                    return "there was no time left for it"
                try:
                    run_job(
                        dataclasses.replace(jobs[index], max_minutes=limit),
                        progress=NullProgress(), on_idle=lambda: None, stop=stop,
                        record=lambda done, of: note(index, done / of))
                except CrashError as error:
                    reason = error.message
                except SfmError as error:
                    return error.message
                else:
                    return ""
            return reason

        with ThreadPoolExecutor(slots) as pool:
            futures = {pool.submit(run, index): index for index in range(len(jobs))}
            try:
                for future in as_completed(futures):
                    index = futures[future]
                    if reason := future.result():
                        failed[index] = reason
                    note(index, 1.0)
            except BaseException:
                for future in futures:
                    future.cancel()
                stop.set()
                raise
    return dict(sorted(failed.items()))
