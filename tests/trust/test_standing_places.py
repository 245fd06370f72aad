"""Standing places in rooms of known plan."""

import numpy as np
import pytest
import torch
from small_room import EYE, UP, dots, room

from recon_cli.trust.standing_places import find_places
from recon_cli.trust.support import Support

CAMERAS = np.array([[x, y, EYE] for x in (-0.5, 0, 0.5) for y in (-0.5, 0, 0.5)])


def box(low, high, step=0.15):
    """Returns points on the sides of a box."""
    axes = [np.arange(a, b + 1e-9, step) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes), -1).reshape(-1, 3)
    return points[((points == np.array(low)) | (points >= np.array(high) - step)).any(axis=1)]


def places(points, *, cameras=CAMERAS, floor=0.0, most=40, seen=None):
    splats = dots(points)
    rows = torch.arange(len(splats)) if seen is None else torch.from_numpy(seen)
    support = Support.of([rows] * len(cameras), cameras, torch.zeros(len(splats)))
    return find_places(splats, support, UP, floor, cameras, most=most)


def test_places_are_over_the_floor_at_the_height_of_the_cameras_and_off_the_walls():
    found = places(room(step=0.15))
    assert len(found.eyes) == 40
    assert found.eye == pytest.approx(EYE)
    np.testing.assert_allclose(found.eyes[:, 2], EYE)
    assert (np.abs(found.eyes[:, :2]) < 2 - 0.3).all()
    assert np.abs(found.eyes[:, :2]).max() > 1  # and not only where cameras are


def test_nobody_stands_in_a_cupboard():
    cupboard = box([0.9, -0.6, 0], [1.5, 0.6, 1.9])
    found = places(np.concatenate([room(step=0.15), cupboard]))
    x, y = found.eyes[:, 0], found.eyes[:, 1]
    assert not ((x > 0.8) & (x < 1.6) & (np.abs(y) < 0.7)).any()


def test_what_lies_beyond_a_window_is_no_place():
    walls = room(step=0.15)
    window = (walls[:, 0] > 1.9) & (np.abs(walls[:, 1]) < 0.8) & (walls[:, 2] > 0.9)
    street = np.array([[6.0, y, z] for y in np.arange(-3, 3, 0.2) for z in np.arange(0, 3, 0.2)])
    found = places(np.concatenate([walls[~window], street]))
    assert len(found.eyes)
    assert (found.eyes[:, 0] < 2).all()


def test_before_a_single_wall_places_lie_between_it_and_the_cameras():
    wall = np.array([[2.0, y, z] for y in np.arange(-2, 2, 0.1) for z in np.arange(0, 2.4, 0.1)])
    cameras = np.array([[-0.5, y, EYE] for y in (-1.0, 0.0, 1.0)])
    found = places(wall, cameras=cameras, floor=None)
    assert len(found.eyes)
    assert (found.eyes[:, 0] < 1.9).all()
    assert found.floor == pytest.approx(0.0, abs=0.1)  # the lowest surface


def test_without_any_surface_the_cameras_places_remain():
    found = places(room(), seen=np.arange(0))
    assert len(found.eyes) <= len(CAMERAS)
    for eye in found.eyes:
        assert np.linalg.norm(CAMERAS - eye, axis=1).min() < 0.5
