import errno
import io
import itertools
import json
import sqlite3
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
import pytest
from facts import assert_facts, raises
from synthetic import center_error, make_capture, part

from recon_cli.errors import SfmError
from recon_cli.io.tracks import Tracks
from recon_cli.sfm.features import keyframes
from recon_cli.sfm.job import CameraGroup, Reporter, parse
from recon_cli.sfm.mapping import fallbacks, mapper, parts, skeleton, wide_lens
from recon_cli.sfm.mapping.fallbacks import (
    MapperAttempt,
    best_attempt,
    list_fallbacks,
    reachable,
    shortfall,
)
from recon_cli.sfm.mapping.lens_trial import BetterLens
from recon_cli.sfm.mapping.merge_models import ModelCandidate
from recon_cli.workspace.steps import StepFolder

NAMES = tuple(f"{index:06d}.png" for index in range(60))
GOOD = MapperAttempt(
    "exhaustive", "", registered=NAMES, trusted=True, weak_link=0.95, reprojection_error_px=0.5)


def build(job):
    return fallbacks.build_model(job, Reporter(io.BytesIO()))


@pytest.fixture
def capture(tmp_path):
    """Twenty cameras around points, all of them matched; too few points to try other lenses on."""
    return make_capture(tmp_path, points=150)


@pytest.fixture
def few_pairs(monkeypatch):
    """Lets four pairs of images say whether a lens is a fisheye."""
    monkeypatch.setattr(wide_lens, "_PAIRS", 4)


def sized(job, count):
    return replace(job, groups=(replace(
        job.groups[0], names=tuple(f"{index}.png" for index in range(count))),))


def test_a_small_capture_begins_with_all_pairs_and_a_large_one_with_its_coarsest_features(capture):
    job, _ = capture
    assert [fallback.name for fallback in list_fallbacks(sized(job, 30))] == [
        "exhaustive", "relaxed", "global"]
    assert [fallback.name for fallback in list_fallbacks(sized(job, 100))] == [
        "coarse", "exhaustive", "relaxed", "global"]
    assert [fallback.name for fallback in list_fallbacks(sized(job, 101))] == [
        "coarse", "retrieval", "relaxed", "exhaustive", "global"]


def test_a_capture_that_is_cut_into_segments_needs_no_cameras_of_the_whole_first(capture):
    job, _ = capture
    assert list_fallbacks(replace(sized(job, 300), split=2))[0].name == "retrieval"
    halves = tuple(f"{index}.png" for index in range(300)), ("299.png",)
    assert [fallback.name for fallback in list_fallbacks(
        replace(sized(job, 300), segments=halves))][:2] == ["segments", "retrieval"]


def test_a_video_begins_with_its_tracks_where_they_link_its_frames(capture):
    job, _ = capture
    count = len(job.names)
    image = np.repeat(np.arange(count, dtype=np.int32), 30)
    tracks = Tracks(job.names, image, np.tile(np.arange(30, dtype=np.int32), count),
                    np.zeros((30 * count, 2), np.float32))
    tracks.write(job.out / "tracks.safetensors")
    video = replace(job, tracks=job.out / "tracks.safetensors")
    assert [fallback.name for fallback in list_fallbacks(video)] == [
        "tracks", "exhaustive", "relaxed", "global"]
    # Each track ends before the next frame.
    replace(tracks, track=np.arange(30 * count, dtype=np.int32)).write(video.tracks)
    assert list_fallbacks(video)[0].name == "exhaustive"


def test_a_long_video_is_matched_among_its_keyframes(capture, monkeypatch):
    job, _ = capture
    monkeypatch.setattr(keyframes, "FEW_FRAMES", 3)
    count = len(job.names)
    image = np.repeat(np.arange(count, dtype=np.int32), 100)
    Tracks(job.names, image, np.tile(np.arange(100, dtype=np.int32), count),
           np.zeros((100 * count, 2), np.float32)).write(job.out / "tracks.safetensors")
    video = replace(job, tracks=job.out / "tracks.safetensors")
    chosen = skeleton.list_keyframes(video)
    assert 1 < len(chosen) < count
    assert [fallback.name for fallback in list_fallbacks(video)] == [
        "tracks", "relaxed", "global"]


@pytest.mark.parametrize("pairs", ["exhaustive", "retrieval", "sequential"])
def test_a_named_way_is_the_only_one(capture, pairs):
    job, _ = capture
    assert [fallback.name for fallback in list_fallbacks(replace(job, pairs=pairs))] == [pairs]


