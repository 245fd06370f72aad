"""Cameras that leave as transforms.json or as a COLMAP model come back as they were."""

import json

import numpy as np
import posed_sets
import pytest
from facts import raises

from recon_cli.datasets.colmap import read_colmap
from recon_cli.datasets.transforms import read_transforms, write_transforms
from recon_cli.errors import InputError
from recon_cli.io.colmap import write_colmap
from recon_cli.scene.camera import Camera

POINTS = np.array([[0.5, -1.25, 3], [1, 2, 4.5]])
COLORS = np.array([[255, 0, 7], [1, 2, 3]], np.uint8)


def made(folder, count=4, **other):
    """Images in a folder, and a camera for each; the last is of another kind where one is given."""
    views = []
    for at in range(count):
        inner = {"fx": 30.0, "fy": 31.25, "cx": 16.5, "cy": 11.0}
        inner |= other if at == count - 1 else {}
        views.append((f"images/{at:04d}.png", Camera(
            posed_sets.WIDTH, posed_sets.HEIGHT, viewmat=np.linalg.inv(posed_sets.pose(at)),
            **inner)))
        posed_sets.write_image(folder / views[-1][0])
    return views


def assert_same(posed, views, folder=""):
    assert len(posed.images) == len(views)
    for image, (name, camera) in zip(posed.images, views, strict=True):
        assert folder + image.name == name
        np.testing.assert_allclose(image.viewmat, camera.viewmat, atol=1e-14)
        lens = image.lens
        assert (lens.model, lens.width, lens.height) == ("PINHOLE", camera.width, camera.height)
        assert lens.params == (camera.fx, camera.fy, camera.cx, camera.cy)


@pytest.mark.parametrize("other", [{}, {"fx": 40.5, "cy": 12.25}])
def test_transforms_come_back_as_they_were(tmp_path, other):
    views = made(tmp_path, **other)
    write_transforms(tmp_path / "transforms.json", views)
    posed = read_transforms(tmp_path)
    assert_same(posed, views, "images/")
    assert len(posed.lenses) == 1 + bool(other)


def test_a_camera_that_looks_ahead_looks_along_minus_z_in_the_file(tmp_path):
    (name, camera), *_ = made(tmp_path)
    camera.viewmat[:] = np.eye(4)
    camera.viewmat[:3, 3] = [0, 0, 2]  # two behind the origin, axes of the world
    write_transforms(tmp_path / "transforms.json", [(name, camera)])
    (frame,) = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    assert frame["transform_matrix"] == [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, -2], [0, 0, 0, 1]]


def test_held_out_views_stay_held_out(tmp_path):
    views = made(tmp_path)
    write_transforms(tmp_path / "transforms.json", views, held_out=[views[2][0]])
    value = json.loads((tmp_path / "transforms.json").read_text())
    assert value["val_filenames"] == value["test_filenames"] == [views[2][0]]
    assert [image.held_out for image in read_transforms(tmp_path).images] == [
        False, False, True, False]


@pytest.mark.parametrize("name", ["/a.png", "../a.png", "images/../../a.png"])
def test_a_path_that_leaves_the_folder_is_refused(tmp_path, name):
    ((_, camera),) = made(tmp_path, 1)
    with raises(ValueError, name):
        write_transforms(tmp_path / "transforms.json", [(name, camera)])
    assert not (tmp_path / "transforms.json").exists()


@pytest.mark.parametrize("other", [{}, {"fx": 40.5}])
def test_colmap_models_come_back_as_they_were(tmp_path, other):
    views = [(name.removeprefix("images/"), camera) for name, camera in made(tmp_path, **other)]
    write_colmap(tmp_path / "sparse" / "0", views, POINTS, COLORS)
    posed = read_colmap(tmp_path)
    assert_same(posed, views)
    assert len(posed.lenses) == 1 + bool(other)
    np.testing.assert_array_equal(posed.points, POINTS)
    np.testing.assert_array_equal(posed.colors, COLORS)


def test_a_folder_that_holds_something_is_left_alone(tmp_path):
    views = made(tmp_path)
    with raises(InputError, "empty"):
        write_colmap(tmp_path, views, POINTS, COLORS)
    assert [path.name for path in tmp_path.iterdir()] == ["images"]


def test_no_cameras_are_no_scene(tmp_path):
    with raises(InputError, "cameras"):
        write_transforms(tmp_path / "transforms.json", [])
    with raises(InputError, "cameras"):
        write_colmap(tmp_path / "sparse", [], POINTS, COLORS)
    assert list(tmp_path.iterdir()) == []
