"""Depth in whole steps and its colours, in closed form."""

import numpy as np
import pytest
import torch
from prepared_workspace import wall

from recon_cli.flythrough.output import DepthScale, depth_colors, depth_scale, depth_steps
from recon_cli.render import render
from recon_cli.scene.camera import Camera
from recon_cli.scene.scene import Scene, View
from recon_cli.scene.splats import joined

SCALE = DepthScale(True, 1e-3, 1.0, 3.0, (0.0, 0.0, 0.0), 50.0)


def steps(depth, alpha, step=1e-3):
    return int(depth_steps(np.array([[depth]], np.float32), np.array([[alpha]], np.float32),
                           step)[0, 0])


@pytest.mark.parametrize(("depth", "alpha", "expected"), [
    (2.0, 1.0, 2000),
    (1.5, 0.75, 2000),  # the sum of alpha T z over what is covered
    (0.98, 0.49, 0),  # more light passes than is stopped
    (0.0, 0.0, 0),
    (1e-5, 1.0, 1),  # there, so not 0
    (70.0, 1.0, 65_535),
])
def test_depth_is_the_mean_of_what_is_there_in_whole_steps(depth, alpha, expected):
    assert steps(depth, alpha) == expected


@pytest.mark.parametrize("backend", ["torch", "numba"])
def test_a_plane_of_gaussians_has_the_depth_that_it_has(backend):
    camera = Camera(40, 30, 40.0, 40.0, 20.0, 15.0, np.eye(4))
    shown = render(wall(3.217, spacing=0.1, half=3.0), camera, torch.zeros(3), 0, backend=backend)
    found = depth_steps(shown.depth.numpy(), shown.alpha.numpy(), 1e-3)
    assert (found == 3217).all()


def test_what_lies_outside_the_windows_moves_no_depth():
    camera = Camera(40, 30, 40.0, 40.0, 20.0, 15.0, np.eye(4))
    near, far = wall(3.217, spacing=0.1, half=3.0), wall(300.0, spacing=10.0, half=300.0)
    near.logit_opacities -= 7.0  # some light shines through
    both = joined([near, far])[0]
    kept = SCALE.select_surfaces(both)
    assert len(kept) == len(near)
    assert SCALE.select_surfaces(near) is near
    shown = render(both, camera, torch.zeros(3), 0, backend="torch")
    surfaces = render(kept, camera, torch.zeros(3), 0, backend="torch")
    assert (depth_steps(surfaces.depth.numpy(), surfaces.alpha.numpy(), 1e-3) == 3217).all()
    assert (depth_steps(shown.depth.numpy(), shown.alpha.numpy(), 1e-3) > 3300).any()


def test_colours_go_from_red_to_blue_and_nothing_is_black():
    red, middle, blue, nearer, nothing = depth_colors(
        np.array([[1000, 2000, 3000, 500, 0]], np.uint16), SCALE)[0].astype(int)
    assert red[0] > 100 > red[1:].max()
    assert middle[1] > middle[[0, 2]].max()
    assert blue[2] > 100 > blue[:2].max()
    np.testing.assert_array_equal(nearer, red)
    np.testing.assert_array_equal(nothing, 0)


def scene(points):
    def view(number, place):
        viewmat = np.eye(4)
        viewmat[:3, 3] = -np.array(place)
        camera = Camera(40, 30, 40.0, 40.0, 20.0, 15.0, viewmat)
        return View(f"{number}.png", camera, None, None)

    views = (view(0, [0.0, 0, 0]), view(1, [4.0, 0, 0]))
    return Scene(views, (), (), (), points, np.zeros(points.shape, np.uint8))


def test_a_step_is_a_millimetre_in_metres_and_else_a_thousandth_of_the_extent():
    there = scene(np.array([[0.0, 0, 2], [4, 0, 6]]))
    assert there.extent == pytest.approx(2.2)
    known, unknown = depth_scale(there, metres=True), depth_scale(there, metres=False)
    assert (known.step, unknown.step) == (1e-3, pytest.approx(2.2e-3))
    assert known.to_json()["unit"] == "millimetre"
    assert unknown.to_json()["unit"] == "thousandth of the scene's extent"
    assert unknown.to_json()["world_units_per_step"] == unknown.step
    assert 1 <= known.near < 2 < known.far <= 6


def test_a_scene_without_points_in_sight_has_colours_too():
    nowhere = depth_scale(scene(np.array([[0.0, 0, -2]])), metres=True)
    assert 0 <= nowhere.near < nowhere.far
