"""Captures that are hard to map: parts that do not meet, wrong images, no steps."""

from types import SimpleNamespace

import av
import numpy as np
import pytest
from facts import assert_facts, raises
from sfm_inputs import run, texture, write_inputs

from recon_cli.errors import SfmError
from recon_cli.io.tracks import TRACKS, Tracks
from recon_cli.sfm import database
from recon_cli.sfm.job import CLIP_SECONDS
from recon_cli.sfm.verdict.verdict import find_jumps
from recon_cli.stages import sfm
from recon_cli.workspace.records import Frame, FrameList, Group


def frames(path, *, first=0, step=4, count=8, prefix=""):
    """Every `step`-th frame of a video by name."""
    found = {}
    for index, frame in enumerate(av.open(str(path)).decode(video=0)):
        if index == first + step * len(found):
            found[f"{prefix}{index:06d}.png"] = frame.to_ndarray(format="rgb24")
            if len(found) == count:
                return found
    raise AssertionError(f"{path} is too short")


@pytest.mark.integration
def test_of_two_clips_that_do_not_meet_the_larger_is_kept_and_the_other_named(
    sample_video, shared_data, tmp_path, caplog
):
    office = frames(sample_video, count=10, prefix="office")
    living = frames(shared_data / "rooms" / "living" / "video.mp4", count=6, prefix="living")
    summary = run(write_inputs(tmp_path / "in", office | living), tmp_path / "out")
    assert summary.unregistered == tuple(sorted(living))
    assert summary.apart == (tuple(sorted(living)),)
    assert summary.models == (10, 6)
    # No match ties the two together, so that no further way is worth trying.
    assert [attempt.name for attempt in summary.attempts] == ["exhaustive"]
    assert_facts(caplog.text, "disconnected", 6, "frames")
    assert "living000000.png" in caplog.text


@pytest.mark.integration
def test_two_clips_of_one_length_are_not_passed_off_as_a_room(sample_video, shared_data, tmp_path):
    office = frames(sample_video, count=6, prefix="office")
    living = frames(shared_data / "rooms" / "living" / "video.mp4", count=6, prefix="living")
    with raises(SfmError, 12, 9, "frames"):
        run(write_inputs(tmp_path / "in", office | living), tmp_path / "out", min_registered=0.75)


@pytest.mark.integration
def test_photos_of_other_things_are_named_and_not_in_the_model(sample_video, tmp_path):
    wrong = {f"wrong{seed}.png": texture(340, 600, seed) for seed in range(3)}
    images = frames(sample_video, count=16) | wrong  # of 12 the first model is broken
    summary = run(write_inputs(tmp_path / "in", images), tmp_path / "out")
    assert summary.registered == 16
    assert summary.unregistered == tuple(sorted(wrong))
    assert [attempt.name for attempt in summary.attempts] == ["exhaustive"]


@pytest.mark.integration
def test_photos_are_matched_where_their_coarsest_features_overlap(sample_video, tmp_path):
    images = frames(sample_video, step=2, count=36)
    summary = run(write_inputs(tmp_path / "in", images), tmp_path / "out")
    assert summary.registered == 36
    assert [attempt.name for attempt in summary.attempts] == ["coarse"]
    assert len(database.pair_names(tmp_path / "out" / "database.db")) < 36 * 35 / 2 * 0.75


@pytest.mark.integration
def test_one_frame_many_times_over_is_no_capture(sample_video, tmp_path):
    still, = frames(sample_video, count=1).values()
    images = {f"{index}.png": still for index in range(6)}
    with raises(SfmError, "camera", "move"):
        run(write_inputs(tmp_path / "in", images), tmp_path / "out")


@pytest.mark.integration
def test_frames_given_twice_do_no_harm(sample_video, tmp_path):
    once = frames(sample_video, count=8)
    twice = {f"copy{name}": image for name, image in once.items()}
    summary = run(write_inputs(tmp_path / "in", once | twice), tmp_path / "out")
    assert summary.registered == 16


@pytest.mark.integration
def test_twelve_neighbours_of_a_fast_video_are_refused(shared_data, tmp_path):
    """A fifth of a second: the camera moved by a few millimetres."""
    images = frames(shared_data / "video_bedroom" / "room.mp4", first=200, step=1, count=12)
    with pytest.raises(SfmError) as caught:
        run(write_inputs(tmp_path / "in", images), tmp_path / "out")
    assert caught.value.hint


@pytest.mark.integration
def test_the_frames_of_every_way_of_pairing_meet(sample_video, tmp_path):
    images = frames(sample_video, count=8)
    for pairs in ("retrieval", "sequential"):
        summary = run(write_inputs(tmp_path / pairs, images), tmp_path / f"{pairs}.out",
                      pairs=pairs)
        assert summary.registered == 8
        attempt, = summary.attempts
        assert (attempt.name, attempt.reason, attempt.kept) == (pairs, "--pairs asks for it", True)


def test_from_clip_to_clip_the_camera_may_be_anywhere(tmp_path):
    """Two clips begin at 0 s each; sorted by that alone, every step would lead to the other one."""
    groups = tuple(Group(name, 600, 340) for name in ("long.mp4", "short.mp4"))
    clips = {0: [*range(30)], 1: [100, 101, 102]}
    listed = FrameList("video", groups, tuple(
        Frame(f"{clip}_{index:03d}.png", float(index), groups[clip].name, None, False, clip)
        for clip, places in clips.items() for index in range(len(places))))
    names = tuple(frame.name for frame in listed.frames)
    centers = np.zeros((len(names), 3))
    centers[:, 0] = [*clips[0], *clips[1]]
    evidence = SimpleNamespace(
        names=names, registered=np.ones(len(names), bool), centers=centers)
    assert find_jumps(evidence, sfm._times(listed, tmp_path / TRACKS)) == ()
    assert find_jumps(evidence, {frame.name: frame.time_seconds for frame in listed.frames})


def test_photos_that_follow_each_other_have_their_place_for_a_time(tmp_path):
    """With a gap of any length where nothing was followed."""
    names = tuple(f"a{index}.png" for index in range(6))
    listed = FrameList("photos", (Group("room", 600, 340),), tuple(
        Frame(name, None, name, 1.0, False) for name in (*names, "other.png")))
    image = np.arange(6, dtype=np.int32).repeat(3)
    track = np.array([range(3 * (index > 2), 3 * (index > 2) + 3) for index in range(6)], np.int32)
    Tracks(names, image, track.ravel(), np.zeros((18, 2), np.float32)).write(tmp_path / TRACKS)
    times = sfm._times(listed, tmp_path / TRACKS)
    assert tuple(times) == names
    assert np.diff(list(times.values())).round(3).tolist() == [1, 1, 1 + CLIP_SECONDS, 1, 1]
    assert sfm._times(listed, tmp_path / "none") == {}
