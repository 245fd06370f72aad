import logging
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import summaries
from facts import assert_facts, raises
from sfm_inputs import run, run_here, run_place, texture, turning, write_inputs

from recon_cli import time_estimate
from recon_cli.config.stages import SfmConfig
from recon_cli.context import StageContext
from recon_cli.errors import ConfigError, FormatError, SfmError
from recon_cli.sfm import database
from recon_cli.sfm.job import CameraGroup
from recon_cli.sfm.results import MappingResult, ModelResult
from recon_cli.sfm.segments.segments import SegmentRuns
from recon_cli.stages import place, sfm
from recon_cli.workspace.records import Frame, FrameList, Group
from recon_cli.workspace.summaries import (
    AttemptSummary,
    PartSummary,
    PlacedPart,
    PosesSummary,
    SfmSummary,
)


@pytest.mark.integration
def test_a_grey_video_is_said_to_show_no_texture(tmp_path):
    grey = {f"{index:06d}.png": np.full((120, 160, 3), 90, np.uint8) for index in range(5)}
    with raises(SfmError, 0, 5, "features"):
        run(write_inputs(tmp_path, grey), tmp_path / "out")


@pytest.mark.integration
@pytest.mark.parametrize(("pairs", "count"), [
    ("exhaustive", 66),
    ("sequential", 65),  # all but the first with the last: neighbours reach 10 frames far
])
def test_a_camera_that_turns_on_the_spot_is_not_taken_for_a_success(tmp_path, pairs, count):
    out = tmp_path / "out"
    with raises(SfmError, "camera", "move"):
        run_here(write_inputs(tmp_path, turning(12)), out, pairs=pairs, max_minutes=1.0)
    assert not (out / "sparse").exists()
    assert database.progress(out / "database.db", "matches") == count


@pytest.mark.parametrize(("count", "given", "limit"), [
    (75, None, 20), (100, None, 20), (292, None, 58.4), (292, 5.0, 5.0)])
def test_the_time_limit_follows_the_frames(count, given, limit):
    frames = FrameList("photos", (Group("a", 9, 9),), tuple(
        Frame(f"{index:06d}.png", None, "a", None, held_out=False) for index in range(count)))
    assert sfm._time_limit(SfmConfig(max_minutes=given), frames) == pytest.approx(limit)


def told_times(tmp_path, monkeypatch, *, frames=300, minutes=58.4, slowness=1.0, **changes):
    """What is said before a capture is mapped, on a machine that is so many times as slow."""
    monkeypatch.setattr(time_estimate, "measure_slowness", lambda _: slowness)
    notices = []
    names = tuple(f"{index:06d}.png" for index in range(frames))
    job = SimpleNamespace(**{
        "out": tmp_path, "names": names, "groups": (CameraGroup(names, 640, 360),), "pairs": "auto",
        "known_poses": False, "tracks": None, "max_minutes": minutes, **changes})
    sfm._tell_time(SfmConfig(), job, SimpleNamespace(
        notice=notices.append, tell=notices.append, threads=2))
    return notices


def test_one_time_is_told_before_a_capture_is_mapped(tmp_path, monkeypatch):
    notice, = told_times(tmp_path, monkeypatch)
    assert_facts(notice, "300 frames", "minutes")
    assert "--max-minutes" not in notice
    assert len(re.findall(r"\d+(?:\.\d+)?", notice)) == 2  # the frames, and one time


def test_the_limit_is_told_where_it_is_near(tmp_path, monkeypatch):
    notice, = told_times(tmp_path, monkeypatch, minutes=4.0)
    assert_facts(notice, "4", "--max-minutes")


def test_a_slow_machine_is_told_more(tmp_path, monkeypatch):
    times = [float(re.search(r"about ([\d.]+) minute", notice)[1]) for slowness in (1.0, 4.0)
             for notice in told_times(tmp_path, monkeypatch, slowness=slowness)]
    assert times[1] == pytest.approx(4 * times[0], rel=0.05)


@pytest.mark.parametrize("changes", [
    {"frames": 40}, {"known_poses": True}, {"pairs": "exhaustive"}])
def test_what_is_short_or_not_known_is_not_told(tmp_path, monkeypatch, changes):
    assert told_times(tmp_path, monkeypatch, **changes) == []


@pytest.mark.integration
def test_frames_that_show_different_things_are_said_to_do_so(tmp_path):
    images = {f"{seed}.png": texture(180, 240, seed) for seed in range(4)}
    with raises(SfmError, "frames", "match"):
        run_here(write_inputs(tmp_path, images), tmp_path / "out", max_minutes=1.0)


def test_a_missing_twin_is_found_before_anything_is_done(tmp_path):
    base = write_inputs(
        tmp_path, {f"{index}.png": np.zeros((48, 64, 3), np.uint8) for index in range(3)})
    (base / "denoise" / "frames" / "1.png").unlink()
    found = SfmSummary(frames=3, poses=None, models=(3,), apart=(), attempts=(), seconds={}, parts=(
        PartSummary(names=("0.png", "1.png", "2.png"), points=9),))
    with raises(FormatError, 1, 3, "1.png") as caught:
        run_place(base, tmp_path / "sfm", found, tmp_path / "out")
    assert "recon denoise" in caught.value.hint
    assert not (tmp_path / "out" / "log.txt").exists()


@pytest.mark.integration
def test_a_broken_frame_is_an_error_of_the_file_not_of_the_mapping(tmp_path):
    base = write_inputs(
        tmp_path, {f"{index}.png": np.zeros((48, 64, 3), np.uint8) for index in range(3)})
    (base / "ingest" / "frames" / "2.png").write_bytes(b"no picture")
    with raises(FormatError, 1, 3, "2.png"):
        run(base, tmp_path / "out")


