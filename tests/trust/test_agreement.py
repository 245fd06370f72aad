"""Sparsification and reliability in closed form."""

import numpy as np
import pytest

from recon_cli.trust.agreement import ause, reliability, sparsification


def test_the_oracle_and_whatever_ranks_like_it_have_no_area():
    errors = np.random.default_rng(0).random(5000)
    assert ause(errors, errors, errors**3) == pytest.approx((0, 0), abs=1e-12)
    assert ause(np.ones(100), np.arange(100.0)) == pytest.approx((0,), abs=1e-12)


def test_chance_keeps_the_mean_and_the_reverse_is_worse():
    rng = np.random.default_rng(0)
    errors = rng.random(50_000)
    curve = sparsification(errors, rng.random(50_000))
    np.testing.assert_allclose(curve[:90], 1, atol=0.05)
    # uniform errors: 1 - k / 100 is the oracle's curve, 1 that of chance, 1 + k / 100 the reverse
    assert ause(errors, rng.random(50_000), -errors) == pytest.approx((0.495, 0.99), abs=0.01)


def test_the_gap_is_that_of_the_bins():
    expected = np.repeat(np.arange(1, 11) / 100, 50)
    exact = reliability([expected], [expected])
    assert exact.gap == pytest.approx(0)
    assert exact.real == pytest.approx(tuple(np.arange(1, 11) / 100))
    assert reliability([2 * expected], [expected]).gap == pytest.approx(0.5)
    halves = reliability([expected[:250], expected[250:]], [expected[:250], expected[250:]])
    assert halves == exact
