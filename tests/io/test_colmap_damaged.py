"""COLMAP data sets that are cut short, malformed or contradict themselves."""

import contextlib

import pycolmap
import pytest
from colmap_sets import (
    FORMS,
    rig_model,
    write,
    write_old,
)
from facts import raises

from recon_cli.datasets.colmap import read_colmap
from recon_cli.errors import FormatError, InputError


@pytest.fixture(params=FORMS)
def form(request):
    return request.param


def cut(path, share):
    data = path.read_bytes()
    path.write_bytes(data[:int(share * len(data))])


def replaced(path, old, new):
    """Puts other words into a text file."""
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))


def test_an_image_outside_the_data_set_is_refused(tmp_path):
    write_old(tmp_path)
    replaced(tmp_path / "sparse" / "images.txt", "c.png", "../../../secret.png")
    with raises(FormatError, "lies", "outside"):
        read_colmap(tmp_path)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.6, 0.99])
def test_a_binary_file_cut_short_anywhere_is_damaged(tmp_path, name, share):
    write(tmp_path, rig_model(), "bin")
    cut(tmp_path / "sparse" / "0" / f"{name}.bin", share)
    with raises(FormatError, "COLMAP"):
        read_colmap(tmp_path)


@pytest.mark.parametrize("name", ["rigs", "frames"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.6, 0.99])
def test_rigs_and_frames_cut_short_anywhere_are_damaged(tmp_path, name, share):
    write(tmp_path, rig_model(), "bin")
    (tmp_path / "sparse" / "0" / "images.bin").unlink()
    cut(tmp_path / "sparse" / "0" / f"{name}.bin", share)
    with raises(FormatError, "COLMAP"):
        read_colmap(tmp_path)


@pytest.mark.integration
@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("value", [0, 127, 255])
def test_whatever_stands_in_a_byte_is_read_or_refused(tmp_path, name, value):
    write(tmp_path, rig_model(frames=1), "bin")
    path = tmp_path / "sparse" / "0" / f"{name}.bin"
    data = path.read_bytes()
    for at in range(len(data)):
        path.write_bytes(data[:at] + bytes([value]) + data[at + 1:])
        with contextlib.suppress(InputError):
            read_colmap(tmp_path)


@pytest.mark.parametrize(("name", "old", "new", "line"), [
    ("cameras", "30 31", "30 wide", 2), ("cameras", "30 31 16.5 11", "30 31 16.5", 2),
    ("cameras", "32 24", "32", 2), ("cameras", "30 31", "nan 31", 2),
    ("cameras", "32 24", "32 inf", 2),
    ("images", "1 0 0 0 1 2 3", "1 0 0 zero 1 2 3", 3), ("images", "3 c.png", "", 5),
    ("images", "1 0 0 0 1 2 3", "0 0 0 0 1 2 3", 3), ("images", "0 0 1 3 c", "0 0 inf 3 c", 5),
    ("points3D", "4 5 6", "4 5 600", 2), ("points3D", "-1 -2 -3", "-1 nan -3", 3),
    ("points3D", "255 0 1 0.25", "255", 3)])
def test_a_malformed_line_of_text_is_named(tmp_path, name, old, new, line):
    write_old(tmp_path)
    replaced(tmp_path / "sparse" / f"{name}.txt", old, new)
    with raises(FormatError, f"{name}.txt", f"line {line}"):
        read_colmap(tmp_path)


@pytest.mark.parametrize(("name", "old", "new"), [
    ("rigs", "CAMERA 2 1", "CAMERA 2"), ("frames", "CAMERA 2 4", "CAMERA"),
    ("frames", "2 CAMERA", "two CAMERA")])
def test_a_malformed_line_of_rigs_or_frames_is_named(tmp_path, name, old, new):
    write(tmp_path, rig_model(), "txt")
    (tmp_path / "sparse" / "0" / "images.txt").unlink()
    replaced(tmp_path / "sparse" / "0" / f"{name}.txt", old, new)
    with raises(FormatError, f"{name}.txt", "line"):
        read_colmap(tmp_path)


def test_an_image_of_an_unknown_camera_is_refused(tmp_path):
    write_old(tmp_path)
    replaced(tmp_path / "sparse" / "cameras.txt", "3 PINHOLE", "4 PINHOLE")
    with raises(FormatError, 3, "unknown"):
        read_colmap(tmp_path)


def test_an_empty_model_is_refused(tmp_path, form):
    write(tmp_path, pycolmap.Reconstruction(), form)
    with raises(FormatError, "image", "pose"):
        read_colmap(tmp_path)
