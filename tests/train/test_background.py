"""Far content: found where views see past the points, and only there."""

import numpy as np
import pytest
import torch

from recon_cli.render import render
from recon_cli.scene.backdrop import fibonacci_sphere
from recon_cli.scene.camera import Camera, looking_at
from recon_cli.scene.train_view import TrainView
from recon_cli.train.parts import background
from recon_cli.train.parts.background import (
    faces,
    find_background,
    look_at_one_thing,
    splats_of,
)

SKY = (40, 90, 200)
EXTENT = 1.0


def looking(x, image):
    """A view from (x, 0, 0) along z."""
    viewmat = np.eye(4)
    viewmat[0, 3] = -x
    return TrainView(Camera(160, 120, 100.0, 100.0, 80.0, 60.0, viewmat), image)


def room(window=True):
    """Five views of a wall at z = 3 whose right half is open, and the wall's points."""
    x, y = np.meshgrid(np.linspace(-4, 4, 161), np.linspace(-3, 3, 121))
    wall = np.stack([x, y, np.full_like(x, 3.0)], -1).reshape(-1, 3)
    if window:
        wall = wall[wall[:, 0] < 0]
    views = []
    for at in np.linspace(-0.4, 0.4, 5):
        image = np.full((120, 160, 3), 128, np.uint8)
        edge = int(80 + 100 * (0 - at) / 3)
        if window:
            image[:, edge:] = SKY
        views.append(looking(at, image))
    return views, wall


def test_directions_are_even_on_the_sphere():
    sphere = fibonacci_sphere(2000)
    assert np.allclose(np.linalg.norm(sphere, axis=1), 1)
    assert np.abs(sphere.mean(axis=0)).max() < 2e-3
    nearest = np.sort(sphere @ sphere[1000])[-2]
    assert np.arccos(nearest) == pytest.approx(np.sqrt(4 * np.pi / 2000), rel=0.25)


def test_what_is_seen_through_a_window_lies_far_outside_in_its_colour():
    views, wall = room()
    content = find_background(views, wall, EXTENT)
    assert len(content.positions) > 20
    distance = np.linalg.norm(content.positions, axis=1)
    assert distance.min() > 90 * EXTENT
    ahead = content.positions[content.positions[:, 2] > 90 * EXTENT * np.cos(np.radians(20))]
    # two views see past its edge by less than 4 degrees, and 12 more are filled
    margin = np.arctan2(0.2, 3) + np.radians(12)
    assert (ahead[:, 0] > -100 * EXTENT * np.sin(margin)).all()
    assert np.abs(content.colors - np.array(SKY) / 255).max() < 0.1


def test_it_does_not_depend_on_the_size_of_the_images():
    views, wall = room()
    small = find_background(views, wall, EXTENT)
    large = find_background([TrainView(
        view.camera.resized(640, 480), view.image.repeat(4, axis=0).repeat(4, axis=1))
        for view in views], wall, EXTENT)
    assert large.share == pytest.approx(small.share, abs=0.01)
    assert len(large.positions) == pytest.approx(len(small.positions), rel=0.02)


def test_a_closed_room_has_no_far_content():
    views, wall = room(window=False)
    content = find_background(views, wall, EXTENT)
    assert (len(content.positions), content.share) == (0, 0.0)
    assert not faces(views[0], content, wall)


def test_only_views_that_look_out_face_it():
    views, wall = room()
    content = find_background(views, wall, EXTENT)
    assert faces(views[0], content, wall)
    away = views[0].camera.viewmat.copy()
    away[:3, :3] = np.diag([-1.0, 1.0, -1.0]) @ away[:3, :3]
    camera = Camera(160, 120, 100.0, 100.0, 80.0, 60.0, away)
    assert not faces(TrainView(camera, views[0].image), content, wall)


def test_one_view_alone_cannot_tell():
    views, wall = room()
    assert len(find_background(views[:1], wall, EXTENT).positions) == 0


def test_a_mask_hides_what_lies_far_outside():
    views, wall = room()
    hidden = [TrainView(view.camera, view.image, np.zeros((120, 160), bool)) for view in views]
    assert len(find_background(hidden, wall, EXTENT).positions) == 0


def test_its_gaussians_close_the_window_and_have_no_parallax():
    views, wall = room()
    splats = splats_of(find_background(views, wall, EXTENT), 0)
    pictures = []
    for view in (views[0], views[-1]):
        with torch.no_grad():
            pictures.append(render(splats, view.camera, torch.zeros(3), 0, backend="torch"))
    middle = slice(50, 70), slice(110, 150)
    assert pictures[0].alpha[middle].min() > 0.5
    assert (pictures[0].rgb - pictures[1].rgb)[middle].abs().max() < 0.1


def views_from(centers, targets):
    image = np.zeros((12, 16, 3), np.uint8)
    return [TrainView(Camera(16, 12, 10.0, 10.0, 8.0, 6.0, looking_at(
        np.asarray(center, float), np.asarray(target, float), np.array([0.0, 0, 1]))), image)
        for center, target in zip(centers, targets, strict=True)]


