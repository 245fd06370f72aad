"""Planes of a room that is known exactly, and what triangulated points make of them."""

from __future__ import annotations

import numpy as np
import pytest

from recon_cli.room.planes import confirm_all, find_planes

SIZE = np.array([5.0, 4.0, 2.5])
BAND = 0.04


def room(rng: np.random.Generator, noise: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of the six sides of a box with normals that point inwards, and areas."""
    points, normals, areas = [], [], []
    for axis in range(3):
        rest = np.delete(np.arange(3), axis)
        count = int(400 * SIZE[rest].prod())
        for side in (0, 1):
            place = rng.uniform(0, SIZE, (count, 3))
            place[:, axis] = side * SIZE[axis] + rng.normal(0, noise, count)
            normal = np.zeros(3)
            normal[axis] = 1 - 2 * side
            bumpy = normal + rng.normal(0, 0.2, (count, 3))
            points.append(place)
            normals.append(bumpy / np.linalg.norm(bumpy, axis=1, keepdims=True))
            areas.append(np.full(count, 1 / 400))
    return np.concatenate(points), np.concatenate(normals), np.concatenate(areas)


@pytest.mark.integration
def test_the_sides_of_a_room_are_found_to_a_fraction_of_their_noise():
    points, normals, areas = room(np.random.default_rng(1), 0.02)
    planes = find_planes(points, normals, areas, BAND)
    assert len(planes) == 6
    for plane in planes:
        axis = int(np.abs(plane.normal).argmax())
        assert abs(plane.normal[axis]) > 0.9999
        truth = 0.0 if plane.normal[axis] > 0 else -SIZE[axis]
        assert plane.offset == pytest.approx(truth, abs=0.004)
        assert plane.area == pytest.approx(np.delete(SIZE, axis).prod(), rel=0.15)
        assert 0.01 < plane.spread < 0.03


def test_a_cloud_without_planes_has_none():
    rng = np.random.default_rng(2)
    directions = rng.normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    cloud = rng.uniform(0, 4, (4000, 3))
    assert find_planes(cloud, directions, np.full(4000, 0.01), BAND) == []
    assert find_planes(np.empty((0, 3)), np.empty((0, 3)), np.empty(0), BAND) == []


@pytest.mark.integration
def test_points_move_a_blurred_wall_to_where_it_is():
    rng = np.random.default_rng(3)
    points, normals, areas = room(rng, 0.01)
    blurred = (points[:, 0] > 4.9) & (normals[:, 0] < -0.5)
    points[blurred, 0] -= 0.03 + rng.normal(0, 0.01, blurred.sum())
    exact, _, _ = room(np.random.default_rng(4), 0.003)
    planes = find_planes(points, normals, areas, BAND)
    confirmed = confirm_all(planes, points, exact[::5], BAND)
    wall = next(i for i, plane in enumerate(planes) if plane.normal[0] < -0.9)
    assert planes[wall].offset == pytest.approx(-4.97, abs=0.01)
    assert confirmed[wall].offset == pytest.approx(-5.0, abs=0.004)


@pytest.mark.integration
def test_without_points_nothing_is_confirmed():
    points, normals, areas = room(np.random.default_rng(5), 0.01)
    planes = find_planes(points, normals, areas, BAND)
    assert confirm_all(planes, points, np.empty((0, 3)), BAND) == [None] * len(planes)
    far = np.random.default_rng(6).uniform(1, 2, (5000, 3))
    assert confirm_all(planes, points, far, BAND) == [None] * len(planes)