@dataclass(frozen=True)
class Opinion:
    """As much of a verdict as is looked at."""

    trusted: bool = True
    problems: tuple[str, ...] = ()
    match_parts: tuple[tuple[str, ...], ...] = ()
    lenses: tuple[BetterLens, ...] = ()


def candidate(capture, count=20, *, apart=(), opinion=None):
    job, truth = capture
    return ModelCandidate(part(truth, job.names[:count]), opinion or Opinion(), apart, {})


def test_a_good_model_falls_short_of_nothing(capture):
    names = capture[0].names
    assert shortfall(candidate(capture), names) == ""
    assert shortfall(candidate(capture, 18), names) == ""


def test_each_shortfall_is_said(capture):
    names = capture[0].names
    assert_facts(MapperAttempt("exhaustive", "").shortfall, "model")
    assert_facts(shortfall(candidate(capture, 17), names), 17, 20, "frames")
    apart = candidate(capture, 18, apart=(("a", "b", names[19]),))
    assert_facts(shortfall(apart, names), 2, "models")
    broken = Opinion(trusted=False, problems=("The model is broken.",))
    assert shortfall(candidate(capture, opinion=broken), names) == "The model is broken."


def test_a_wrong_lens_falls_short_only_where_another_may_be_tried(capture):
    names = capture[0].names
    lens = BetterLens(1, "OPENCV", "OPENCV_FISHEYE", 1.2, 0.7, 0.41, 0.02)
    wrong = candidate(capture, opinion=Opinion(
        trusted=False, problems=(lens.sentence(),), lenses=(lens,)))
    assert shortfall(wrong, names) == ""  # no other mapper mends it
    assert_facts(shortfall(wrong, names, lenses=True), "OPENCV_FISHEYE", "1.20", "0.70")
    job = capture[0]
    assert fallbacks.may_change_lenses(job, ["exhaustive"])
    assert not fallbacks.may_change_lenses(job, ["exhaustive", "lens"])
    named = replace(job, groups=tuple(replace(group, model="OPENCV") for group in job.groups))
    assert not fallbacks.may_change_lenses(named, ["exhaustive"])
    assert not fallbacks.may_change_lenses(
        replace(job, segments=(names[:12], names[8:])), ["segments"])


def test_a_part_that_no_match_ties_to_the_model_is_no_shortfall(capture):
    names = capture[0].names
    assert shortfall(candidate(capture, 17, apart=(names[17:],)), names[:17]) == ""


def test_frames_that_cannot_be_placed_are_not_waited_for(capture):
    job, _ = capture
    opinion = Opinion(match_parts=(job.names[12:], job.names[:12]))
    assert reachable(job, candidate(capture, 10, opinion=opinion)) == set(job.names[:12])
    with sqlite3.connect(job.database) as connection:  # the bare frame has no matches either
        connection.execute("UPDATE keypoints SET rows = 5 WHERE image_id = 1")
    connection.close()
    assert reachable(job, candidate(capture, 10, opinion=opinion)) == set(job.names[1:12])


def test_before_all_pairs_are_matched_every_frame_with_features_counts(capture):
    job, _ = capture
    with pycolmap.Database.open(job.database) as opened:
        opened.delete_two_view_geometry(1, 2)
    opinion = Opinion(match_parts=(job.names[12:], job.names[:12]))
    assert reachable(job, candidate(capture, 10, opinion=opinion)) == set(job.names)


def test_more_frames_that_hang_together_are_the_better_model():
    fewer = replace(GOOD, name="relaxed", registered=NAMES[:40])
    assert best_attempt([fewer, GOOD]) is GOOD


def test_a_broken_model_of_all_frames_is_worse_than_a_sound_one_of_most():
    sound = replace(GOOD, name="relaxed", registered=NAMES[:50])
    broken = replace(GOOD, name="global", trusted=False, weak_link=0.1)
    assert best_attempt([broken, sound]) is sound


def test_a_model_that_is_not_trusted_is_worse_though_its_matches_agree():
    bent = replace(GOOD, name="relaxed", trusted=False, reprojection_error_px=0.1)
    sound = replace(GOOD, name="global", registered=NAMES[:55])
    assert best_attempt([bent, sound]) is sound
    assert best_attempt([bent, replace(sound, registered=NAMES[:20])]) is bent


def test_of_two_alike_the_smaller_error_decides_and_then_the_order():
    sharper = replace(GOOD, name="global", reprojection_error_px=0.3)
    assert best_attempt([GOOD, sharper]) is sharper
    assert best_attempt([GOOD, replace(GOOD, name="relaxed")]) is GOOD


