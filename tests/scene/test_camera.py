"""Projection in closed form, with what lies behind, and against COLMAP for any lens."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recon_cli.io import depth_maps
from recon_cli.io.colmap_library import pycolmap
from recon_cli.scene.camera import Camera, Lens


def _camera(rng, width=64, height=48):
    viewmat = np.eye(4)
    viewmat[:3, :3] = Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix()
    viewmat[:3, 3] = rng.normal(size=3)
    return Camera(width, height, *rng.uniform(30, 90, 2), *rng.uniform(10, 40, 2), viewmat)


def test_points_project_in_closed_form_and_come_back():
    rng = np.random.default_rng(0)
    for _ in range(20):
        camera = _camera(rng)
        pixels, depths = rng.uniform(-50, 120, (30, 2)), rng.uniform(0.01, 50, 30)
        local = np.column_stack([
            (pixels[:, 0] - camera.cx) / camera.fx, (pixels[:, 1] - camera.cy) / camera.fy,
            np.ones(30)]) * depths[:, None]
        points = (np.linalg.inv(camera.viewmat) @ np.column_stack([local, np.ones(30)]).T).T[:, :3]
        found, z = camera.project(points.reshape(5, 6, 3))
        assert (found.shape, z.shape) == ((5, 6, 2), (5, 6))
        np.testing.assert_allclose(found.reshape(-1, 2), pixels, atol=1e-6)
        np.testing.assert_allclose(z.reshape(-1), depths, rtol=1e-9)
        np.testing.assert_allclose(camera.unproject(pixels, depths), points, atol=1e-9)


@pytest.mark.filterwarnings("error")
def test_what_lies_behind_has_no_pixel_and_is_not_visible():
    camera = Camera(4, 2, 1.0, 1.0, 2.0, 1.0, np.eye(4))
    points = np.array([[0, 0, 1.0], [0, 0, 0], [0, 0, -1], [1, 0, 0], [2, 0, 1], [-2, -1, 1],
                       [1, 1, 1e-320], [0.5, 0.9, 1]])
    pixels, depths = camera.project(points)
    np.testing.assert_array_equal(np.isnan(pixels).any(axis=1), points[:, 2] <= 0)
    np.testing.assert_array_equal(depths, points[:, 2])
    rows, columns, lines, near = camera.find_visible(points)
    assert rows.tolist() == [0, 5, 7]
    assert [columns.tolist(), lines.tolist()] == [[2, 0, 2], [1, 0, 1]]
    assert near.tolist() == [1, 1, 1]


@pytest.mark.parametrize("lens", [
    Lens("SIMPLE_RADIAL", 64, 48, (40.0, 30.0, 20.0, 0.1)),
    Lens("OPENCV", 64, 48, (40.0, 45.0, 30.0, 20.0, -0.1, 0.02, 0.001, 0.002)),
    Lens("OPENCV_FISHEYE", 64, 48, (40.0, 45.0, 30.0, 20.0, 0.01, 0.0, 0.0, 0.0))])
def test_a_lens_shows_the_points_before_it_where_colmap_does(lens):
    points = np.random.default_rng(1).normal(size=(400, 3))
    rows, columns, lines = depth_maps.find_visible(depth_maps.lens_camera(lens), points)
    expected = {}
    for row, point in enumerate(points):
        pixel = depth_maps.lens_camera(lens).img_from_cam(point[None])[0]
        if point[2] > 0 and (pixel >= 0).all() and (pixel < (64, 48)).all():
            expected[row] = tuple(np.floor(pixel).astype(int))
    assert len(expected) > 20
    assert dict(zip(rows.tolist(), zip(columns, lines, strict=True), strict=True)) == expected


@pytest.mark.parametrize(("model", "params"), [
    ("SIMPLE_PINHOLE", (40.0, 30.0, 20.0)), ("SIMPLE_RADIAL", (40.0, 30.0, 20.0, 0.0)),
    ("RADIAL", (40.0, 30.0, 20.0, 0.0, 0.0)), ("PINHOLE", (40.0, 45.0, 30.0, 20.0)),
    ("OPENCV", (40.0, 45.0, 30.0, 20.0, 0.0, 0.0, 0.0, 0.0))])
def test_the_pinhole_of_a_lens_without_distortion_is_that_lens(model, params):
    points = np.random.default_rng(2).uniform([-1, -1, 0.5], [1, 1, 2], (50, 3))
    pinhole = Lens(model, 64, 48, params).pinhole(np.eye(4))
    theirs = pycolmap.Camera(model=model, width=64, height=48, params=params).img_from_cam(points)
    np.testing.assert_allclose(pinhole.project(points)[0], theirs, atol=1e-9)
