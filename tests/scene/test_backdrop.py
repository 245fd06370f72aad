"""The backdrop: what every operation keeps, and the sphere that shows it elsewhere."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from facts import raises
from scenes import random_splats

from recon_cli.render import render
from recon_cli.scene.backdrop import SPHERE_GAUSSIANS, Backdrop, enclosing
from recon_cli.scene.camera import Camera, looking_at
from recon_cli.scene.similarity import Similarity
from recon_cli.scene.splats import joined, transformed

BACKDROP = Backdrop(0.2, 0.4, 0.6, 1.0, -2.0, 3.0, 5.0)
HERE = np.array([1.0, -2.0, 3.0])
TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


def scene(n=20):
    return replace(random_splats(n, dtype=torch.float32), backdrop=BACKDROP)


def looking_around(eye, count=12):
    """Wide cameras at a place, in random directions."""
    for direction in np.random.default_rng(0).normal(size=(count, 3)):
        target = eye + direction / np.linalg.norm(direction)
        viewmat = looking_at(eye, target, np.array([0, 0, 1.0]))
        yield Camera(160, 120, 80.0, 80.0, 80.0, 60.0, viewmat)


@pytest.mark.parametrize("aside", [0.0, 2.0, 5.0])
def test_the_sphere_shows_the_colour_to_all_cameras(aside):
    sphere = scene(0).with_sphere()
    for camera in looking_around(HERE + np.array([aside, 0, 0])):
        rgb = render(sphere, camera, torch.zeros(3), 3, backend="numba").rgb.numpy()
        assert np.abs(rgb - BACKDROP.color).max() < 0.006


def test_the_sphere_lies_behind_all_gaussians_and_cameras():
    for farthest in (3.0, 500.0):
        means = np.array([[farthest, 0, 0], [0, 1, 2], [np.nan, 0, 0], [np.inf, 0, 0]])
        positions, scale = BACKDROP.sphere(means)
        radius = np.linalg.norm(positions - HERE, axis=1)
        assert radius == pytest.approx(np.full(SPHERE_GAUSSIANS, radius[0]))
        assert radius[0] > max(BACKDROP.reach, np.linalg.norm(means[0] - HERE))
        assert 0.05 * radius[0] < scale < 0.2 * radius[0]


def test_a_format_of_small_gaussians_gets_more_of_them():
    means = np.array([[5000.0, 0, 0]])
    few, large = BACKDROP.sphere(means)
    many, small = BACKDROP.sphere(means, 379.0)
    assert large > 379 >= small > 300
    assert len(many) > len(few)
    assert len(many) % 256 == 0
    assert small**2 * len(many) == pytest.approx(large**2 * len(few))  # as little gap
    assert len(BACKDROP.sphere(means, 1e-3)[0]) == 1 << 15


@pytest.mark.parametrize("n", [0, 1])
def test_a_scene_of_next_to_nothing_has_a_sphere(n):
    splats = scene(n).with_sphere()
    assert len(splats) == n + SPHERE_GAUSSIANS
    assert all(torch.isfinite(value).all() for value in splats.parameters().values())


def test_a_scene_looks_the_same_with_the_sphere():
    splats = scene(200)
    for camera in looking_around(HERE, 4):
        ours = render(splats, camera, splats.background, 3, backend="numba").rgb
        theirs = render(splats.with_sphere(), camera, torch.zeros(3), 3, backend="numba").rgb
        assert (ours - theirs).abs().max() < 0.006


def test_without_a_backdrop_there_is_no_sphere_and_black_behind():
    splats = random_splats(5)
    assert splats.with_sphere() is splats
    assert splats.background.tolist() == [0, 0, 0]


def test_operations_keep_it():
    splats = scene()
    rows = torch.arange(20) < 7
    black = replace(splats, backdrop=None)
    for result in (splats.map(torch.clone), splats.select(rows), splats.with_degree(1),
                   joined([splats.select(rows), splats.select(~rows)])[0],
                   joined([black, splats])[0], replace(splats, sh_rest=splats.sh_rest[:0])):
        assert result.backdrop is BACKDROP
    assert splats.background.tolist() == pytest.approx(BACKDROP.color)
    assert set(splats.parameters()) == {
        "means", "quats", "log_scales", "logit_opacities", "sh_dc", "sh_rest"}


def test_it_moves_with_the_scene():
    similarity = Similarity(2.0, TURN, np.array([10.0, 0, 0]))
    moved = transformed(scene(), similarity).backdrop
    assert [moved.x, moved.y, moved.z] == pytest.approx(similarity.points(HERE).tolist())
    assert (moved.reach, moved.color) == (10.0, BACKDROP.color)


def test_parts_of_a_scene_get_one_for_all_cameras():
    other = replace(BACKDROP, x=5.0, reach=7.0)
    around = enclosing([BACKDROP, None, other, BACKDROP])
    for part in (BACKDROP, other):
        assert abs(around.x - part.x) + part.reach <= around.reach + 1e-9
    assert enclosing([None, BACKDROP, BACKDROP]) is BACKDROP
    assert enclosing([None]) is None


def test_its_numbers_say_all_and_others_are_refused():
    assert Backdrop.from_numbers(BACKDROP.numbers) == BACKDROP
    for wrong in ([], [1.0] * 6, [1.0] * 8, [*BACKDROP.numbers[:6], float("nan")]):
        with raises(ValueError, "backdrop"):
            Backdrop.from_numbers(wrong)
