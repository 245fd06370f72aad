"""The quality of a scene in a word: what makes it good, fair and poor, and what is named."""

import dataclasses

import pytest
import summaries
from facts import assert_facts

from recon_cli.evaluation.scores import Metrics, ModelMetrics, ViewScore
from recon_cli.trust.quality import (
    describe_quality,
    find_doubtful_cameras,
    find_failed_views,
    read_quality,
)
from recon_cli.trust.records import ModelTrust, PoorlySeenRegion, SurfaceShares, TrustRecord
from recon_cli.workspace.records import Frame

TRUSTED = dataclasses.replace(
    summaries.PLACE, frames=100, registered=100, verdict={"trusted": True}, left_out=(), parts=())


def metrics(*psnr_db, ssim=0.95, name="pruned"):
    views = tuple(ViewScore(f"{at}.png", value, value, ssim, ssim)
                  for at, value in enumerate(psnr_db))
    model = ModelMetrics.from_views(views, gaussians=1, bytes=1, render_ms=1.0)
    return Metrics(
        models={name: model}, psnr_convention="", psnr_8bit_convention="", ssim_convention="",
        ssim_padded_convention="", lpips_convention="", truth_digest="", width=1, height=1,
        test_views=len(views), unregistered_test=())


def trust(well, *regions):
    seen = ModelTrust(
        views=9, error=None, surface=SurfaceShares(well=well, narrow=1 - well, few=0.0, cells=100))
    return TrustRecord(models=("pruned",), pruned=seen, poorly_seen=regions)


def corner(share):
    return PoorlySeenRegion(position=(0.0, 0.0, 0.0), size=1.0, share=share, few=True, views=1,
                            span_deg=0.0, frame="7.png")


def test_a_good_scene_says_its_figures_and_its_weakest_view():
    frames = [Frame("1.png", 65.4, "room.mp4", None, True)]
    found = describe_quality(metrics(33.0, 29.4), trust(0.94), TRUSTED, frames)
    assert_facts(str(found), "good", "31.2 dB", "94%", "1.png", "1:05", "29.4 dB")


def test_a_large_region_that_is_poorly_seen_is_named_before_a_view():
    found = describe_quality(metrics(31.0), trust(0.92, corner(0.03)), TRUSTED)
    assert found.word == "good"
    assert_facts(found.reason, "7.png", "3%", "1 view")
    found = describe_quality(metrics(31.0), trust(0.99, corner(0.004)), TRUSTED)
    assert "7.png" not in found.reason


@pytest.mark.parametrize(("scores", "well", "sfm", "word", "why"), [
    (metrics(27.0, 26.0), 0.99, TRUSTED, "fair", "good scenes have 28 dB or more"),
    (metrics(31.0, ssim=0.85), 0.99, TRUSTED, "fair", "SSIM 0.85"),
    (metrics(31.0), 0.7, TRUSTED, "fair", "70% of the surface well seen; 90% or more are good"),
    (metrics(38.0, 38.0, 18.0), 0.99, TRUSTED, "fair", "2.png failed"),
    (metrics(38.0, 38.0, 18.0, 17.0), 0.99, TRUSTED, "fair", "3.png and 1 more failed (17.0 dB)"),
    (metrics(31.0), 0.99, dataclasses.replace(TRUSTED, registered=60), "fair",
     "only 60 of 100 frames have a camera"),
    (metrics(21.0), 0.99, TRUSTED, "poor", "held-out views 21.0 dB"),
    (metrics(31.0), 0.99, dataclasses.replace(TRUSTED, verdict={"trusted": False}), "poor",
     "the camera poses cannot be trusted"),
])
def test_what_is_short_of_good_is_said(scores, well, sfm, word, why):
    found = describe_quality(scores, trust(well), sfm)
    assert found.word == word
    assert why in found.reason


def test_without_trust_or_cameras_of_recon_that_is_said_and_the_word_rests_on_the_views():
    found = describe_quality(metrics(31.0, name="base"), None, None)
    assert found.word == "good"
    assert_facts(found.reason, "not", "measured")


def test_without_a_scored_view_nothing_is_claimed(tmp_path):
    assert describe_quality(None, None, TRUSTED).word == "unknown"
    assert read_quality(tmp_path, TRUSTED).word == "unknown"


def test_views_that_failed_are_those_of_the_model_that_is_exported_the_worst_first():
    assert [view.name for view in find_failed_views(metrics(20.0, 30.0, 18.0))] == [
        "2.png", "0.png"]
    assert find_failed_views(None) == ()


@pytest.mark.parametrize(("scores", "doubtful"), [
    ((19.7, 21.0, 18.2, 20.5, 17.1, 22.0, 23.5), []),  # a short training blurs all views
    ((30.0, 29.0, 31.0, 16.0, 28.0), ["3.png"]),
    ((25.0, 24.0, 26.0, 12.0, 15.0, 21.0, 25.5), ["3.png", "4.png"]),
    ((21.0,), [])])
def test_cameras_are_in_doubt_where_views_fail_alone_and_not_where_the_model_is_blurred(
        scores, doubtful):
    assert [view.name for view in find_doubtful_cameras(metrics(*scores))] == doubtful
