"""Which cameras are asked for: parts of the views, sizes, and who plays no part."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from recon_cli.errors import ConfigError
from recon_cli.flythrough.plan import plan
from recon_cli.flythrough.request import Request
from recon_cli.flythrough.smooth import looking_at
from recon_cli.flythrough.source import Source
from recon_cli.scene.camera import Camera
from recon_cli.scene.scene import Scene, View

UP = np.array([0.0, 0.0, 1.0])
SHORT = {"fps": 10.0, "seconds": 1.0}


def view(number, *, width=600, height=400, focal=300.0, name=None):
    """A view on a circle of radius 3 that looks at the origin from a height of 1."""
    angle = 2 * np.pi * number / 40
    eye = np.array([3 * np.cos(angle), 3 * np.sin(angle), 1.0])
    camera = Camera(width, height, focal, focal, 310.0, 190.0, looking_at(eye, np.zeros(3), UP))
    file = Path(name or f"{number:03d}.png")
    return View(file.name, camera, file, file)


def source(*more, z_up=True, max_size=300):
    points = np.random.default_rng(0).normal(scale=0.05, size=(200, 3))
    views = [view(number) for number in range(40)]
    scene = Scene(
        (*views[1::2], *more), (views[2],), tuple(views[0::8]), ("099.png",), points,
        np.zeros((200, 3), np.uint8))
    return Source("base", None, "", 0, max_size, scene, z_up, True)


def viewmats(found):
    return np.stack([camera.viewmat for camera in found.cameras.values()])


@pytest.mark.parametrize("path", ["training", "orbit"])
def test_held_out_and_validation_views_play_no_part_in_a_path(path):
    request, whole = Request(path, **SHORT), source()
    alone = replace(whole, scene=replace(whole.scene, test=(), validation=()))
    np.testing.assert_array_equal(
        viewmats(plan(request, whole)), viewmats(plan(request, alone)))


def test_frames_see_as_the_training_images_do_at_their_size():
    found = plan(Request(**SHORT), source())
    first = next(iter(found.cameras.values()))
    assert len(found.cameras) == 10
    assert (first.width, first.height) == (300, 200)
    assert first.fx == first.fy == pytest.approx(150)
    assert (first.cx, first.cy) == (150, 100)


def test_of_several_cameras_the_usual_one_gives_shape_and_field_of_view():
    others = [view(number, width=400, height=600, focal=700.0) for number in range(0, 40, 8)]
    first = next(iter(plan(Request(**SHORT), source(*others)).cameras.values()))
    assert (first.width, first.height, first.fy) == (300, 200, pytest.approx(150))


def test_another_shape_keeps_the_vertical_field_of_view():
    first = next(iter(plan(Request(width=100, height=100, **SHORT), source()).cameras.values()))
    assert (first.width, first.height) == (100, 100)
    assert first.fx == first.fy == pytest.approx(75)


@pytest.mark.parametrize("z_up", [True, False])
def test_an_orbit_is_level_around_what_the_cameras_look_at(z_up):
    found = viewmats(plan(Request("orbit", **SHORT), source(z_up=z_up)))
    places = -np.einsum("cji,cj->ci", found[:, :3, :3], found[:, :3, 3])
    np.testing.assert_allclose(places[:, 2], 1, atol=0.02)
    np.testing.assert_allclose(np.linalg.norm(places[:, :2], axis=1), 3, atol=0.05)
    np.testing.assert_allclose(found[:, 0, 2], 0, atol=0.01)


def test_views_keep_their_own_lens():
    camera = plan(Request(views=("003",)), source()).cameras["003"]
    assert (camera.width, camera.height, camera.cx, camera.cy) == (300, 200, 155, 95)


def test_a_frame_without_a_camera_and_a_part_without_views_are_said():
    whole = source()
    with pytest.raises(ConfigError, match="got no camera"):
        plan(Request(views=("099.png",)), whole)
    none = replace(whole, scene=replace(whole.scene, validation=()))
    with pytest.raises(ConfigError, match="no validation views"):
        plan(Request(views=("validation",)), none)
