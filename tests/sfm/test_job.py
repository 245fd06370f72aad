"""The job, the log of finished steps and the events survive their way through files."""

import errno
import io
import json
from dataclasses import replace
from pathlib import Path

import pytest
from facts import raises

from recon_cli.errors import FormatError, SfmError, WorkspaceError
from recon_cli.scene.camera import Lens
from recon_cli.sfm.job import (
    STEPS,
    CameraGroup,
    MappingJob,
    Phase,
    Reporter,
    fresh_folder,
    parse,
    publish,
)


def job(count, pairs="auto"):
    return MappingJob(
        frames=Path("/in/frames"), out=Path("/out"),
        groups=(CameraGroup(tuple(f"{index:06d}.png" for index in range(count)), 600, 340),),
        masks=None, poses=None, pose_use="keep", given_points=False, pairs=pairs,
        max_features=2048, min_registered=0.5, accept_weak=False, partial=True,
        max_minutes=1.0,
        seed=0, threads=2, sharpness={"000000.png": 12.5}, times={"000000.png": 0.25})


def test_what_is_written_is_read_back(tmp_path):
    lens = Lens("PINHOLE", 80, 60, (70.0, 71.0, 40.5, 30.0))
    told = replace(job(4), masks=Path("/in/masks"), poses=Path("/in/poses.json"), groups=(
        CameraGroup(("a.png", "c.png"), 600, 340, focal_px=812.5),
        CameraGroup(("b.png",), 80, 60, lens=lens)))
    assert told.names == ("a.png", "b.png", "c.png")
    told.write(tmp_path / "job.json")
    assert MappingJob.read(tmp_path / "job.json") == told


@pytest.mark.parametrize(("name", "value"), [
    ("frames", 3), ("out", None), ("groups", [{"names": ["a.png"]}]), ("groups", 7),
    ("segments", [1]),
    ("groups", [{"names": ["a.png"], "width": 8, "height": 6, "focal_px": None,
                 "lens": {"model": "NONE", "width": 8, "height": 6, "params": []}}])])
def test_a_job_with_values_of_other_types_is_none(tmp_path, name, value):
    path = tmp_path / "job.json"
    job(4).write(path)
    fields = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps({**fields, name: value}), encoding="utf-8")
    with raises(FormatError, "mapping"):
        MappingJob.read(path)


@pytest.mark.parametrize("text", ["[]", '{"frames": "/in/frames"}', "nonsense"])
def test_another_file_is_no_job(tmp_path, text):
    path = tmp_path / "job.json"
    path.write_text(text, encoding="utf-8")
    with raises(FormatError):
        MappingJob.read(path)


def test_poses_and_points_that_are_kept_leave_nothing_to_be_found():
    lens = Lens("PINHOLE", 80, 60, (70.0, 71.0, 40.5, 30.0))
    group = replace(job(4).groups[0], lens=lens)
    given = replace(
        job(4), poses=Path("/in/poses.json"), given_points=True, groups=(group,))
    assert given.steps == ("model",)
    assert replace(given, pose_use="refine").steps == STEPS
    assert replace(given, given_points=False).steps == STEPS
    assert replace(given, groups=(replace(group, lens=None),)).steps == STEPS


def test_poses_that_are_ignored_are_not_known():
    given = replace(job(4), poses=Path("/in/poses.json"), given_points=True)
    assert given.known_poses
    assert not replace(given, pose_use="ignore").known_poses
    assert replace(given, pose_use="ignore").steps == STEPS


def test_publishing_replaces_what_an_interrupted_run_left(tmp_path):
    target = tmp_path / "sparse"
    (target / "old").mkdir(parents=True)
    work = fresh_folder(tmp_path / "sparse.partial")
    (work / "new.bin").write_bytes(b"1")
    publish(work, target)
    assert [path.name for path in target.iterdir()] == ["new.bin"]
    assert not work.exists()


def test_a_fresh_folder_is_empty(tmp_path):
    (tmp_path / "work").mkdir()
    (tmp_path / "work" / "left.png").write_bytes(b"1")
    assert list(fresh_folder(tmp_path / "work").iterdir()) == []


def sent(say):
    """What the parent understands of what `say` told a reporter."""
    stream = io.BytesIO()
    say(Reporter(stream))
    line, = stream.getvalue().splitlines()
    return parse(line)


def test_a_notice_arrives_as_its_text():
    assert sent(lambda report: report.tell("model is made anew")) == "model is made anew"


def test_phases_and_counts_arrive():
    assert sent(lambda report: report.phase("matches", 78, done=3)) == Phase("matches", 78, 3)
    assert sent(lambda report: report.done(5)) == 5


@pytest.mark.parametrize("kind", [SfmError, FormatError, WorkspaceError])
def test_an_error_arrives_as_what_it_was(kind):
    event = sent(lambda report: report.fail(kind("No features.\nReally.", hint="Try again.")))
    assert type(event) is kind
    assert (event.message, event.hint) == ("No features.\nReally.", "Try again.")


def test_a_full_disk_arrives_as_a_full_disk():
    full = OSError(errno.ENOSPC, "No space left on device", "/out/sparse")
    event = sent(lambda report: report.fail(full))
    assert isinstance(event, OSError)
    assert event.errno == errno.ENOSPC
    assert event.filename == "/out/sparse"
