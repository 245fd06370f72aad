"""Decisions by paired trials: when they are made, on which views, and by which score."""

import math
import time

import numpy as np
import pytest
from facts import assert_facts, raises

from recon_cli.evaluation.metrics import corrected_psnr
from recon_cli.train.parts.decisions import LEAST_SCORED, Rule, decide, skip_trial, split

BASE = [20.0, 31.0, 25.0, 28.0, 22.0, 33.0, 27.0, 24.0]


def decided(gains, clock=time.perf_counter, **rule):
    arms = (lambda: BASE[: len(gains)],
            lambda: [base + gain for base, gain in zip(BASE, gains, strict=False)])
    return decide("part", arms, Rule(**rule), clock=clock)


def test_the_mean_and_its_error_are_those_of_paired_differences():
    decision = decided([0.1, 0.3, 0.2, 0.4])
    assert decision.mean_db == pytest.approx(0.25)
    assert decision.standard_error_db == pytest.approx(math.sqrt(0.05 / 3) / 2)


def test_a_gain_over_threshold_and_error_switches_the_part_on():
    decision = decided([0.3, 0.35, 0.25, 0.3, 0.3, 0.32, 0.28, 0.3])
    assert decision.on
    assert_facts(decision.reason, "+0.30", "dB", "0.01", 8)


def test_a_small_gain_is_not_worth_it_however_sure():
    decision = decided([0.04] * 8)
    assert not decision.on
    assert decided([0.04] * 8, threshold_db=0.03).on


def test_a_gain_that_rests_on_one_view_does_not_count():
    decision = decided([2.0, 0, 0, 0, 0, 0, 0, 0])
    assert decision.mean_db > 0.2
    assert not decision.on
    assert_facts(decision.reason, "0.41", "dB")


def test_a_gain_that_need_not_be_sure_counts_from_the_threshold_on():
    assert decided([2.0, 0, 0, 0, 0, 0, 0, 0], errors=0).on
    assert not decided([0.3, 0, 0, 0, 0, 0, 0, 0], errors=0).on


def test_a_loss_keeps_the_part_off():
    assert not decided([-0.5] * 8).on


@pytest.mark.parametrize(("gains", "on"), [
    ([2.0, -1.5, 0, 0.1, -1, 0.3, -0.2, 0.1], True),  # nothing is sure
    ([-0.5, -0.4, -0.6, -0.3, -0.5, -0.4, -0.6, -0.5], False),
    ([-0.04] * 8, True), ([0.3, math.nan, 0.3, 0.3], False)])
def test_a_part_that_is_on_anyway_goes_off_by_a_sure_loss(gains, on):
    assert decided(gains, unless_worse=True).on is on


def test_an_arm_that_broke_down_keeps_the_part_off():
    assert not decided([0.3, math.nan, 0.3, 0.3]).on


def test_arms_that_do_not_pair_are_refused():
    with raises(ValueError, "scores"):
        decide("part", (lambda: [20.0, 21.0], lambda: [20.0]))
    with raises(ValueError, "scores"):
        decide("part", (lambda: [20.0], lambda: [21.0]))


def test_the_seconds_of_both_arms_are_counted():
    ticks = iter([10.0, 17.5])
    assert decided([0.1, 0.2], clock=lambda: next(ticks)).seconds == 7.5


def test_what_is_skipped_costs_nothing_and_says_why():
    decision = skip_trial("exposure", "the gains of the views differ by 0.01")
    assert (decision.on, decision.mean_db, decision.seconds) == (False, None, 0.0)
    assert "0.01" in decision.reason


def test_enough_validation_views_are_what_a_trial_scores():
    chosen = split(80, LEAST_SCORED)
    assert not chosen.own
    assert (chosen.train, chosen.held_out) == (tuple(range(80)), tuple(range(LEAST_SCORED)))


def test_with_few_validation_views_each_sixth_training_view_is_held_out():
    chosen = split(80, 4)
    assert chosen.own
    assert chosen.held_out == (3, 9, 15, 21, 27, 33, 39, 45, 51, 57, 63, 69, 75)
    assert sorted(chosen.train + chosen.held_out) == list(range(80))


def test_a_capture_of_few_views_has_no_trial():
    assert split(22, 3) is None
    assert split(23, 3) is not None


def test_of_few_views_more_are_held_out_down_to_each_third():
    assert split(40, 2).held_out == (2, 7, 12, 17, 22, 27, 32, 37)
    assert split(24, 2).held_out == (1, 4, 7, 10, 13, 16, 19, 22)


def picture():
    return np.random.default_rng(0).integers(20, 200, (12, 15, 3), np.uint8)


def test_a_picture_that_is_off_by_a_gain_alone_is_perfect():
    truth = picture()
    image = (truth / 255 * [0.8, 1.1, 0.6]).astype(np.float32)
    assert corrected_psnr(image, truth) == pytest.approx(100, abs=1)


def test_an_error_that_no_gain_mends_is_scored_as_it_is():
    # the image differs from the truth by +-e, half of it each way and whatever the truth: the
    # least-squares gain is 1 / (1 + e^2 / mean x^2), as close to 1 as the error is small
    truth = np.full((10, 10, 3), 128, np.uint8)
    sign = np.where(np.indices((10, 10)).sum(axis=0) % 2, 1.0, -1.0)[..., None]
    image = (truth / 255 + 0.01 * sign).astype(np.float32)
    assert corrected_psnr(image, truth) == pytest.approx(40, abs=0.01)


def test_only_pixels_that_count_fit_the_gain_and_the_score():
    truth, mask = picture(), np.ones((12, 15), bool)
    mask[:4] = False
    image = (truth / 255 * 0.7).astype(np.float32)
    image[:4] = 0.9
    assert corrected_psnr(image, truth, mask) == pytest.approx(100, abs=1)
    assert corrected_psnr(image, truth) < 40


def test_a_black_picture_has_a_score():
    truth = np.full((10, 10, 3), 255, np.uint8)
    assert corrected_psnr(np.zeros((10, 10, 3), np.float32), truth) == pytest.approx(0)
