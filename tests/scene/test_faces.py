"""Faces of a panorama: where a direction lies is known in closed form."""

from pathlib import Path

import numpy as np
import pytest

from recon_cli.scene.faces import (
    CUBE,
    face_camera,
    face_size,
    nearest_face,
    panorama_pixels,
    panorama_rays,
    pixel_rays,
    shared_out_angles,
    solid_angles,
    view_name,
)
from recon_cli.scene.scene import View, views_ahead

WIDTH, HEIGHT = 1536, 768
AXES = {"front": (0, 0, 1), "right": (1, 0, 0), "back": (0, 0, -1), "left": (-1, 0, 0),
        "up": (0, -1, 0), "down": (0, 1, 0)}


def cube(side: int = 64, field_deg: float = 95.0):
    focal = side / 2 / np.tan(np.radians(field_deg / 2))
    return [face_camera(face, side, focal, np.eye(4)) for face in CUBE]


@pytest.mark.parametrize("face", CUBE, ids=lambda face: face.name)
def test_a_face_looks_where_its_name_says_and_is_not_mirrored(face):
    np.testing.assert_array_equal(face.rotation[2], AXES[face.name])
    np.testing.assert_array_equal(face.rotation @ face.rotation.T, np.eye(3))
    assert np.linalg.det(face.rotation) == 1


def test_level_faces_are_upright():
    for face in CUBE[:4]:
        np.testing.assert_array_equal(face.rotation[1], [0, 1, 0])


@pytest.mark.parametrize(("ray", "pixel"), [
    ((0, 0, 1), (WIDTH / 2, HEIGHT / 2)),
    ((1, 0, 0), (3 * WIDTH / 4, HEIGHT / 2)),
    ((-5, 0, 0), (WIDTH / 4, HEIGHT / 2)),
    ((0, -1, 1), (WIDTH / 2, HEIGHT / 4)),
    ((0, 2, 2), (WIDTH / 2, 3 * HEIGHT / 4)),
])
def test_directions_lie_where_the_projection_says(ray, pixel):
    np.testing.assert_allclose(panorama_pixels(np.array(ray, float), WIDTH, HEIGHT), pixel)


def test_pixels_and_rays_of_a_panorama_are_inverse():
    rays = panorama_rays(96, 48)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=2), 1)
    x, y = np.meshgrid(np.arange(96) + 0.5, np.arange(48) + 0.5)
    np.testing.assert_allclose(panorama_pixels(rays, 96, 48), np.stack([x, y], axis=2), atol=1e-9)


def test_a_panorama_has_the_projection_of_colmap():
    from recon_cli.io.colmap_library import pycolmap

    camera = pycolmap.Camera.create_from_model_name(1, "EQUIRECTANGULAR", 1.0, WIDTH, HEIGHT)
    pixels = np.random.default_rng(0).uniform((1, 1), (WIDTH - 1, HEIGHT - 1), (50, 2))
    rays = np.asarray(camera.cam_ray_from_img(pixels))
    np.testing.assert_allclose(panorama_pixels(rays, WIDTH, HEIGHT), pixels, atol=1e-9)


def test_the_faces_of_a_cube_cover_each_direction_once():
    weights = shared_out_angles(cube(side=256))
    assert sum(map(np.sum, weights)) == pytest.approx(4 * np.pi, rel=0.01)
    assert all(weight.sum() == pytest.approx(4 * np.pi / 6, rel=0.01) for weight in weights)
    assert all((weight[0] == 0).all() for weight in weights)  # the overlap belongs to another


def test_a_quarter_turn_sees_a_sixth_of_the_sphere():
    camera = cube(side=512, field_deg=90.0)[0]
    assert solid_angles(camera).sum() == pytest.approx(4 * np.pi / 6, rel=1e-5)
    rays = pixel_rays(camera)
    assert solid_angles(camera)[0, 0] / solid_angles(camera)[256, 256] == pytest.approx(
        np.linalg.norm(rays[0, 0]) ** -3, rel=1e-4)


def test_a_direction_belongs_to_the_nearest_face():
    rotations = [face.rotation for face in CUBE]
    rays = np.array([[0.2, 0.1, 1], [1, 0.3, 0.9], [0.1, 1, -0.2], [0, -1, 0]], float)
    assert nearest_face(rays, rotations).tolist() == [0, 1, 5, 4]


def test_a_face_is_as_fine_as_the_panorama():
    side, focal = face_size(WIDTH / (2 * np.pi))
    assert focal == pytest.approx(WIDTH / (2 * np.pi), rel=2 / side)
    assert side % 2 == 0
    assert 2 * np.degrees(np.arctan(side / 2 / focal)) == pytest.approx(95)


def test_a_view_is_named_after_its_frame_and_face():
    assert view_name("pano000001.png", CUBE[2]) == "pano000001_back.png"


def test_of_the_faces_of_a_frame_one_looks_ahead():
    def view(name, frame=None):
        return View(name, cube()[0], Path(name), Path(name), face_of=frame)

    faces = [view(view_name(f"{k}.png", face), f"{k}.png") for k in (0, 1) for face in CUBE]
    photos = [view("2.png"), view("3_back.png")]
    assert [each.name for each in views_ahead([*faces, *photos])] == [
        "0_front.png", "1_front.png", "2.png", "3_back.png"]
    assert [each.name for each in views_ahead(faces[1:3])] == ["0_right.png"]