RING = [(3 * np.cos(angle), 3 * np.sin(angle), 1.5) for angle in np.linspace(0, 5, 20)]
ACROSS = [(3.0, y, 1.5) for y in np.linspace(-1.5, 1.5, 20)]
AHEAD = [(x, 0.02 * x, 1.5) for x in np.linspace(0, 5, 20)]


@pytest.mark.parametrize(("centers", "targets", "one_thing"), [
    (RING, [(0, 0, 1)] * 20, True),
    (ACROSS, [(0, 0, 1)] * 20, True),  # from one side
    (RING, [(2 * x, 2 * y, z) for x, y, z in RING], False),  # outwards, from one point
    (RING, [(-x, y, z) for x, y, z in RING], False),  # across a room
    (AHEAD, [(x + 10, y, 1.4) for x, y, _ in AHEAD], False),  # down a corridor
    (RING[:1] * 20, [(np.cos(a), np.sin(a), 1) for a in np.linspace(0, 6, 20)], False),
], ids=["around", "before", "outwards", "across", "ahead", "turning"])
def test_views_that_look_at_one_thing_are_told_from_others(centers, targets, one_thing):
    assert look_at_one_thing(views_from(centers, targets)) == one_thing


def framed(behind=False):
    """Nine views of a wall at z = 3 with points around a blank middle, and points of a far wall."""
    x, y = np.meshgrid(np.linspace(-4, 4, 81), np.linspace(-3, 3, 61))
    wall = np.stack([x, y, np.full_like(x, 3.0)], -1).reshape(-1, 3)
    points = wall[(np.abs(wall[:, 0]) > 1) | (np.abs(wall[:, 1]) > 0.8)]
    if behind:
        x, y = np.meshgrid(np.linspace(-3, 3, 6), np.linspace(-2, 2, 4))
        points = np.concatenate(
            [points, np.stack([x, y, np.full_like(x, 8.0)], -1).reshape(-1, 3)])
    views = []
    for at in np.linspace(-0.4, 0.4, 9):
        image = np.full((120, 160, 3), 128, np.uint8)
        image[35:85, int(80 + 100 * (-1 - at) / 3):int(80 + 100 * (1 - at) / 3)] = SKY
        views.append(looking(at, image))
    return views, points


def test_a_blank_part_of_a_wall_gets_points_at_the_depth_around_it_in_its_colour():
    views, points = framed()
    content = find_background(views, points, EXTENT)
    gaps, colors = content.gap_points, content.gap_colors
    assert np.allclose(gaps[:, 2], 3, atol=1e-9)
    assert (np.abs(gaps[:, 0]) < 1.1).all()
    assert (np.abs(gaps[:, 1]) < 0.9).all()
    inner = (np.abs(gaps[:, 0]) < 0.8) & (np.abs(gaps[:, 1]) < 0.6)
    # one a cell of .06 x 3: 8 x 6 cells of the inner part, or more
    assert inner.sum() >= 40
    assert np.abs(colors[inner].astype(int) - SKY).max() <= 1


def test_a_gap_is_dropped_where_views_show_points_beyond(monkeypatch):
    views, points = framed(behind=True)
    kept = find_background(views, points, EXTENT).gap_points
    monkeypatch.setattr(background, "_THROUGH_SHARE", 1.0)
    found = find_background(views, points, EXTENT).gap_points
    shown = np.zeros(len(found))
    for view in views:
        camera = view.camera.resized(150, 112)
        near, beyond = (np.stack(camera.find_visible(some)[1:3], 1)
                        for some in (found, points[points[:, 2] > 4]))
        apart = np.linalg.norm(near[:, None] - beyond, axis=-1).min(1)
        shown += (apart <= 2) & (found[:, 2] < 4)
    open_ones = shown > 0.2 * len(views)
    assert 5 < open_ones.sum() < len(found)
    assert {tuple(place) for place in kept} == {tuple(place) for place in found[~open_ones]}


def test_gaps_need_two_views_points_around_and_views_of_more_than_one_thing():
    views, points = framed()
    assert len(find_background(views[:1], points, EXTENT).gap_points) == 0
    assert len(find_background(views, points[:5], EXTENT).gap_points) == 0
    around = [TrainView(Camera(160, 120, 100.0, 100.0, 80.0, 60.0, looking_at(
        np.array([np.sin(angle), 0, 3 - 3 * np.cos(angle)]), np.array([0.0, 0, 3]),
        np.array([0.0, -1, 0]))), views[0].image) for angle in np.linspace(-0.6, 0.6, 5)]
    assert look_at_one_thing(around)
    assert len(find_background(around, points, EXTENT).gap_points) == 0


def test_a_mask_hides_gaps():
    views, points = framed()
    hidden = [TrainView(view.camera, view.image, np.zeros((120, 160), bool)) for view in views]
    assert len(find_background(hidden, points, EXTENT).gap_points) == 0
