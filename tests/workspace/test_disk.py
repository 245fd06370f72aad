"""A full disk is told from whatever error, and a file that C++ left too short is found."""

import errno
import os
import sqlite3
import tempfile

import numpy as np
import pytest
from facts import raises
from safetensors import SafetensorError

from recon_cli.errors import SfmError, WorkspaceError
from recon_cli.io.colmap_library import check_model, pycolmap, write_model
from recon_cli.workspace import disk
from recon_cli.workspace.disk import explain, explain_outside, find_space_errno, refuse_full_disk
from recon_cli.workspace.layout import disk_errors

FULL = os.strerror(errno.ENOSPC)


@pytest.mark.parametrize("error", [
    OSError(errno.ENOSPC, FULL), OSError(errno.EDQUOT, "quota"),
    SafetensorError(f"Error while serializing: I/O error: {FULL} (os error 28)"),
    sqlite3.OperationalError("database or disk is full"),
    RuntimeError("SQLite error: database or disk is full"), ValueError(f"cannot write x: {FULL}")])
def test_a_full_disk_is_told_from_the_error_of_any_library(tmp_path, error):
    with raises(WorkspaceError, "disk", "training", "MB"), disk_errors(tmp_path, "training"):
        raise error


def test_what_led_to_an_error_counts(tmp_path):
    error = SfmError("No model was found.")
    error.__cause__ = OSError(errno.ENOSPC, FULL)
    assert find_space_errno(error) == errno.ENOSPC
    assert explain(error, tmp_path, "training") is not None


@pytest.mark.parametrize("error", [
    ValueError("wrong"), OSError(errno.ENOENT, "none"), SfmError("No model was found.")])
def test_another_error_passes(tmp_path, error):
    with pytest.raises(type(error)) as raised, disk_errors(tmp_path, "training"):
        raise error
    assert raised.value is error


def test_a_file_that_is_too_large_for_a_limit_is_another_matter(tmp_path):
    error = SafetensorError(f"I/O error: {os.strerror(errno.EFBIG)} (os error 27)")
    found = explain(error, tmp_path, "training")
    assert found is not None
    assert "ulimit" in found.hint


def test_no_place_for_temporary_files_is_said(tmp_path, monkeypatch):
    def fail():
        raise FileNotFoundError(errno.ENOENT, "No usable temporary directory found in ['/tmp']")

    monkeypatch.setattr(tempfile, "gettempdir", fail)
    with pytest.raises(FileNotFoundError) as raised:
        tempfile.gettempdir()
    found = explain(raised.value, tmp_path, "training")
    assert found is not None
    assert "TMPDIR" in found.hint


def test_the_disk_that_is_named_is_the_one_with_the_least_space(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "gettempdir", lambda: str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(disk, "_free", lambda path: 5 if path.name == "temporary" else 10**9)
    found = explain(OSError(errno.ENOSPC, FULL), tmp_path / "workspace", "training")
    assert found is not None
    assert str(tmp_path / "temporary") in found.message


def test_a_path_that_cannot_be_opened_is_no_bug():
    found = explain_outside(OSError(errno.EIO, "Input/output error", "/mnt/x"))
    assert found is not None
    assert "/mnt/x" in found.message
    assert explain_outside(OSError(errno.ENOENT, "none", "/mnt/x")) is None
    assert explain_outside(ValueError("wrong")) is None


def test_a_probe_leaves_nothing_and_finds_a_full_disk(tmp_path, monkeypatch):
    refuse_full_disk(tmp_path)

    def fail(_descriptor):
        raise OSError(errno.ENOSPC, FULL)

    monkeypatch.setattr(os, "fsync", fail)
    with raises(OSError, FULL):
        refuse_full_disk(tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.fixture
def model():
    made = pycolmap.Reconstruction()
    made.add_camera_with_trivial_rig(pycolmap.Camera(
        camera_id=1, model="PINHOLE", width=64, height=48, params=[50.0, 50.0, 32.0, 24.0]))
    for number in (1, 2):
        image = pycolmap.Image(
            image_id=number, name=f"é{number}.png", camera_id=1,
            keypoints=np.random.default_rng(number).random((20, 2)))
        made.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    for index in range(20):
        track = pycolmap.Track()
        track.add_element(1, index)
        track.add_element(2, index)
        made.add_point3D(np.ones(3) * index, track, np.zeros(3, np.uint8))
    return made


def test_a_model_is_written_as_large_as_it_has_to_be(tmp_path, model):
    write_model(model, tmp_path)
    assert pycolmap.Reconstruction(tmp_path).num_points3D() == 20


@pytest.mark.parametrize("name", ["images.bin", "points3D.bin"])
def test_a_model_whose_files_are_too_short_is_a_full_disk(tmp_path, model, name):
    write_model(model, tmp_path)
    os.truncate(tmp_path / name, (tmp_path / name).stat().st_size - 1)
    with raises(OSError, FULL):
        check_model(model, tmp_path)
