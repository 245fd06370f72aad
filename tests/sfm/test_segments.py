"""The cut into segments, and what becomes of them: kept, tried again, failed, interrupted."""

import dataclasses
import errno
import itertools
import time
from pathlib import Path

import numpy as np
import pytest
from facts import raises

from recon_cli.errors import ConfigError, ReconError, SfmError, WorkspaceError
from recon_cli.io.tracks import Tracks
from recon_cli.progress import NullProgress
from recon_cli.sfm.job import SPLIT, STEPS, CameraGroup, MappingJob
from recon_cli.sfm.mapping.process import CrashError
from recon_cli.sfm.results import SplitResult, StepResult
from recon_cli.sfm.segments import segments
from recon_cli.workspace.steps import StepFolder


def names_of(count):
    return tuple(f"{index:06d}.png" for index in range(count))


@pytest.mark.parametrize(("frames", "asked", "count"), [
    (200, "auto", 1), (201, "auto", 2), (300, "auto", 3), (1200, "auto", 10), (1200, "off", 1),
    (50, "2", 2), (1200, "1", 1)])
def test_the_number_of_segments_follows_the_frames(frames, asked, count):
    assert segments.count_segments(frames, asked) == count


def test_more_segments_than_the_frames_allow_are_refused():
    with raises(ConfigError, 50, 6, "segments") as caught:
        segments.count_segments(50, "6")
    assert "--segments 5" in caught.value.hint


@pytest.mark.parametrize(("frames", "count"), [(201, 2), (300, 3), (1200, 10), (24, 2), (997, 7)])
def test_segments_of_a_video_cover_every_frame_and_overlap_as_asked(frames, count):
    names = names_of(frames)
    parts = segments.split_by_time(names, count)
    assert len(parts) == count
    assert set().union(*parts) == set(names)
    common = segments.overlap(frames, count)
    assert 0 < common <= segments.SEGMENT_OVERLAP
    for before, after in itertools.pairwise(parts):
        assert before[-common:] == after[:common]
    for first, third in zip(parts, parts[2:], strict=False):
        assert set(first).isdisjoint(third)
    sizes = [len(part) for part in parts]
    assert max(sizes) - min(sizes) <= 1
    assert all(part == tuple(sorted(part)) for part in parts)


@pytest.fixture
def job(tmp_path):
    """A video of 60 frames; each track is seen by three in a row."""
    names = names_of(60)
    image = np.repeat(np.arange(60, dtype=np.int32), 3)
    track = np.concatenate([[index, index + 1, index + 2] for index in range(60)])
    Tracks(names, image, track.astype(np.int32), np.zeros((180, 2), np.float32)).write(
        tmp_path / "tracks")
    return MappingJob(
        frames=tmp_path, out=tmp_path / "out",
        groups=(CameraGroup(names[:40], 9, 9), CameraGroup(names[40:], 9, 9)), masks=None,
        poses=None, pose_use="keep", given_points=False, tracks=tmp_path / "tracks", pairs="auto",
        max_features=2000, min_registered=0.5, accept_weak=False, partial=True,
        max_minutes=5.0, seed=0, threads=4, sharpness={},
        times={name: float(index) for index, name in enumerate(names)})


class Mapper:
    """In place of `run_job`: finishes the steps of a job, or fails as told."""

    def __init__(self, **failures):
        self.failures, self.jobs = failures, []

    def __call__(self, job, *, record, **_):
        self.jobs.append(job)
        log = StepFolder(job.out)
        if all(log.is_finished(step) for step in job.steps):
            return
        record(1, 4)
        errors = self.failures.get(f"of_{job.out.name}", [])
        if errors and (error := errors.pop(0)):
            raise error
        for step in job.steps:
            log.finish(step, StepResult(seconds=3.0, cpu_seconds=2.0))

    def ran(self):
        return sorted(int(job.out.name) for job in self.jobs)


class InThisProcess:
    """An executor that calls what the command would call, as many at once as there are slots."""

    slots = 2

    def __init__(self):
        self.closed = False

    def run(self, command):
        verb, file = command.words
        assert verb == segments.COMMAND
        try:
            segments.map_segment(Path(file))
        except ReconError as error:
            command.log.write_text(f"error: {error.message}\nhint: {error.hint}\n")
            return error.exit_code
        return 0

    def stop(self):
        pass

    def close(self):
        self.closed = True


def run(job, monkeypatch, mapper, count=3, progress=None, record=lambda *_: None):
    monkeypatch.setattr(segments, "run_job", mapper)
    executor = InThisProcess()
    try:
        return segments.map_segments(
            job, count, lambda parts: (executor, 2 if parts == count else 0),
            progress=progress or NullProgress(), record=record)
    finally:
        assert executor.closed


