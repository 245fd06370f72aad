"""Heights above the floor along a walk, and what they say of its scale."""

import numpy as np
import pytest
from made_model import MadeModel, along, wall

from recon_cli.sfm.floor_heights import MAX_LOG_STEP, SPREAD, compare_heights, measure_heights
from recon_cli.sfm.scale_drift import _ask_floor

HEIGHT = 1.6  # of the cameras, whose y axis points down


def hall(*, floor: bool) -> MadeModel:
    """Thirty cameras along a wall, over a floor where there is one."""
    draws = np.random.default_rng(0)
    ground = np.column_stack([
        draws.uniform(-6, 20, 3000), np.full(3000, HEIGHT), draws.uniform(3, 9, 3000)])
    points = wall(-6, 20, count=1500) * [1, 0.5, 1]
    return MadeModel(np.concatenate([points, ground[:3000 * floor]]), along(np.arange(30) * 0.4))


def test_the_height_is_that_over_the_floor_and_unknown_without_one():
    made = hall(floor=True)
    heights = measure_heights(made.model(), made.names)
    assert heights == pytest.approx(np.full(30, HEIGHT), abs=0.15)  # the cameras wobble by .1
    bare = hall(floor=False)
    assert np.isnan(measure_heights(bare.model(), bare.names)).all()


def test_two_sides_are_compared_by_their_middle_heights():
    heights = np.repeat([1.5, 2.0], 30)
    assert compare_heights(heights, 30) == pytest.approx(np.log(2.0 / 1.5))
    assert compare_heights(np.repeat([1.5, 1.5 * np.exp(MAX_LOG_STEP + 0.01)], 30), 30) is None
    assert compare_heights(np.where(np.arange(60) < 5, 1.5, np.nan), 30) is None


def test_the_floor_decides_where_the_cameras_know_little_and_nothing_where_they_know_much():
    assert _ask_floor(0.2, None) == 0.2
    assert _ask_floor(1e6, 0.3) == pytest.approx(0.3)
    assert _ask_floor(0.001, 0.3) == pytest.approx(0.001, rel=0.01)
    assert _ask_floor(0.2, 0.0) == pytest.approx((1 / 0.2**2 + 1 / SPREAD**2) ** -0.5)
    errors = np.array([_ask_floor(error, 0.1) for error in np.linspace(0.01, 1, 50)])
    assert (np.diff(errors) > 0).all()
