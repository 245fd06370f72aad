"""Sensor depth comes to the views in the units of the model, with the noise that it shows."""

from pathlib import Path

import numpy as np
import pytest
from facts import assert_facts

from recon_cli.io.depth_maps import write_depth, write_depth_list
from recon_cli.io.sensor_depth import LEAST_NOISE, read_sensor_depth
from recon_cli.scene.camera import Camera, Lens
from recon_cli.scene.scene import Scene, View

LENS = Lens("PINHOLE", 64, 48, (60.0, 60.0, 32.0, 24.0))
NAMES = tuple(f"{index}.png" for index in range(8))
METRES = 0.5  # of a unit of the model
FOCAL, SIZE = 240.0, (256, 192)


def cameras():
    for index in range(len(NAMES)):
        viewmat = np.eye(4)
        viewmat[0, 3] = -0.2 * index
        yield Camera(*SIZE, FOCAL, FOCAL, SIZE[0] / 2, SIZE[1] / 2, viewmat)


def slope(x, y):
    """z of a tilted wall along the ray (x, y, 1) of a camera at the height of the origin."""
    return 4.0 / (1 - 0.2 * y + 0 * x)  # the plane z = 4 + .2 y, whatever the camera's x


@pytest.fixture
def scene(tmp_path):
    """Eight cameras before a tilted wall with points on it, each seen in all images."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-0.4, 0.4, (2, 400))
    z = slope(x, y)
    points = np.stack([x * z + 0.7, y * z, z], 1)
    views = tuple(View(name, camera, Path(name), Path(name))
                  for name, camera in zip(NAMES, cameras(), strict=True))
    return Scene(views, (), (), (), points, np.zeros((400, 3), np.uint8), depth=tmp_path)


def truth(lens=LENS):
    """The wall in metres as a sensor of these intrinsics sees it."""
    fx, fy, cx, cy = lens.params
    row, column = np.mgrid[:lens.height, :lens.width] + 0.5
    return METRES * slope((column - cx) / fx, (row - cy) / fy)


def write(scene, change=lambda _, depth: depth, *, lens=LENS, levels=None, **more):
    write_depth_list(scene.depth, {
        name: write_depth(
            scene.depth, name, change(name, truth(lens)).astype(np.float32), lens,
            confidence=None if levels is None else levels, **more)
        for name in NAMES})


def noisy(share):
    rng = np.random.default_rng(1)
    return lambda _, depth: depth * (1 + share * rng.normal(size=depth.shape))


def test_depth_is_in_units_of_the_model_at_the_pixels_where_it_was_measured(scene):
    write(scene)
    sensor = read_sensor_depth(scene)
    assert not sensor.refused
    assert sensor.metres == pytest.approx(METRES, rel=2e-3)  # the nearest pixel's depth
    assert set(sensor.depths) == set(NAMES)
    one, camera = sensor.depths["3.png"], scene.train[3].camera
    assert one.noise == pytest.approx(LEAST_NOISE, abs=3e-3)
    image = one.image(camera)
    row, column = np.nonzero(image)
    assert len(row) > 2500
    assert one.cells == 64 * 48
    expected = slope((column + 0.5 - 128) / FOCAL, (row + 0.5 - 96) / FOCAL)
    np.testing.assert_allclose(image[row, column], expected, rtol=6e-3)  # half a coarse pixel


@pytest.mark.parametrize("share", [0.01, 0.04])
def test_the_noise_of_the_sensor_is_measured_at_the_points(scene, share):
    write(scene, noisy(share))
    sensor = read_sensor_depth(scene)
    assert {one.noise for one in sensor.depths.values()} == {sensor.depths["0.png"].noise}
    assert sensor.depths["0.png"].noise == pytest.approx(share, rel=0.2)
    assert sensor.metres == pytest.approx(METRES, rel=share / 2)


def test_a_larger_map_with_another_middle_and_distortion_gives_no_more_samples(scene):
    lens = Lens("OPENCV", 320, 240, (310.0, 300.0, 150.0, 125.0, 0.0, 0.0, 0.0, 0.0))
    plain = Lens("PINHOLE", 320, 240, lens.params[:4])
    write_depth_list(scene.depth, {
        name: write_depth(scene.depth, name, truth(plain).astype(np.float32), lens)
        for name in NAMES})
    sensor = read_sensor_depth(scene, most_samples=5000)
    one = sensor.depths["0.png"]
    assert 3000 < len(one.depths) <= 5000
    np.testing.assert_allclose(one.depths, slope(*one.rays.T), rtol=5e-3)


def test_what_is_not_sure_or_too_far_or_beside_an_edge_is_left_out(scene):
    levels = np.full((48, 64), 2, np.uint8)
    levels[:, :20] = 1
    write(scene, levels=levels)
    rays = read_sensor_depth(scene).depths["0.png"].rays
    assert rays[:, 0].min() > (20 - 32) / 60
    far = 1.02 * 4.0 * METRES
    write(scene, reliable=far)
    assert read_sensor_depth(scene).depths["0.png"].depths.max() <= far / METRES * 1.01

    def edge(_, depth):
        depth = depth.copy()
        depth[:, 60:] *= 1.5
        return depth

    write(scene, edge)
    columns = read_sensor_depth(scene).depths["0.png"].rays[:, 0] * 60 + 32
    assert not ((columns > 59) & (columns < 61)).any()


def test_rows_in_the_wrong_order_are_refused(scene):
    def tilted(_, depth):  # 30% of slope from top to bottom
        return depth * np.linspace(0.6, 1.4, 48)[:, None]

    write(scene, tilted)
    sensor = read_sensor_depth(scene)
    assert not sensor.depths
    assert_facts(sensor.refused, "differs", "points")


def test_a_view_with_the_depth_of_another_moment_is_left_out(scene):
    write(scene, lambda name, depth: depth * (1.2 if name == "4.png" else 1))
    sensor = read_sensor_depth(scene)
    assert sensor.left_out == ("4.png",)
    assert set(sensor.depths) == set(NAMES) - {"4.png"}


def test_too_few_points_say_nothing_about_the_sensor(scene):
    write(scene)
    few = Scene(scene.train, (), (), (), scene.points[:5], scene.colors[:5], depth=scene.depth)
    sensor = read_sensor_depth(few)
    assert not sensor.depths
    assert_facts(sensor.refused, "points", "model")


def test_a_scene_without_depth_has_none_and_nothing_to_say(scene):
    bare = Scene(scene.train, (), (), (), scene.points, scene.colors)
    sensor = read_sensor_depth(bare)
    assert not sensor.depths
    assert not sensor.refused