def test_where_no_mapper_found_a_model_none_is_best():
    assert best_attempt([MapperAttempt("exhaustive", ""), MapperAttempt("relaxed", "")]) is None


@pytest.mark.integration
def test_a_good_capture_stops_at_the_first_attempt(tmp_path):
    job, truth = make_capture(tmp_path)  # with points enough to try other lenses on
    result = build(job)
    attempt, = result.attempts
    assert attempt.name == "exhaustive"
    assert_facts(attempt.reason, 20, "frames")
    assert attempt.registered == 20
    assert attempt.kept
    part, = result.parts
    assert part.names == job.names
    assert result.models == (20,)
    assert not job.attempts.exists()
    assert center_error(pycolmap.Reconstruction(job.model), truth) < 1e-3
    assert json.loads((job.model / "verdict.json").read_text())["registered"] == 20
    assert json.dumps(result.to_json(), allow_nan=False)


def nothing(*_, **__):
    return []


@pytest.mark.integration
@pytest.mark.usefixtures("few_pairs")
def test_every_mapper_is_tried_until_one_finds_a_model(capture, monkeypatch):
    job, _ = capture
    monkeypatch.setattr(mapper, "map_incrementally", nothing)
    monkeypatch.setattr(mapper, "map_relaxed", nothing)
    result = build(job)
    assert [(item.name, item.kept) for item in result.attempts] == [
        ("exhaustive", False), ("relaxed", False), ("global", True)]
    assert {item.reason for item in result.attempts[1:]} == {MapperAttempt("", "").shortfall}


@pytest.mark.integration
@pytest.mark.usefixtures("few_pairs")
def test_before_another_mapper_is_tried_its_time_is_told(capture, monkeypatch):
    job, _ = capture
    monkeypatch.setattr(mapper, "map_incrementally", nothing)
    monkeypatch.setattr(fallbacks, "MINUTES_TOLD", -1)
    stream = io.BytesIO()
    fallbacks.build_model(job, Reporter(stream))
    told = [event for line in stream.getvalue().splitlines()
            if isinstance(event := parse(line), str) and "another mapper" in event]
    assert len(told) == 1
    assert_facts(told[0], "minutes", MapperAttempt("", "").shortfall)


@pytest.mark.integration
@pytest.mark.usefixtures("few_pairs")
def test_models_beside_the_best_are_kept_until_their_parts_are(capture, monkeypatch):
    job, truth = capture
    monkeypatch.setattr(mapper, "map_incrementally", lambda *_: [
        part(truth, job.names[:10]), part(truth, job.names[10:])])
    monkeypatch.setattr(fallbacks.merge_models, "merge", lambda *_, **__: None)
    monkeypatch.setattr(fallbacks, "shortfall", lambda *_, **__: "")
    result = build(job)
    assert sorted(each.names for each in result.parts) == [job.names[:10], job.names[10:]]
    assert result.apart == ()
    assert sorted(path.name for path in job.parts.iterdir()) == ["1", "2"]


@pytest.mark.integration
@pytest.mark.usefixtures("few_pairs")
def test_no_model_at_all_is_a_failure_that_counts_frames(capture, monkeypatch):
    job, _ = capture
    monkeypatch.setattr(mapper, "map_incrementally", nothing)
    monkeypatch.setattr(mapper, "map_relaxed", nothing)
    monkeypatch.setattr(mapper, "map_globally", nothing)
    with raises(SfmError, 0, 20, "frames") as caught:
        build(job)
    assert_facts(caught.value.message, 0, "exhaustive")
    assert not (job.model).exists()


@pytest.mark.integration
@pytest.mark.usefixtures("few_pairs")
@pytest.mark.parametrize(("minutes", "skipped"), [(0.0, True), (1.0, False)])
def test_a_mapper_is_skipped_by_the_work_that_is_left_and_by_no_clock(
        capture, monkeypatch, minutes, skipped):
    job, _ = capture
    clock = itertools.count(step=3600)  # as on a machine that is busy with something else
    monkeypatch.setattr(fallbacks.time, "monotonic", lambda: next(clock))
    monkeypatch.setattr(fallbacks, "shortfall", lambda *_, **__: "the model cannot be trusted")
    result = build(replace(job, max_minutes=minutes))
    assert [bool(attempt.skipped) for attempt in result.attempts] == [False, skipped, skipped]
    assert result.parts[0].names == job.names


def test_the_work_of_a_further_mapper_grows_with_pairs_frames_and_attempts(capture):
    job, _ = capture
    seconds = [fallbacks._count_seconds(*each) for each in (
        (job, set(), 1), (job, {("a.png", "b.png")}, 1), (job, set(), 2), (sized(job, 40), set(), 1)
    )]
    assert min(seconds) == seconds[0] > 0
    assert len(set(seconds)) == 4


