"""Shares of the surface: by area and not by the number of Gaussians."""

import numpy as np
import pytest
import torch
from small_room import dots, room

from recon_cli.trust.support import ViewSupport
from recon_cli.trust.surface import find_cells, surface_rows, surface_shares


def support_of(n, seen):
    """`seen` are by view the centre and the Gaussians that it shows."""
    return ViewSupport.from_rows([torch.as_tensor(rows) for _, rows in seen],
                      np.array([center for center, _ in seen], float), torch.zeros(n))


def shares_of(splats, seen):
    return surface_shares(find_cells(splats, support_of(len(splats), seen)))


def test_shares_are_of_area():
    floor = np.stack(np.meshgrid(np.arange(20.0), np.arange(10.0), [0.0]), -1).reshape(-1, 3)
    left = np.flatnonzero(floor[:, 0] < 10)
    crowd = np.repeat(floor[left[:1]], 90, axis=0)  # in one place
    splats = dots(np.concatenate([floor, crowd]))
    every = np.arange(len(splats))
    right = np.setdiff1d(np.arange(len(floor)), left)
    shares = shares_of(splats, [
        ([0, 0, 5], every), ([20, 0, 5], right), ([20, 10, 5], right)])
    assert shares.well == pytest.approx(0.5, abs=0.01)
    assert shares.few == pytest.approx(0.5, abs=0.01)
    assert shares.well + shares.narrow + shares.few == pytest.approx(1, abs=1e-3)


def test_views_from_one_direction_do_not_make_a_surface_well_seen():
    splats = dots(room())
    every = np.arange(len(splats))
    shares = shares_of(splats, [([0, 0, 30 + i / 10], every) for i in range(6)])
    assert shares.narrow == pytest.approx(1)


def test_what_lies_beyond_a_window_or_was_never_seen_is_no_surface():
    inside = room()
    outside = np.array([[50.0 + i, 0, 0] for i in range(len(inside) // 4)])
    splats = dots(np.concatenate([inside, outside]))
    seen = np.arange(1, len(splats))
    rows = surface_rows(splats, support_of(len(splats), [([0, 0, 1], seen)])).tolist()
    assert rows == list(range(1, len(inside)))


def test_a_scene_that_no_view_shows_has_no_surface():
    splats = dots(room())
    shares = shares_of(splats, [([0, 0, 1], np.arange(0))])
    assert (shares.cells, shares.well) == (0, 0)
