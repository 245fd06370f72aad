"""Pictures of faces put together give the panorama that they were cut from."""

import numpy as np
import pytest

from recon_cli.io.panoramas import panorama_axes, panorama_size, stitch_faces
from recon_cli.scene.faces import (
    CUBE,
    face_camera,
    face_size,
    grid_faces,
    panorama_rays,
    pixel_rays,
    view_name,
)

WIDTH, HEIGHT = 256, 128
VIEWMAT = np.array([[0, 0, 1, 2.0], [1, 0, 0, 1], [0, 1, 0, 0], [0, 0, 0, 1]])


def colours(rays):
    unit = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    return (0.5 + 0.4 * np.sin(2 * unit + [0, 1, 2])).astype(np.float32)


@pytest.fixture
def cameras():
    size = face_size(WIDTH / (2 * np.pi))
    return [face_camera(face, *size, VIEWMAT) for face in CUBE]


def test_faces_join_without_a_seam(cameras):
    pictures = [colours(pixel_rays(camera) @ camera.viewmat[:3, :3]) for camera in cameras]
    panorama = stitch_faces(pictures, cameras, VIEWMAT[:3, :3], WIDTH, HEIGHT)
    expected = colours(panorama_rays(WIDTH, HEIGHT) @ VIEWMAT[:3, :3])
    assert np.abs(panorama - expected).max() < 2e-3


def test_where_a_face_is_missing_it_is_black(cameras):
    pictures = [np.ones((camera.height, camera.width, 1), np.float32) for camera in cameras[:5]]
    panorama = stitch_faces(pictures, cameras[:5], VIEWMAT[:3, :3], WIDTH, HEIGHT)[..., 0]
    assert (panorama[-1] == 0).all()
    assert (panorama[:HEIGHT // 2 + 10] == 1).all()


@pytest.mark.parametrize("place", range(6))
def test_any_face_knows_the_axes_of_its_panorama(cameras, place):
    name = view_name("a_b.png", CUBE[place])
    np.testing.assert_allclose(
        panorama_axes([name], [cameras[place]]), VIEWMAT[:3, :3], atol=1e-12)


def test_faces_of_a_wide_lens_lie_around_the_middle():
    faces = grid_faces((-80, 80), (-60, 60), 2, 2)
    cameras = [face_camera(face, 100, 80.0, VIEWMAT) for face in faces]
    names = [view_name("a.png", face) for face in faces]
    np.testing.assert_allclose(panorama_axes(names, cameras), VIEWMAT[:3, :3], atol=1e-9)


def test_a_panorama_is_as_fine_as_its_faces(cameras):
    width, height = panorama_size(cameras[0])
    assert width == 2 * height
    assert width == pytest.approx(WIDTH, abs=4)  # the side of a face is a whole number
