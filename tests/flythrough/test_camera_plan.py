"""Which cameras a request gives: paths, parts of the views, sizes of frames."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from facts import raises

from recon_cli.config.stages import RunConfig
from recon_cli.errors import ConfigError
from recon_cli.flythrough import camera_plan
from recon_cli.flythrough.camera_plan import check_frame_memory, frame_size, plan_cameras
from recon_cli.flythrough.request import RenderRequest
from recon_cli.flythrough.trained_scene import TrainedScene
from recon_cli.scene.camera import Camera, looking_at
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


def trained(*more, z_up=True, max_size=300):
    points = np.random.default_rng(0).normal(scale=0.05, size=(200, 3))
    views = [view(number) for number in range(40)]
    scene = Scene(
        (*views[1::2], *more), (views[2],), tuple(views[0::8]), ("099.png",), points,
        np.zeros((200, 3), np.uint8))
    config = RunConfig(max_size=max_size, sh_degree=0)
    return TrainedScene("base", None, "", config, scene, z_up, True)


def viewmats(plan):
    return np.stack([camera.viewmat for camera in plan.cameras.values()])


@pytest.mark.parametrize("path", ["training", "orbit"])
def test_held_out_and_validation_views_play_no_part_in_a_path(path):
    request, whole = RenderRequest(path, **SHORT), trained()
    alone = replace(whole, scene=replace(whole.scene, test=(), validation=()))
    np.testing.assert_array_equal(
        viewmats(plan_cameras(request, whole)), viewmats(plan_cameras(request, alone)))


def test_frames_see_as_the_training_images_do_at_their_size():
    plan = plan_cameras(RenderRequest(**SHORT), trained())
    first = next(iter(plan.cameras.values()))
    assert len(plan.cameras) == 10
    assert (first.width, first.height) == (300, 200)
    assert first.fx == first.fy == pytest.approx(150)
    assert (first.cx, first.cy) == (150, 100)


def test_of_several_cameras_the_usual_one_gives_shape_and_field_of_view():
    others = [view(number, width=400, height=600, focal=700.0) for number in range(0, 40, 8)]
    first = next(iter(plan_cameras(RenderRequest(**SHORT), trained(*others)).cameras.values()))
    assert (first.width, first.height, first.fy) == (300, 200, pytest.approx(150))


def test_another_shape_keeps_the_vertical_field_of_view():
    plan = plan_cameras(RenderRequest(width=100, height=100, **SHORT), trained())
    first = next(iter(plan.cameras.values()))
    assert (first.width, first.height) == (100, 100)
    assert first.fx == first.fy == pytest.approx(75)


@pytest.mark.parametrize("z_up", [True, False])
def test_an_orbit_is_level_around_what_the_cameras_look_at(z_up):
    plan = viewmats(plan_cameras(RenderRequest("orbit", **SHORT), trained(z_up=z_up)))
    places = -np.einsum("cji,cj->ci", plan[:, :3, :3], plan[:, :3, 3])
    np.testing.assert_allclose(places[:, 2], 1, atol=0.02)
    np.testing.assert_allclose(np.linalg.norm(places[:, :2], axis=1), 3, atol=0.05)
    np.testing.assert_allclose(plan[:, 0, 2], 0, atol=0.01)


def test_views_keep_their_own_lens():
    camera = plan_cameras(RenderRequest(views=("003",)), trained()).cameras["003"]
    assert (camera.width, camera.height, camera.cx, camera.cy) == (300, 200, 155, 95)


def test_a_frame_without_a_camera_and_a_part_without_views_are_said():
    whole = trained()
    with raises(ConfigError, "camera"):
        plan_cameras(RenderRequest(views=("099.png",)), whole)
    none = replace(whole, scene=replace(whole.scene, validation=()))
    with raises(ConfigError, "validation", "views"):
        plan_cameras(RenderRequest(views=("validation",)), none)


@pytest.mark.parametrize(("options", "own", "expected"), [
    ({}, (601, 337), (601, 337)),
    ({"form": "mp4"}, (601, 337), (600, 336)),
    ({"size": 320}, (600, 338), (320, 180)),
    ({"size": 320}, (338, 600), (180, 320)),
    ({"width": 300}, (600, 337), (300, 168)),
    ({"height": 674}, (600, 337), (1200, 674)),
    ({"width": 300, "form": "mp4"}, (600, 333), (300, 166)),
    ({"width": 100, "height": 90}, (600, 337), (100, 90)),
    ({"size": 2, "form": "mp4"}, (1000, 10), (2, 2)),
])
def test_a_side_that_is_not_given_follows_and_is_even_in_a_video(options, own, expected):
    assert frame_size(*own, RenderRequest(**options)) == expected


@pytest.mark.parametrize("options", [{"width": 301}, {"height": 301}, {"size": 301}])
def test_an_odd_side_of_a_video_is_refused(options):
    with raises(ConfigError, 301):
        frame_size(600, 400, RenderRequest(form="mp4", **options))


def test_a_frame_that_does_not_fit_is_refused_with_the_memory_it_takes(monkeypatch):
    monkeypatch.setattr(camera_plan, "free_memory_bytes", lambda: 1_000_000_000)
    check_frame_memory(1920, 1080)
    with raises(ConfigError, "100000x56250", "562,500", "MB", "1,000"):
        check_frame_memory(100_000, 56_250)


def test_a_side_beyond_all_formats_is_refused_however_much_memory_there_is(monkeypatch):
    monkeypatch.setattr(camera_plan, "free_memory_bytes", lambda: 1 << 60)
    with raises(ConfigError, "65,536"):
        check_frame_memory(100_000, 2)
