"""The verdict in plain words, and figures of a summary with their units."""

from pathlib import Path

import pytest
import summaries
from facts import assert_facts

from recon_cli.evaluation.scores import ViewScore
from recon_cli.report.headline import format_facts, judge_poses
from recon_cli.report.stage_status import StageReport
from recon_cli.workspace.manifest import Manifest, ResultKey, RunRecord


def sfm(**summary):
    run = RunRecord(1.0, 1, {**summaries.PLACE.to_json(), **summary}, {}, None, None, 1, "")
    return StageReport("sfm", Path("sfm"), "fresh", "", "recon sfm",
                    Manifest(ResultKey("sfm", 3, {}, (), {}), {}, "", run))


def test_a_trusted_verdict_is_good():
    verdict = judge_poses(
        sfm(verdict={"trusted": True}, lines=["9 of 12; trusted.", "Weakest link."]))
    assert verdict.level == "good"
    assert_facts(verdict.text, "9 of 12")
    assert verdict.lines == ("Weakest link.",)


def test_a_mapping_that_was_accepted_although_weak_is_not_to_be_trusted():
    verdict = judge_poses(sfm(verdict={"trusted": False}, lines=["head", "The model is broken."]))
    assert verdict.level == "warn"
    assert "The model is broken." in verdict.lines


def test_rough_cameras_are_named_above_a_sound_model():
    verdict = judge_poses(sfm(
        verdict={"trusted": True, "rough": ["000007.png"]}, lines=["head"]))
    assert verdict.level == "warn"
    assert "000007.png" in verdict.text


def test_poses_of_a_data_set_are_neither_praised_nor_blamed():
    verdict = judge_poses(
        sfm(verdict=None, poses={"use": "keep", "metric": True}, lines=["100% agree."]))
    assert verdict.level == "unknown"
    assert_facts(verdict.text, "9 of 12", "data")
    assert verdict.lines == ("100% agree.",)


def test_what_was_left_out_of_the_model_is_said():
    verdict = judge_poses(sfm(
        verdict={"trusted": True}, lines=["head"], rejected={"a.png": "astray"},
        apart=[["b.png", "c.png"]]))
    assert_facts("\n".join(verdict.lines), "a.png", "astray")
    assert_facts("\n".join(verdict.lines), "disconnected", 2)


def test_a_part_that_is_kept_is_warned_of_with_what_was_broken():
    broken = "The model is broken. Left out are 3: b.png to d.png."
    verdict = judge_poses(sfm(
        verdict={"trusted": True}, lines=[broken, "9 of 12 images have a camera."],
        left_out=["b.png", "c.png", "d.png"]))
    assert verdict.level == "warn"
    assert_facts(verdict.text, "part", "9 of 12", 3)
    assert verdict.lines[0] == broken


@pytest.mark.parametrize(("name", "value", "expected"), [
    ("validation_psnr_db", 31.9637, ("validation PSNR", "31.96 dB")),
    ("validation_psnr_db_before", 31.9637, ("validation PSNR before", "31.96 dB")),
    ("train_seconds", 70.0, ("train time", "1 min 10 s")),
    ("gaussians", 60000, ("Gaussians", "60,000")),
    ("median_sigma_255", 0.3519, ("median sigma", "0.3519 of 255")),
    ("metric", True, ("metric", "yes")),
    ("bytes", 4_080_415, ("size", "4.1 MB")),
    ("kind", "video", ("kind", "video")),
])
def test_a_fact_has_its_unit(name, value, expected):
    assert format_facts({name: value}) == (expected,)


def test_lists_and_what_is_empty_are_no_format_facts():
    assert format_facts({"a": [], "b": {}, "c": None, "d": "", "cuda_peak_bytes": 0}) == ()


def test_poses_are_not_praised_above_a_view_that_failed():
    failed = ViewScore("000007.png", 18.04, 18.0, 0.5, 0.5)
    verdict = judge_poses(sfm(verdict={"trusted": True}, lines=["head"]), [failed])
    assert verdict.level == "warn"
    assert_facts(verdict.text, "000007.png", "18.0 dB")