@pytest.mark.integration
@pytest.mark.usefixtures("few_pairs")
@pytest.mark.parametrize(("least", "tried"), [(0.5, [True, False, False]), (1.1, [True] * 3)])
def test_late_mappers_improve_no_model_that_is_enough_but_replace_one_that_is_not(
        capture, monkeypatch, least, tried):
    job, _ = capture
    monkeypatch.setattr(fallbacks, "shortfall", lambda *_, **__: "some frames are apart")
    monkeypatch.setattr(fallbacks.checks, "check_registered", lambda *_: None)
    result = build(replace(job, min_registered=least, max_minutes=20.0, spare_minutes=0.0))
    assert [not attempt.skipped for attempt in result.attempts] == tried
    assert result.parts[0].names == job.names


@pytest.mark.parametrize(("held", "trusted", "minutes"), [
    (58, True, 17.0), (40, True, 14.0), (40, False, 0.0), (20, True, 0.0)])
def test_a_model_that_lacks_frames_is_worth_more_of_the_time(capture, held, trusted, minutes):
    job = replace(sized(capture[0], 60), max_minutes=20.0, spare_minutes=3.0)
    attempt = replace(GOOD, registered=NAMES[:held], trusted=trusted)
    assert fallbacks._unneeded_minutes(job, [attempt]) == minutes


def test_a_job_has_less_time_left_after_some_of_it(capture):
    job = replace(capture[0], max_minutes=20.0, spare_minutes=3.0)
    assert (job.after(2.0).max_minutes, job.after(2.0).spare_minutes) == (18.0, 1.0)
    assert job.after(5.0).spare_minutes == 0.0
    assert replace(job, spare_minutes=None).after(5.0).spare_minutes is None


@pytest.mark.integration
@pytest.mark.usefixtures("few_pairs")
def test_an_interrupted_build_goes_on_after_the_last_finished_attempt(capture, monkeypatch):
    job, _ = capture
    monkeypatch.setattr(mapper, "map_incrementally", nothing)
    monkeypatch.setattr(mapper, "map_relaxed", nothing)
    monkeypatch.setattr(mapper, "map_globally", interrupt)
    with pytest.raises(KeyboardInterrupt):
        build(job)
    assert job.tried.is_finished("relaxed")
    monkeypatch.undo()
    monkeypatch.setattr(mapper, "map_incrementally", interrupt)
    result = build(job)
    assert [attempt.name for attempt in result.attempts] == ["exhaustive", "relaxed", "global"]
    assert result.attempts[2].kept


@pytest.mark.usefixtures("few_pairs")
@pytest.mark.parametrize("place", [
    "match", "publish",
    *(pytest.param(place, marks=pytest.mark.slow)
      for place in ("models", "model", "note", "verdict"))])
def test_a_full_disk_is_said_to_be_one_and_the_next_try_ends_well(capture, monkeypatch, place):
    job, truth = capture
    owner, name = {
        "match": (fallbacks.database, "pair_names"), "models": (mapper, "map_incrementally"),
        "model": (fallbacks, "write_model"), "note": (StepFolder, "finish"),
        "verdict": (parts.atomic, "write_json"), "publish": (parts, "publish")}[place]

    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(owner, name, full)
    with pytest.raises(OSError) as caught:  # noqa: PT011
        build(job)
    assert caught.value.errno == errno.ENOSPC
    assert not (job.model).exists()
    monkeypatch.undo()
    assert build(job).parts[0].names == job.names
    assert center_error(pycolmap.Reconstruction(job.model), truth) < 1e-3


def interrupt(*_, **__):
    raise KeyboardInterrupt


@pytest.mark.parametrize("video", [True, False])
def test_a_video_is_not_mapped_as_a_whole_after_its_segments(tmp_path, video):
    names = tuple(f"{index:06d}.png" for index in range(300))
    job, _ = make_capture(tmp_path)
    tracks = tmp_path / "tracks"
    empty = np.zeros(0, np.int32)
    Tracks(names, empty, empty, np.zeros((0, 2), np.float32)).write(tracks)
    job = replace(job, groups=(CameraGroup(names, 9, 9),), segments=(names[:200], names[180:]),
                  tracks=tracks if video else None)
    first, *others = list_fallbacks(job)
    assert first.name == "segments"
    assert_facts(first.reason, 300, "2 segments")
    assert bool(others) != video