def attempt(name, **fields):
    """What became of one mapper."""
    return AttemptSummary(**{
        "name": name, "reason": "", "skipped": "", "registered": 0, "models": (), "weak_link": None,
        "reprojection_error_px": None, "seconds": 1.0, "kept": False, **fields})


def told(caplog, **changes):
    """What the stage says of a summary."""
    summary = replace(
        summaries.PLACE, frames=60, unregistered=tuple(f"{i}.png" for i in range(11)), models=(49,),
        attempts=(attempt("exhaustive", registered=40),))
    names = sorted(f"{index}.png" for index in range(60))
    frames = FrameList("video", (Group("a.mp4", 60, 40),), tuple(
        Frame(name, index / 2, "a.mp4", None, held_out=False) for index, name in enumerate(names)))
    caplog.set_level(logging.DEBUG, logger="recon")
    place._report(replace(summary, **changes), frames, StageContext())
    return caplog.text


def test_the_stretches_that_are_left_out_are_told_with_their_times(caplog):
    text = told(caplog, left_out=("20.png", "21.png", "22.png", "30.png"))
    assert_facts(text, "model", 4, "20.png", "22.png", "6.5", "7.5 s", "30.png", "12.0 s")


def test_models_that_are_left_aside_are_told(caplog):
    text = told(caplog, models=(49, 3), apart=(("5.png", "6.png", "7.png"),))
    assert_facts(text, "disconnected", 3, "frames", "22.5", "6.png", "7.png")


def test_frames_without_a_camera_are_told(caplog):
    text = told(caplog, unregistered_held_out=("3.png",))
    assert_facts(text, "camera", "11 of 60", "0.png", "10.png", "0.0", "1.0 s")
    assert_facts(text, 1, "Held-out", "3.png")


def test_where_there_is_a_verdict_it_speaks_of_the_missing_frames(caplog):
    text = told(caplog, lines=("All but eleven hang together.",), verdict={"trusted": False})
    assert_facts(text, "eleven", "hang", "together")
    assert "11 of 60" not in text


def test_a_sound_model_gives_no_notice_though_the_log_tells_how_it_was_found(caplog):
    told(caplog, lines=("60 of 60 images have a camera.", "Weakest cut: 99%."), unregistered=(),
         verdict={"trusted": True}, attempts=(attempt("tracks"), attempt("relaxed")))
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]
    assert "Weakest cut" in caplog.text
    levels = {record.getMessage(): record.levelno for record in caplog.records}
    assert levels["Weakest cut: 99%."] == logging.DEBUG, "a terminal shows no jargon"


def test_frames_that_were_taken_out_of_the_model_are_told_with_the_reason(caplog):
    text = told(caplog, rejected={"9.png": "5% of its 200 matches agree"})
    assert_facts(text, "9.png", "5% of its 200 matches agree")


def test_how_far_given_poses_were_moved_is_told(caplog):
    text = told(caplog, poses=PosesSummary(
        use="refine", metric=True, moved_median=0.0021, moved_max=0.013, turned_median_deg=0.04,
        turned_max_deg=0.31))
    assert_facts(text, "0.21%", "1.30%", 0.04, 0.31)


def test_every_further_way_to_a_model_is_told_with_its_reason(caplog):
    text = told(caplog, attempts=(
        attempt("exhaustive", registered=40),
        attempt("relaxed", reason="only 40 of 60 frames got a camera", registered=49, kept=True),
        attempt("global", reason="the capture fell into 2 models",
                skipped="it would take about 9 minutes")))
    assert_facts(text, "relaxed", "40 of 60", 49)
    assert_facts(text, "global", 2, 9, "minutes")
    assert "exhaustive" not in text


@pytest.mark.integration
def test_paths_are_resolved_before_the_process_leaves_the_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    grey = {f"{index}.png": np.full((60, 80, 3), 90, np.uint8) for index in range(3)}
    write_inputs(Path("in"), grey)
    with raises(SfmError, "features"):
        run(Path("in"), Path("out"))


def test_a_problem_of_the_model_before_goes_on_within_the_sentence():
    broken = attempt("global", reason="The model is broken.", registered=9)
    line, = place._attempts(SimpleNamespace(attempts=[attempt("exhaustive"), broken]))
    assert_facts(line, "global", "broken", 9)
    assert ".:" not in line


def test_held_out_frames_of_a_part_that_is_left_out_are_counted():
    names = [f"{index}.png" for index in range(6)]
    frames = FrameList("video", (Group("a.mp4", 64, 48),), tuple(
        Frame(name, None, "a.mp4", None, held_out=name in ("0.png", "4.png")) for name in names))
    part = PartSummary(names=tuple(names[:3]), points=9)
    model = ModelResult(parts=(part,), models=(3,), poses=None, apart=(), attempts=(),
                        left_out=tuple(names[3:5]))
    found = sfm._summary(frames, SegmentRuns(SimpleNamespace(segments=()), {}, {}),
                         MappingResult(model, {}, {}))
    summary = place._summary(frames, found, 1, PlacedPart(
        points=9, mean_track_length=None, reprojection_error_px=None,
        median_triangulation_angle_deg=None, verdict=None, lines=(), world=summaries.WORLD,
        cameras=()))
    assert summary.left_out == ("3.png", "4.png")
    assert summary.unregistered == ("3.png", "4.png", "5.png")  # no mapper found a place for 5
    assert summary.unregistered_held_out == ("4.png",)


def test_a_camera_model_that_colmap_does_not_have_is_refused_by_name(tmp_path):
    inputs = write_inputs(tmp_path, turning(3))
    with raises(ConfigError, "GOPRO", "camera_model") as caught:
        run(inputs, tmp_path / "out", camera_model="GOPRO")
    assert "OPENCV_FISHEYE" in caught.value.hint
