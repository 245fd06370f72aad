"""Poorly seen regions are found where they are, as large as they are, with their cause."""

import numpy as np
import pytest
import torch
from facts import assert_facts
from small_room import dots

from recon_cli.trust.poorly_seen import find_poorly_seen
from recon_cli.trust.records import PoorlySeenRegion
from recon_cli.trust.support import ViewSupport
from recon_cli.trust.surface import find_cells

STEP = 0.05
AROUND = [[-3.0, 0, 3], [3.0, 0, 3], [0, 3.0, 3], [0, -3.0, 3]]  # cameras far apart


def floor(side=4.0):
    """Points of a square floor around the origin."""
    across = np.arange(-side / 2, side / 2, STEP) + STEP / 2
    return np.stack(np.meshgrid(across, across, [0.0]), -1).reshape(-1, 3)


def find(points, seen):
    """`seen` are by view the camera and which points it shows."""
    splats = dots(points)
    support = ViewSupport.from_rows(
        [torch.from_numpy(np.flatnonzero(shown)) for _, shown in seen],
        np.array([center for center, _ in seen], float), torch.zeros(len(points)))
    frames = [f"{number}.png" for number in range(len(seen))]
    return find_poorly_seen(find_cells(splats, support), support, frames)


def within(points, x, y, half):
    return (np.abs(points[:, 0] - x) < half) & (np.abs(points[:, 1] - y) < half)


def test_a_corner_that_one_view_shows_is_found_with_place_size_and_frame():
    points = floor()
    corner = within(points, 1.4, 1.4, 0.4)
    seen = [(center, ~corner) for center in AROUND[:3]]
    (found,) = find(points, [*seen, (AROUND[3], np.ones(len(points), bool))])
    assert found.position == pytest.approx((1.4, 1.4, 0.0), abs=0.1)
    assert found.size == pytest.approx(0.8, abs=0.15)
    assert found.share == pytest.approx(corner.mean(), rel=0.15)
    assert (found.few, found.views, found.frame) == (True, 1, "3.png")


def test_views_from_one_direction_are_a_cause_of_their_own():
    points = floor()
    left = points[:, 0] < -1.2
    near = [([0, 0, 9 + i / 10], np.ones(len(points), bool)) for i in range(4)]
    found = find(points, [*near, *((center, ~left) for center in AROUND)])
    assert {region.few for region in found} == {False}
    assert {region.views for region in found} == {4}
    assert max(region.span_deg for region in found) < 10
    assert sum(region.share for region in found) == pytest.approx(left.mean(), rel=0.15)


def test_what_is_far_apart_is_listed_apart_and_the_largest_comes_first():
    points = floor()
    small, large = within(points, -1.4, -1.4, 0.3), within(points, 1.2, 1.2, 0.5)
    found = find(points, [(center, ~(small | large)) for center in AROUND] + [
        (AROUND[0], np.ones(len(points), bool))])
    assert len(found) == 2
    assert found[0].position[0] > 0 > found[1].position[0]
    assert found[0].share > found[1].share


def test_a_region_as_large_as_the_room_is_cut_so_that_each_place_says_something():
    points = floor()
    found = find(points, [(AROUND[0], np.ones(len(points), bool))])
    assert len(found) > 1
    assert max(region.size for region in found) < 2.5


def test_where_all_is_well_seen_or_nothing_is_seen_there_is_no_region():
    points = floor()
    every, none = np.ones(len(points), bool), np.zeros(len(points), bool)
    assert find(points, [(center, every) for center in AROUND]) == ()
    assert find(points, [(center, none) for center in AROUND]) == ()


def test_a_region_is_described_by_its_cause():
    one = PoorlySeenRegion(position=(1.0, 2.0, 0.5), size=1.25, share=0.031, few=True, views=1,
                           span_deg=0.0, frame="a.png")
    assert_facts(one.describe("m"), "1.00 2.00 0.50", "1.2 m", "3.1%", "1 view", "a.png")
    narrow = PoorlySeenRegion(**{**vars(one), "few": False, "views": 7, "span_deg": 4.2})
    assert_facts(narrow.describe("m"), "7 views", "4 degrees")
