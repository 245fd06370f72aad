"""Cameras made by hand, and read from data sets."""

from __future__ import annotations

import json

import numpy as np
import pytest
from facts import raises

from recon_cli.api import Camera, FormatError, InputError, look_at, make_camera, read_cameras
from recon_cli.datasets.transforms import write_transforms
from recon_cli.io.colmap import write_colmap

K = [[500.0, 0, 320], [0, 510, 230], [0, 0, 1]]


def turned() -> np.ndarray:
    """A rigid matrix that is its own inverse in no part."""
    matrix = np.eye(4)
    matrix[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
    matrix[:3, 3] = [1, 2, 3]
    return matrix


def same(one: Camera, other: Camera) -> bool:
    inner = ("width", "height", "fx", "fy", "cx", "cy")
    return all(getattr(one, name) == pytest.approx(getattr(other, name)) for name in inner) and (
        np.allclose(one.viewmat, other.viewmat, atol=1e-12))


def test_viewmat_and_pose_are_two_ways_to_say_the_same() -> None:
    of_viewmat = make_camera(K, 640, 480, viewmat=turned())
    assert (of_viewmat.fx, of_viewmat.fy, of_viewmat.cx, of_viewmat.cy) == (500, 510, 320, 230)
    assert np.array_equal(of_viewmat.viewmat, turned())  # to the bit
    of_pose = make_camera(K, 640, 480, pose=np.linalg.inv(turned()))
    assert same(of_pose, of_viewmat)
    flip = np.diag([1.0, -1, -1, 1])
    assert same(make_camera(K, 640, 480, pose=np.linalg.inv(turned()) @ flip, opengl=True), of_pose)


def test_look_at_puts_its_target_in_the_middle_and_up_above() -> None:
    camera = look_at((0, -3, 1), (0, 1, 1), width=100, height=80, fov_deg=90)
    assert camera.fx == camera.fy == pytest.approx(50)
    assert camera.center == pytest.approx([0, -3, 1])
    target, above = (camera.viewmat @ np.array([*point, 1.0]) for point in (
        (0, 1, 1), (0, 1, 2)))
    assert target[:3] == pytest.approx([0, 0, 4])
    assert above[1] < 0  # y is down
    assert above[0] == pytest.approx(0)


@pytest.mark.parametrize(("arguments", "facts"), [
    ({}, ["viewmat", "pose"]),
    ({"viewmat": np.eye(4), "pose": np.eye(4)}, ["viewmat", "pose"]),
    ({"viewmat": 2 * np.eye(4)}, ["viewmat", "rigid"]),
    ({"viewmat": np.diag([1.0, 1, -1, 1])}, ["reflection"]),
    ({"pose": np.diag([2.0, 2, 2, 1])}, ["pose", 2]),
    ({"viewmat": np.eye(3)}, [9]),
    ({"viewmat": np.eye(4), "K": np.eye(4)}, ["K", "(4, 4)"]),
    ({"viewmat": np.eye(4), "K": -np.eye(3)}, ["K", "intrinsics"]),
    ({"viewmat": np.eye(4), "width": 0}, ["0x480"]),
    ({"viewmat": np.eye(4), "opengl": True}, ["opengl"]),
])
def test_what_is_no_camera_is_refused(arguments: dict, facts: list) -> None:
    with raises(InputError, *facts):
        make_camera(**{"K": K, "width": 640, "height": 480, **arguments})


@pytest.mark.parametrize("arguments", [
    {"eye": (0, 0, 0), "target": (0, 0, 0)}, {"eye": (0, 0, 0), "target": (0, 0, 5)},
    {"eye": (0, 0), "target": (1, 0, 0)},
    {"eye": (0, 0, 0), "target": (1, 0, 0), "fov_deg": 180}])
def test_a_look_that_is_none_is_refused(arguments: dict) -> None:
    with pytest.raises(InputError):
        look_at(**arguments)


@pytest.fixture
def cameras() -> dict[str, Camera]:
    return {name: look_at((at, -3, 1), (0, 0, 1), width=64, height=48)
            for at, name in enumerate(["a.png", "b.png", "c.png"])}


def test_a_colmap_model_needs_no_images(cameras: dict[str, Camera], tmp_path) -> None:
    write_colmap(tmp_path / "sparse" / "0", list(cameras.items()), np.zeros((0, 3)),
                 np.zeros((0, 3), np.uint8))
    for place in (tmp_path, tmp_path / "sparse" / "0", str(tmp_path)):
        found = read_cameras(place)
        assert list(found) == list(cameras)
        assert all(same(found[name], camera) for name, camera in cameras.items())


def test_transforms_need_no_images_where_they_state_a_size(
    cameras: dict[str, Camera], tmp_path
) -> None:
    path = tmp_path / "transforms.json"
    write_transforms(path, list(cameras.items()), held_out=["b.png"])
    for place in (tmp_path, path):
        found = read_cameras(place)
        assert list(found) == list(cameras)
        assert all(same(found[name], camera) for name, camera in cameras.items())
    value = json.loads(path.read_text())
    del value["w"]
    path.write_text(json.dumps(value))
    with raises(FormatError, "states", "size"):
        read_cameras(path)


def test_distorted_cameras_are_refused_or_taken_for_pinholes(tmp_path) -> None:
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({
        "fl_x": 50, "fl_y": 51, "cx": 32, "cy": 24, "w": 64, "h": 48, "k1": 0.1,
        "frames": [{"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}]}))
    with raises(InputError, 1, "distortion"):
        read_cameras(path)
    camera = read_cameras(path, ignore_distortion=True)["a.png"]
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (50, 51, 32, 24)


def test_what_is_no_data_set_is_refused(tmp_path) -> None:
    with raises(InputError):
        read_cameras(tmp_path / "none")
    with raises(InputError, "data"):
        read_cameras(tmp_path)


@pytest.mark.integration
def test_cameras_of_another_program_are_those_that_ingest_reads(shared_data) -> None:
    from recon_cli.datasets.layouts import read_posed

    for name in ("fox", "desk_monitors"):
        posed = {image.name: image for image in read_posed(shared_data / name).images}
        found = read_cameras(shared_data / name, ignore_distortion=True)
        assert set(posed) <= set(found)  # of fox some images are missing
        for key, image in posed.items():
            assert np.array_equal(found[key].viewmat, image.viewmat)
