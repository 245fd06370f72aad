"""Depth and priors beside the cameras of an export."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from recon_cli.export.camera_files import _as_seen
from recon_cli.io.colmap import write_priors
from recon_cli.io.depth_maps import lens_camera, write_depth
from recon_cli.scene.camera import Camera, Lens


def plane(lens):
    """Returns the depth of the plane x + 2 z = 6 at the pixels of a pinhole."""
    fx, _, cx, _ = lens.params[:4]
    x = (np.arange(lens.width) + 0.5 - cx) / fx
    return np.tile(6 / (x + 2), (lens.height, 1)).astype(np.float32)


def view(width, height, focal):
    return Camera(width, height, focal, focal, width / 2 - 1.5, height / 2, np.eye(4))


def test_depth_is_looked_up_along_the_ray(tmp_path):
    lens = Lens("PINHOLE", 40, 30, (35.0, 35.0, 19.0, 15.5))
    record = write_depth(tmp_path, "a.png", plane(lens), lens)
    camera = view(80, 60, 100.0)
    seen = _as_seen(tmp_path, "a.png", record, camera)
    x = (np.arange(80) + 0.5 - camera.cx) / camera.fx
    # Half a pixel of the depth, 1/70, moves the plane by 6 / 4 of it at most.
    np.testing.assert_allclose(seen, np.tile(6 / (x + 2), (60, 1)), atol=6 / 2.6 / 70)


def test_depth_of_low_confidence_or_out_of_range_is_unknown(tmp_path):
    lens = Lens("PINHOLE", 40, 30, (35.0, 35.0, 20.0, 15.0))
    levels = np.full((30, 40), 2, np.uint8)
    levels[:, :20] = 0
    record = write_depth(
        tmp_path, "a.png", plane(lens), lens, confidence=levels, reliable=2.8)
    seen = _as_seen(tmp_path, "a.png", record, Camera(40, 30, 35, 35, 20, 15, np.eye(4)))
    assert not seen[:, :20].any()
    assert seen.max() <= 2.8
    assert seen[:, 30:].all()


def test_pixels_beyond_the_depth_are_unknown(tmp_path):
    lens = Lens("PINHOLE", 20, 15, (35.0, 35.0, 10.0, 7.5))  # a narrow view
    record = write_depth(tmp_path, "a.png", np.ones((15, 20), np.float32), lens)
    seen = _as_seen(tmp_path, "a.png", record, Camera(40, 30, 35, 35, 20, 15, np.eye(4)))
    assert seen.sum() == 15 * 20


def test_a_distorted_lens_is_followed():
    k1 = -0.1
    lens = Lens("OPENCV", 100, 80, (90.0, 90.0, 50.0, 40.0, k1, 0.0, 0.0, 0.0))
    (at,) = lens_camera(lens).img_from_cam(np.array([[0.3, 0.1, 1.0]]))
    scale = 1 + k1 * (0.3**2 + 0.1**2)
    assert at == pytest.approx([90 * 0.3 * scale + 50, 90 * 0.1 * scale + 40])


def test_priors_hold_places_their_deviation_and_gravity(tmp_path):
    turned = np.eye(4)
    turned[:3] = [[1, 0, 0, 2.0], [0, 0, -1, 1.0], [0, 1, 0, 0.5]]  # looks along y, z is up
    views = [("a.png", view(40, 30, 35.0)), ("b.png", replace(view(40, 32, 35.0), viewmat=turned))]
    write_priors(tmp_path / "database.db", views, deviation=0.1, up=np.array([0.0, 0, 1]))
    with pycolmap.Database.open(str(tmp_path / "database.db")) as database:
        first, second = database.read_all_pose_priors()
        assert [image.name for image in database.read_all_images()] == ["a.png", "b.png"]
        assert database.num_cameras() == 2
    np.testing.assert_allclose(np.ravel(second.position), views[1][1].center)
    np.testing.assert_allclose(second.position_covariance, 0.01 * np.eye(3))
    np.testing.assert_allclose(np.ravel(second.gravity), [0, 1, 0], atol=1e-12)  # down the picture
    np.testing.assert_allclose(np.ravel(first.gravity), [0, 0, -1], atol=1e-12)
    write_priors(tmp_path / "database.db", views, deviation=None, up=None)  # again
    with pycolmap.Database.open(str(tmp_path / "database.db")) as database:
        first, _ = database.read_all_pose_priors()
    assert not first.has_position_cov()
    assert not first.has_gravity()
