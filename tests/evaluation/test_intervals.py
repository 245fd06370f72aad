"""Spreads and paired intervals, against closed forms and scipy's own test."""

import numpy as np
import pytest

from recon_cli.evaluation.intervals import Spread, paired_bootstrap, paired_t


def test_a_spread_is_the_mean_and_the_deviation_of_a_sample():
    found = Spread.from_values([2.0, 4.0, 4.0, 4.0, 5.0, 5.0, 7.0, 9.0])
    assert found.mean == 5.0
    assert found.deviation == pytest.approx((32 / 7) ** 0.5)
    assert Spread.from_values([3.0]).deviation is None


def test_two_seeds_give_the_interval_of_the_cauchy_distribution():
    # differences 1 and 3: mean 2, standard error 1; the t distribution of one degree of freedom
    # has its 97.5% quantile at tan(0.475 pi)
    found = paired_t([2.0, 5.0], [1.0, 2.0])
    assert found.mean == 2.0
    assert found.high - 2 == pytest.approx(np.tan(0.475 * np.pi))
    assert 2 - found.low == pytest.approx(np.tan(0.475 * np.pi))
    assert found.verdict not in ("higher", "lower")


@pytest.mark.parametrize("n", [2, 3, 5, 12])
def test_the_interval_is_that_of_the_paired_t_test(n):
    from scipy import stats  # takes a second

    generator = np.random.default_rng(n)
    ours, theirs = generator.normal(0.3, 1, n), generator.normal(0, 1, n)
    found = paired_t(ours.tolist(), theirs.tolist())
    expected = stats.ttest_rel(ours, theirs).confidence_interval(0.95)
    assert found.mean == pytest.approx((ours - theirs).mean())
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high))


def test_what_seeds_have_in_common_does_not_widen_the_interval():
    common = [10.0, 20.0, 30.0]
    found = paired_t([value + 0.5 for value in common], common)
    assert (found.low, found.mean, found.high) == pytest.approx((0.5, 0.5, 0.5))
    assert found.verdict == "higher"
    assert paired_t(common, [value + 0.5 for value in common]).verdict == "lower"
    assert paired_t(common, common).verdict not in ("higher", "lower")


def test_one_seed_has_no_interval():
    found = paired_t([2.0], [1.0])
    assert (found.mean, found.low, found.high, found.verdict) == (1.0, None, None, "one seed")


def test_seeds_without_a_partner_are_refused():
    with pytest.raises(ValueError):  # noqa: PT011
        paired_t([1.0, 2.0], [1.0])


def test_a_constant_difference_has_an_interval_of_no_width():
    found = paired_bootstrap([30, 32, 29.5], [29, 31, 28.5])
    assert (found.mean, found.low, found.high) == (1.0, 1.0, 1.0)


def test_the_interval_of_a_paired_difference_is_that_of_a_normal_mean():
    rng = np.random.default_rng(0)
    theirs = rng.normal(30, 3, 200)
    ours = theirs + rng.normal(0.2, 0.5, 200)
    found = paired_bootstrap(ours, theirs)
    half = 1.96 * (ours - theirs).std() / np.sqrt(200)
    assert found.low == pytest.approx(found.mean - half, abs=0.01)
    assert found.high == pytest.approx(found.mean + half, abs=0.01)
    assert paired_bootstrap([1.0], [0.5]).low is None
