"""The circle around a scene in closed form, and what cameras look at."""

import numpy as np
import pytest

from recon_cli.scene.camera import Camera, looking_at
from recon_cli.scene.camera_paths import find_look_at, orbit_path

UPS = [np.array([0.0, 0, 1]), np.array([0.0, -1, 0]), np.array([2.0, -1, 2]) / 3]


def places(viewmats):
    return -np.einsum("cji,cj->ci", viewmats[:, :3, :3], viewmats[:, :3, 3])


def camera(viewmat):
    return Camera(64, 48, 50.0, 50.0, 32.0, 24.0, viewmat)


@pytest.mark.parametrize("up", UPS)
def test_every_camera_looks_at_the_middle_and_up_is_up(up):
    rng = np.random.default_rng(0)
    target, centers = rng.normal(size=3), rng.normal(size=(9, 3)) * 3
    found = orbit_path(centers, target, up, 50)
    seen = found[:, :3, :3] @ target + found[:, :3, 3]
    np.testing.assert_allclose(seen[:, :2], 0, atol=1e-12)
    assert (seen[:, 2] > 0).all()
    np.testing.assert_allclose(found[:, 0, :3] @ up, 0, atol=1e-12)  # the horizon is level
    assert (found[:, 1, :3] @ up < 0).all()  # the y axis of a camera points down
    np.testing.assert_allclose(np.linalg.det(found[:, :3, :3]), 1)


@pytest.mark.parametrize("up", UPS)
def test_the_circle_has_the_median_distance_and_height_and_even_steps(up):
    rng = np.random.default_rng(1)
    target, centers = rng.normal(size=3), rng.normal(size=(9, 3)) * 3
    found = places(orbit_path(centers, target, up, 36)) - target
    offsets = centers - target
    np.testing.assert_allclose(found @ up, np.median(offsets @ up), atol=1e-12)
    flat = offsets - np.outer(offsets @ up, up)
    circle = found - np.outer(found @ up, up)
    np.testing.assert_allclose(
        np.linalg.norm(circle, axis=1), np.median(np.linalg.norm(flat, axis=1)))
    closed = np.concatenate([found, found[:1]])
    steps = np.linalg.norm(np.diff(closed, axis=0), axis=1)
    np.testing.assert_allclose(steps, steps[0])
    assert np.cross(circle[0], circle[1]) @ up > 0  # anticlockwise from above
    assert circle[0] @ flat[0] == pytest.approx(
        np.linalg.norm(circle[0]) * np.linalg.norm(flat[0]))


def test_cameras_that_all_stand_above_the_middle_still_make_a_circle():
    found = orbit_path(np.array([[0.0, 0, 2]] * 3), np.zeros(3), UPS[0], 8)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(np.linalg.norm(places(found)[:, :2], axis=1), 0.1)


def test_cameras_in_the_middle_itself_give_finite_views():
    assert np.isfinite(orbit_path(np.zeros((3, 3)), np.zeros(3), UPS[0], 8)).all()


def test_the_middle_of_sight_of_cameras_around_an_object_is_the_object():
    rng = np.random.default_rng(2)
    points = np.array([1.0, 2, 3]) + rng.normal(scale=0.05, size=(500, 3))
    eyes = np.array([1.0, 2, 3]) + 4 * rng.normal(size=(20, 3))
    cameras = [camera(looking_at(eye, np.array([1.0, 2, 3]), UPS[0])) for eye in eyes]
    np.testing.assert_allclose(find_look_at(cameras, points), [1, 2, 3], atol=0.05)


def test_the_middle_of_sight_of_cameras_that_look_out_is_the_middle_of_the_room():
    rng = np.random.default_rng(3)
    directions = rng.normal(size=(20_000, 3))
    walls = directions / np.abs(directions[:, :2]).max(axis=1, keepdims=True) * 3
    walls = walls[np.abs(walls[:, 2]) < 2] + [10.0, 0, 0]  # a square room around (10, 0, 0)
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    cameras = [
        camera(looking_at(np.array([10.5, 0.2, 0]),
                          np.array([10.5 + np.cos(a), 0.2 + np.sin(a), 0]), UPS[0]))
        for a in angles]
    np.testing.assert_allclose(find_look_at(cameras, walls), [10, 0, 0], atol=0.6)


def test_without_points_in_sight_the_middle_is_that_of_the_points():
    points = np.array([[0.0, 0, -5], [0, 1, -6], [1, 0, -7]])
    np.testing.assert_array_equal(
        find_look_at([camera(np.eye(4))], points), [0, 0, -6])
