import errno
import io
import json
import math
import sqlite3
from dataclasses import dataclass, replace

import pycolmap
import pytest
from synthetic import center_error, make_capture, part

from recon_cli.errors import SfmError
from recon_cli.sfm import fallbacks, mapper
from recon_cli.sfm.fallbacks import Note, best, reachable, rungs, shortfall
from recon_cli.sfm.job import Reporter
from recon_cli.sfm.model_selection import Candidate
from recon_cli.sfm.step_log import Ledger

NAMES = tuple(f"{index:06d}.png" for index in range(60))
GOOD = Note("exhaustive", "", registered=NAMES, trusted=True, weak_link=0.95,
            reprojection_error_px=0.5)


def climb(job, deadline=math.inf):
    return fallbacks.climb(job, Reporter(io.BytesIO()), deadline=deadline)


@pytest.fixture
def capture(tmp_path):
    """Twenty cameras around 300 points, all of them matched."""
    return make_capture(tmp_path)


def sized(job, count):
    return replace(job, groups=(replace(
        job.groups[0], names=tuple(f"{index}.png" for index in range(count))),))


def test_a_small_capture_begins_with_all_pairs_and_a_large_one_with_some(capture):
    job, _ = capture
    assert [rung.name for rung in rungs(sized(job, 100))] == ["exhaustive", "relaxed", "global"]
    assert [rung.name for rung in rungs(sized(job, 101))] == [
        "retrieval", "exhaustive", "relaxed", "global"]


@pytest.mark.parametrize("pairs", ["exhaustive", "retrieval", "sequential"])
def test_a_named_way_is_the_only_one(capture, pairs):
    job, _ = capture
    assert [rung.name for rung in rungs(replace(job, pairs=pairs))] == [pairs]


@dataclass(frozen=True)
class Opinion:
    """As much of a verdict as is looked at."""

    trusted: bool = True
    problems: tuple[str, ...] = ()
    match_parts: tuple[tuple[str, ...], ...] = ()


def candidate(capture, count=20, *, apart=(), opinion=None):
    job, truth = capture
    return Candidate(part(truth, job.names[:count]), opinion or Opinion(), apart, {})


def test_a_good_model_falls_short_of_nothing(capture):
    names = capture[0].names
    assert shortfall(candidate(capture), names) == ""
    assert shortfall(candidate(capture, 18), names) == ""


def test_each_shortfall_is_said(capture):
    names = capture[0].names
    assert Note("exhaustive", "").shortfall == "no model was found"
    assert shortfall(candidate(capture, 17), names) == (
        "only 17 of 20 frames that can be placed got a camera")
    assert shortfall(candidate(capture, 18, apart=(("a", "b", names[19]),)), names) == (
        "the capture fell into 2 models")
    broken = Opinion(trusted=False, problems=("The model is broken.",))
    assert shortfall(candidate(capture, opinion=broken), names) == "The model is broken."


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
    assert best([fewer, GOOD]) is GOOD


def test_a_broken_model_of_all_frames_is_worse_than_a_sound_one_of_most():
    sound = replace(GOOD, name="relaxed", registered=NAMES[:50])
    broken = replace(GOOD, name="global", trusted=False, weak_link=0.1)
    assert best([broken, sound]) is sound


def test_a_model_that_is_not_trusted_is_worse_though_its_matches_agree():
    bent = replace(GOOD, name="relaxed", trusted=False, reprojection_error_px=0.1)
    sound = replace(GOOD, name="global", registered=NAMES[:55])
    assert best([bent, sound]) is sound
    assert best([bent, replace(sound, registered=NAMES[:20])]) is bent


def test_of_two_alike_the_smaller_error_decides_and_then_the_order():
    sharper = replace(GOOD, name="global", reprojection_error_px=0.3)
    assert best([GOOD, sharper]) is sharper
    assert best([GOOD, replace(GOOD, name="relaxed")]) is GOOD


def test_where_no_rung_found_a_model_none_is_best():
    assert best([Note("exhaustive", ""), Note("relaxed", "")]) is None


def test_a_good_capture_stops_at_the_first_rung(capture):
    job, truth = capture
    result = climb(job)
    rung, = result["rungs"]
    assert rung["name"] == "exhaustive"
    assert rung["reason"] == "20 frames are few enough to match all pairs"
    assert rung["registered"] == 20
    assert rung["kept"]
    assert result["registered"] == list(job.names)
    assert result["models"] == [20]
    assert not job.rungs.exists()
    assert center_error(pycolmap.Reconstruction(job.model), truth) < 1e-3
    assert json.loads((job.out / "verdict.json").read_text()) == json.loads(
        json.dumps(result["verdict"]))
    assert json.loads(json.dumps(result, allow_nan=False))


def nothing(*_, **__):
    return []


def test_every_rung_is_tried_until_one_finds_a_model(capture, monkeypatch):
    job, _ = capture
    monkeypatch.setattr(mapper, "incremental", nothing)
    result = climb(job)
    assert [(rung["name"], rung["reason"], rung["kept"]) for rung in result["rungs"]] == [
        ("exhaustive", "20 frames are few enough to match all pairs", False),
        ("relaxed", "no model was found", False),
        ("global", "no model was found", True)]


def test_no_model_at_all_is_a_failure_that_counts_frames(capture, monkeypatch):
    job, _ = capture
    monkeypatch.setattr(mapper, "incremental", nothing)
    monkeypatch.setattr(mapper, "globally", nothing)
    with pytest.raises(SfmError, match="Only 0 of 20 frames have a camera") as caught:
        climb(job)
    assert "exhaustive found 0, relaxed found 0, global found 0" in caught.value.message
    assert not (job.model).exists()


def test_a_rung_that_would_take_longer_than_there_is_time_is_passed_over(capture, monkeypatch):
    job, _ = capture
    monkeypatch.setattr(fallbacks, "shortfall", lambda *_: "the model cannot be trusted")
    result = climb(job, deadline=0.0)
    assert [bool(rung["skipped"]) for rung in result["rungs"]] == [False, True, True]
    assert result["registered"] == list(job.names)


def test_an_interrupted_climb_goes_on_behind_the_last_finished_rung(capture, monkeypatch):
    job, _ = capture
    monkeypatch.setattr(mapper, "incremental", nothing)
    monkeypatch.setattr(mapper, "globally", interrupt)
    with pytest.raises(KeyboardInterrupt):
        climb(job)
    assert Ledger(job.rungs).result("relaxed") is not None
    monkeypatch.undo()
    monkeypatch.setattr(mapper, "incremental", interrupt)
    result = climb(job)
    assert [rung["name"] for rung in result["rungs"]] == ["exhaustive", "relaxed", "global"]
    assert result["rungs"][2]["kept"]


@pytest.mark.parametrize("place", ["match", "models", "model", "note", "verdict", "publish"])
def test_a_full_disk_is_said_to_be_one_and_the_next_try_ends_well(capture, monkeypatch, place):
    job, truth = capture
    owner, name = {
        "match": (fallbacks.database, "pair_names"), "models": (mapper, "incremental"),
        "model": (fallbacks, "_write"), "note": (Ledger, "finish"),
        "verdict": (fallbacks.atomic, "write_json"), "publish": (fallbacks, "publish")}[place]

    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(owner, name, full)
    with pytest.raises(OSError, match="No space left"):
        climb(job)
    assert not (job.model).exists()
    monkeypatch.undo()
    assert climb(job)["registered"] == list(job.names)
    assert center_error(pycolmap.Reconstruction(job.model), truth) < 1e-3


def interrupt(*_, **__):
    raise KeyboardInterrupt
