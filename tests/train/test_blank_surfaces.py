"""A wall with a blank square in it, painted pixel by pixel, and what is made of the square."""

from dataclasses import replace

import numpy as np
import pytest

from recon_cli.scene.camera import Camera, looking_at
from recon_cli.scene.train_view import TrainView
from recon_cli.train.blank_regions import find_regions, look_at
from recon_cli.train.blank_surfaces import BlankSurfaces, SparseModel, find_surfaces

UP = np.array([0.0, 0.0, 1.0])
HALF = 1.0  # of the blank square's side, metres
GRAY = 130
UPRIGHT = np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
LEVEL = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])


def wall_view(center, plane, *, offset=0.0):
    """Returns a view of the plane n x = offset: gray within the square, noise around it."""
    normal, across, along = plane
    viewmat = looking_at(center, offset * normal, along if abs(normal @ UP) > 0.9 else UP)
    camera = Camera(320, 240, 300.0, 300.0, 160.0, 120.0, viewmat)
    v, u = np.mgrid[0:240, 0:320] + 0.5
    rays = np.stack([(u - 160) / 300, (v - 120) / 300, np.ones_like(u)], -1) @ viewmat[:3, :3]
    depth = (offset - center @ normal) / (rays @ normal)
    places = center + rays * depth[..., None]
    a, b = places @ across, places @ along
    noise = np.random.default_rng(0).integers(0, 256, (200, 200, 3))
    image = noise[(np.floor(a / 0.05).astype(int) % 200), (np.floor(b / 0.05).astype(int) % 200)]
    image[(np.abs(a) < HALF) & (np.abs(b) < HALF)] = GRAY
    return TrainView(camera, image.astype(np.uint8))


def frame_points(plane, *, offset=0.0, sides=(0, 1, 2, 3)):
    """Returns points on the wall in a frame of 20 cm around the square."""
    normal, across, along = plane
    rng, points = np.random.default_rng(1), []
    for side in sides:
        out, by = rng.uniform(HALF + 0.02, HALF + 0.15, 30), rng.uniform(-HALF, HALF, 30)
        a, b = [(out, by), (-out, by), (by, out), (by, -out)][side]
        points.append(a[:, None] * across + b[:, None] * along + offset * normal)
    return np.concatenate(points)


def centers(plane, count=4):
    normal, across, along = plane
    return [3.0 * normal + shift * across + 0.3 * along
            for shift in np.linspace(-1.0, 1.0, count)]


def found(points, *, plane=UPRIGHT, count=4, up=UP, offset=0.0):
    views = [wall_view(center, plane, offset=offset) for center in centers(plane, count)]
    rows = np.arange(len(points))
    return find_surfaces(views, [rows] * count, points, up)


@pytest.mark.parametrize("plane", [UPRIGHT, LEVEL], ids=["wall", "floor"])
@pytest.mark.parametrize("offset", [0.0, -0.7])
def test_points_fill_the_blank_square_in_its_plane_and_colour(plane, offset):
    normal, across, along = plane
    surface = found(frame_points(plane, offset=offset), plane=plane, offset=offset)
    assert np.abs(surface.points @ normal - offset).max() < 1e-6
    a, b = surface.points @ across, surface.points @ along
    side = (3.0 - offset) / 25
    assert max(np.abs(a).max(), np.abs(b).max()) < HALF + side
    assert len(surface.points) > 0.7 * (2 * HALF / side) ** 2
    # smoothing for the reduced picture mixes a little of the noise into the rim
    assert (np.abs(surface.colors.astype(int) - GRAY).max(axis=1) <= 3).mean() > 0.98


def test_points_of_the_wall_itself_are_measured_with_noise():
    points = frame_points(UPRIGHT)
    noisy = points + np.random.default_rng(2).normal(0, 0.01, points.shape)
    surface = found(noisy)
    assert len(surface.points) > 100
    assert np.abs(surface.points @ UPRIGHT[0]).max() < 0.01


def test_what_stands_before_the_wall_does_not_move_it():
    nearer = frame_points(UPRIGHT, sides=(0, 1)) + 0.8 * UPRIGHT[0]
    surface = found(np.concatenate([frame_points(UPRIGHT), nearer]))
    assert len(surface.points) > 100
    assert np.abs(surface.points @ UPRIGHT[0]).max() < 1e-6


def test_nothing_is_put_into_a_window():
    rng = np.random.default_rng(3)
    outside = rng.uniform([-1, -6, -1], [1, -1, 1], (300, 3))
    assert len(found(np.concatenate([frame_points(UPRIGHT), outside])).points) == 0


def test_points_along_one_edge_say_nothing_of_the_plane():
    assert len(found(frame_points(UPRIGHT, sides=(3,))).points) == 0


def test_two_views_are_too_few():
    assert len(found(frame_points(UPRIGHT), count=2).points) == 0
    assert len(found(frame_points(UPRIGHT), count=3).points) > 100


def test_a_tilted_plane_is_left_alone():
    tilted = np.array([0.0, np.sqrt(0.5), np.sqrt(0.5)])
    plane = tilted, np.array([1.0, 0.0, 0.0]), np.cross(tilted, [1.0, 0.0, 0.0])
    assert len(found(frame_points(plane), plane=plane).points) == 0


def test_the_same_bytes_come_out_every_time():
    first, second = found(frame_points(UPRIGHT)), found(frame_points(UPRIGHT))
    assert first.points.tobytes() == second.points.tobytes()
    assert first.colors.tobytes() == second.colors.tobytes()


def test_what_a_mask_hides_is_no_region():
    view = wall_view(centers(UPRIGHT)[0], UPRIGHT)
    points = frame_points(UPRIGHT)
    (picture, regions), = look_at([view], [np.arange(len(points))], points)
    assert len(regions) == 1
    assert len(regions[0].lines) > 1000
    hidden = np.ones((240, 320), bool)
    hidden[:, 40:280] = False
    assert find_regions(picture, hidden) == []
    (_, regions), = look_at([replace(view, mask=hidden)], [np.arange(len(points))], points)
    assert regions == []


@pytest.mark.parametrize(("up", "points"), [
    (None, frame_points(UPRIGHT)), (UP, np.empty((0, 3)))], ids=["no up", "no points"])
def test_without_up_or_points_there_are_none(up, points):
    views = [wall_view(center, UPRIGHT) for center in centers(UPRIGHT)]
    rows = [np.arange(len(points))] * len(views)
    blank = BlankSurfaces(views, lambda: SparseModel(points, rows, up))
    assert blank.found.points.shape == (0, 3)
    assert blank.found.colors.dtype == np.uint8


def test_points_that_came_without_tracks_are_no_evidence():
    views = [wall_view(center, UPRIGHT) for center in centers(UPRIGHT)]
    nothing = [np.empty(0, np.int64)] * len(views)
    blank = BlankSurfaces(views, lambda: SparseModel(frame_points(UPRIGHT), nothing, UP))
    assert len(blank.found.points) == 0
