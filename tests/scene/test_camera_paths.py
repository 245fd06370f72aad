"""The smooth path in closed form: circles, lines, turns in place, hands that shake."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull, Delaunay
from scipy.spatial.transform import Rotation

from recon_cli.scene.camera import looking_at
from recon_cli.scene.camera_paths import keyframe_path, orbit_path, smooth_path

pytestmark = pytest.mark.floors

UP, AHEAD = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])


def centers(viewmats):
    return -np.einsum("cji,cj->ci", viewmats[:, :3, :3], viewmats[:, :3, 3])


def turns(viewmats):
    """Returns the angles in degrees from each camera to the next."""
    rotations = Rotation.from_matrix(viewmats[:, :3, :3])
    return np.degrees((rotations[:-1].inv() * rotations[1:]).magnitude())


def placed(places, rotations):
    """Returns cameras at `places` [C, 3] whose axes are those of `rotations`, camera to world."""
    viewmats = np.tile(np.eye(4), (len(places), 1, 1))
    viewmats[:, :3, :3] = rotations.as_matrix().transpose(0, 2, 1)
    viewmats[:, :3, 3] = -np.einsum("cij,cj->ci", viewmats[:, :3, :3], places)
    return viewmats


def circle(count, radius=2.0):
    start = np.array([[radius, 0.0, 1.5]])
    return orbit_path(start, np.array([0.0, 0.0, 1.0]), UP, count)


@pytest.mark.parametrize("count", [24, 96, 300])
def test_a_path_through_a_circle_stays_on_it_and_looks_at_its_middle(count):
    found = smooth_path(circle(count), 200)
    places = centers(found)
    radii = np.linalg.norm(places[:, :2], axis=1)
    # a filter of variance s^2 takes 1 - exp(-s^2 / 2) off a circle, the spline that of a third
    step = 2 * np.pi / count
    shrink = step**2 * (min(count / 40, 3.0) ** 2 + 1 / 3) / 2
    assert radii.max() <= 2.0 + 1e-9
    inner = radii[10:-10]  # the filter has but one side at the ends
    assert inner.min() >= 2.0 * (1 - 1.2 * shrink)
    assert shrink < 0.03
    np.testing.assert_allclose(places[:, 2], 1.5, atol=1e-9)
    sight = np.array([0.0, 0.0, 1.0]) - places
    along = np.einsum("ci,ci->c", found[:, 2, :3], sight) / np.linalg.norm(sight, axis=1)
    assert np.degrees(np.arccos(along[10:-10].clip(-1, 1))).max() < 1.0


def test_a_path_through_a_circle_has_constant_speed():
    found = smooth_path(circle(96), 200)
    steps = np.linalg.norm(np.diff(centers(found), axis=0), axis=1)
    assert steps.max() / steps.min() < 1.03  # at the ends the views turn a little slower
    np.testing.assert_allclose(steps[10:-10], steps[100], rtol=2e-3)


def test_speed_is_constant_where_the_cameras_are_spread_unevenly():
    places = np.zeros((40, 3))
    places[:, 0] = np.linspace(0, 1, 40) ** 2 * 10
    found = smooth_path(placed(places, Rotation.identity(40)), 101)
    steps = np.linalg.norm(np.diff(centers(found), axis=0), axis=1)
    np.testing.assert_allclose(steps, steps.mean(), rtol=1e-3)
    np.testing.assert_allclose(found[:, :3, :3], np.tile(np.eye(3), (101, 1, 1)), atol=1e-12)


def test_every_camera_is_a_rotation_and_no_step_is_a_jump():
    rng = np.random.default_rng(0)
    walk = placed(rng.normal(size=(60, 3)).cumsum(axis=0) / 5,
                  Rotation.from_rotvec(rng.normal(size=(60, 3)).cumsum(axis=0) / 3))
    found = smooth_path(walk, 400)
    products = found[:, :3, :3] @ found[:, :3, :3].transpose(0, 2, 1)
    np.testing.assert_allclose(products, np.tile(np.eye(3), (400, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(found[:, :3, :3]), 1, atol=1e-12)
    # the view turns at most twice as fast as on average, and the walk is longer for it
    assert turns(found).max() < 2 * 1.6 * turns(found).mean()


def test_shake_is_smoothed_away():
    rng = np.random.default_rng(1)
    places = np.zeros((100, 3))
    places[:, 0] = np.linspace(0, 10, 100)
    shaken = places + rng.normal(scale=0.05, size=(100, 3))
    hand = Rotation.from_rotvec(rng.normal(scale=np.radians(3), size=(100, 3)))
    found = smooth_path(placed(shaken, hand), 300)
    off = centers(found)[:, 1:]
    assert np.sqrt((off**2).mean()) < 0.5 * 0.05
    roll = Rotation.from_matrix(found[:, :3, :3]).magnitude()
    assert np.degrees(np.sqrt((roll**2).mean())) < 0.5 * 3 * np.sqrt(3)


def test_the_path_never_leaves_the_hull_of_the_cameras():
    rng = np.random.default_rng(2)
    places = rng.uniform(-1, 1, (30, 3))  # photos in no order
    found = centers(smooth_path(placed(places, Rotation.random(30, rng=3)), 500))
    hull = Delaunay(places[ConvexHull(places).vertices])
    middle = places.mean(axis=0)
    assert (hull.find_simplex(middle + (found - middle) * (1 - 1e-9)) >= 0).all()


def test_a_turn_in_place_goes_at_constant_angular_speed():
    angles = np.linspace(0, np.pi, 30) ** 1.5
    spin = placed(np.tile([1.0, 2.0, 3.0], (30, 1)), Rotation.from_euler("y", angles[:, None]))
    found = smooth_path(spin, 90)
    np.testing.assert_allclose(centers(found), np.tile([1.0, 2, 3], (90, 1)), atol=1e-9)
    np.testing.assert_allclose(turns(found), turns(found).mean(), rtol=1e-2)


def test_the_walk_slows_down_where_the_view_swings_round():
    places = np.zeros((41, 3))
    places[:, 0] = np.linspace(0, 4, 41)
    swing = np.where(np.arange(41) < 20, 0, np.pi / 2)  # a quarter turn from one camera to the next
    found = smooth_path(placed(places, Rotation.from_euler("y", swing[:, None])), 201)
    steps = np.linalg.norm(np.diff(centers(found), axis=0), axis=1)
    calm = np.concatenate([steps[:50], steps[-50:]])
    np.testing.assert_allclose(calm, calm.mean(), rtol=1e-3)
    assert steps.min() < 0.5 * calm.mean()
    assert turns(found).max() < 2 * 1.6 * turns(found).mean()


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_few_cameras_make_a_path_too(count):
    places = np.zeros((count, 3))
    places[:, 0] = np.arange(count)
    viewmats = np.stack([looking_at(place, place + AHEAD, UP) for place in places])
    found = smooth_path(viewmats, 5)
    assert np.isfinite(found).all()
    assert (np.diff(centers(found)[:, 0]) >= 0).all()
    np.testing.assert_allclose(centers(found)[:, 1:], 0, atol=1e-12)


def test_the_same_camera_twice_stays_where_it_is():
    one = looking_at(np.array([1.0, 2.0, 3.0]), np.zeros(3), UP)
    np.testing.assert_allclose(smooth_path(np.stack([one] * 6), 4), np.stack([one] * 4), atol=1e-9)


def test_one_frame_is_the_start_of_the_path():
    found = smooth_path(circle(24), 1)
    assert found.shape == (1, 4, 4)
    assert np.linalg.norm(centers(found)[0] - centers(circle(24))[0]) < 0.3


def test_a_path_through_keyframes_passes_each_and_keeps_its_speed():
    places = np.array([[0.0, 0, 0], [4, 0, 0], [4, 1, 0], [0, 1, 1]])
    rotations = Rotation.from_rotvec(np.radians([0, 60, 90, 200])[:, None] * UP)
    keys, fovs = placed(places, rotations), np.array([50.0, 60.0, 40.0, 50.0])
    path, wide = keyframe_path(keys, fovs, 2001)
    found = centers(path)
    for place, fov, key in zip(places, fovs, keys, strict=True):
        at = int(np.linalg.norm(found - place, axis=1).argmin())
        np.testing.assert_allclose(found[at], place, atol=5e-3)
        assert wide[at] == pytest.approx(fov, abs=0.1)
        assert turns(np.stack([path[at], key]))[0] < 0.3
    steps = np.linalg.norm(np.diff(found, axis=0), axis=1)
    assert steps.max() < 1.05 * np.median(steps)
    bends = np.linalg.norm(np.diff(found, 2, axis=0), axis=1)  # no corner anywhere
    assert bends.max() < 0.05 * np.median(steps)
    assert found.max() < 4.5  # and no wide swing beyond the keyframes
    np.testing.assert_allclose(path[[0, -1]], keys[[0, -1]], atol=1e-9)


def test_two_keyframes_that_differ_by_a_turn_alone_make_a_path():
    keys = placed(np.zeros((2, 3)), Rotation.from_rotvec(np.radians([0, 90])[:, None] * UP))
    path, _ = keyframe_path(keys, np.array([50.0, 50.0]), 91)
    np.testing.assert_allclose(turns(path), 1.0, atol=0.02)