def test_each_segment_is_a_job_on_its_frames_and_tracks(job, monkeypatch):
    mapper = Mapper()
    runs = run(job, monkeypatch, mapper)
    assert runs.failed == {}
    assert runs.job.segments == segments.split_by_time(job.names, 3)
    assert runs.cpu_seconds == {"features": 6.0, "matches": 6.0, "model": 6.0}
    for each in mapper.jobs:
        part = runs.job.segments[int(each.out.name)]
        assert each.names == part
        assert each.steps == ("features", "matches", "model")
        assert Tracks.read(each.tracks).names == part
        assert each.threads == 2
        assert all(group.names for group in each.groups)


def test_a_segment_that_fails_stops_no_other_and_is_told(job, monkeypatch):
    mapper = Mapper(of_1=[SfmError("No two frames match.")])
    runs = run(job, monkeypatch, mapper)
    assert runs.failed == {1: "No two frames match."}
    assert mapper.ran() == [0, 1, 2]


def test_a_segment_whose_process_is_killed_is_tried_again(job, monkeypatch):
    mapper = Mapper(of_1=[CrashError("It was ended by SIGKILL."), None])
    assert run(job, monkeypatch, mapper).failed == {}
    assert mapper.ran() == [0, 1, 1, 2]
    again = Mapper(of_1=[CrashError("It was ended by SIGKILL.")] * segments.TRIES)
    StepFolder(job.segment(1)).forget(*STEPS)
    assert run(job, monkeypatch, again).failed == {1: "It was ended by SIGKILL."}


def test_a_full_disk_stops_the_run_and_is_no_failed_segment(job, monkeypatch):
    error = OSError(errno.ENOSPC, "No space left on device")
    with raises(WorkspaceError, 1, "Segment"):
        run(job, monkeypatch, Mapper(of_1=[error]))


def test_no_time_is_left_for_a_segment_that_would_begin_too_late(job, monkeypatch):
    late = dataclasses.replace(job, max_minutes=0.0)
    with raises(SfmError, "time"):
        run(late, monkeypatch, Mapper())


def test_what_a_segment_has_done_is_seen_from_outside(job, monkeypatch):
    class Slow(Mapper):
        def __call__(self, each, *, record, **options):
            if each.out.name == "0":
                record(1, 2)
                time.sleep(1.5)  # more than one look
            super().__call__(each, record=record, **options)

    seen = []
    run(job, monkeypatch, Slow(), record=lambda *done: seen.append(done))
    length = [len(part) for part in segments.split_by_time(job.names, 3)]
    assert (length[0] // 2 + length[1] + length[2], 2 * sum(length)) in seen


def test_no_segment_at_all_is_an_error(job, monkeypatch):
    mapper = Mapper(**{f"of_{index}": [SfmError("Too dark.")] for index in range(3)})
    with raises(SfmError, 3, "segments"):
        run(job, monkeypatch, mapper)


def test_an_interrupted_run_keeps_what_is_finished(job, monkeypatch):
    with pytest.raises(KeyboardInterrupt):
        run(job, monkeypatch, Mapper(of_2=[KeyboardInterrupt()]))
    kept = job.segment(0) / "steps.jsonl"
    before = kept.stat().st_mtime_ns
    assert run(job, monkeypatch, Mapper()).failed == {}
    assert kept.stat().st_mtime_ns == before
    assert StepFolder(job.segment(2)).is_finished("model")


def test_segments_of_another_cut_are_not_taken_for_these(job, monkeypatch):
    run(job, monkeypatch, Mapper())
    run(job, monkeypatch, Mapper(), count=2)
    for index, names in enumerate(segments.split_by_time(job.names, 2)):
        listed = (job.segment(index) / "frames.txt").read_text().split()
        assert tuple(listed) == names
    mapper = Mapper(of_0=[SfmError("It has to be mapped anew.")])
    assert run(job, monkeypatch, mapper).failed == {0: "It has to be mapped anew."}


def test_photos_are_split_by_the_mapping_process(job, monkeypatch):
    parts = [job.names[::2], job.names[1::2]]

    class Splitter(Mapper):
        def __call__(self, each, **options):
            if each.last == SPLIT:
                assert each.steps == ("features", "matches", "split")
                StepFolder(each.out).finish(SPLIT, SplitResult(segments=tuple(parts)))
                return
            super().__call__(each, **options)

    photos = dataclasses.replace(job, times={}, tracks=None)
    Path(photos.out).mkdir()
    runs = run(photos, monkeypatch, Splitter(), count=2)
    assert runs.job.segments == tuple(parts)
    assert runs.job.steps == ("features", "matches", "split", "model")


def test_the_folders_of_segments_are_removed(job, monkeypatch):
    run(job, monkeypatch, Mapper())
    segments.remove_segments(job)
    assert not job.segment(0).parent.exists()
