import cv2
import numpy as np
import pytest
from media import texture

from recon_cli.capture.raw_exposure import (
    complete_exposures,
    drop_contradicted,
    exposures,
    measure_view,
    nominal_ev,
)


def chain(ev, reach=2):
    """Exposures as pairs of photos show them exactly."""
    return {
        (a, b): ev[b] - ev[a]
        for a in range(len(ev)) for b in range(a + 1, min(a + 1 + reach, len(ev)))}


def test_exposure_is_time_times_sensitivity():
    assert nominal_ev(1 / 64, 100) == pytest.approx(np.log2(100 / 64))
    assert nominal_ev(1 / 32, 100) == pytest.approx(nominal_ev(1 / 64, 100) + 1)


@pytest.mark.parametrize("unknown", [(0, 100), (1, 0), (float("nan"), 100)])
def test_a_value_that_is_missing_makes_the_exposure_unknown(unknown):
    assert nominal_ev(*unknown) is None


def test_exif_that_the_pixels_confirm_is_believed_to_the_digit():
    ev = [0.0, 1.0, -1.0, 0.5]
    pairs = {pair: apart + 0.2 for pair, apart in chain(ev).items()}  # light that drifts
    assert drop_contradicted(ev, pairs) == ev
    np.testing.assert_array_equal(complete_exposures(ev, pairs), ev)


@pytest.mark.parametrize("wrong", [0, 3, 6])
def test_a_wrong_exif_is_found_wherever_it_stands_and_its_neighbours_are_kept(wrong):
    ev = [0.0, 1.0, -1.0, 0.5, 0.0, 1.0, 0.0]
    told = [*ev[:wrong], ev[wrong] + 1.5, *ev[wrong + 1:]]
    kept = drop_contradicted(told, chain(ev))
    assert [k for k, own in enumerate(kept) if own is None] == [wrong]
    np.testing.assert_allclose(complete_exposures(kept, chain(ev)), ev, atol=0.01)


def test_one_pair_alone_does_not_overrule_exif():
    assert drop_contradicted([0.0, 0.0], {(0, 1): 2.0}) == [0.0, 0.0]


def test_without_any_exif_the_chain_is_followed():
    ev = np.array([0.0, 1.0, 3.0, 2.0, -1.0])
    found = complete_exposures([None] * 5, chain(ev))
    np.testing.assert_allclose(found - found[0], ev, atol=0.01)


def test_one_wrong_pair_is_outvoted():
    ev = np.array([0.0, 1.0, 3.0, 2.0, -1.0, 0.0])
    pairs = chain(ev, reach=4)
    pairs[1, 2] += 4
    found = complete_exposures([None] * 6, pairs)
    np.testing.assert_allclose(found - found[0], ev, atol=0.03)


def test_a_photo_of_which_nothing_is_known_gets_the_middle_of_the_others():
    np.testing.assert_allclose(complete_exposures([1.0, 2.0, 4.0, None], {}), [1, 2, 4, 2])


def view(left, ev, *, seed=0):
    """A window onto one wall of soft blocks, exposed by `ev`."""
    wall = cv2.GaussianBlur(texture(200, 500, seed=seed, coarseness=12), (0, 0), 1.5) / 255.0
    linear = (0.3 * wall[:, left:left + 300] ** 2.2 * 2.0**ev).astype(np.float32)
    return measure_view(np.clip(linear, 0, 1), linear.max(axis=2) >= 1)


def test_pixels_of_overlapping_views_show_the_exposure():
    ev = [0.0, 1.0, -1.0, 0.5]
    found = exposures([view(20 * k, own) for k, own in enumerate(ev)], [None] * 4)
    np.testing.assert_allclose(found - found[0], ev, atol=0.02)
    assert np.median(found) == 0


def test_views_of_different_walls_show_nothing():
    found = exposures([view(0, 0.0), view(0, 2.0, seed=1)], [None, None])
    np.testing.assert_allclose(found, 0)


def test_a_black_view_is_taken():
    black = measure_view(np.zeros((60, 80, 3), np.float32), np.zeros((60, 80), bool))
    assert exposures([black, view(0, 0.0)], [None, None]).tolist() == [0, 0]
