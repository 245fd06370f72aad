from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from recon_cli.errors import FormatError
from recon_cli.mapping import database
from recon_cli.mapping.features import create_database
from recon_cli.mapping.job import CameraGroup, Job
from recon_cli.scene.lens import Lens

NAMES = ("a.png", "b.png", "c.png")


@pytest.fixture
def job(tmp_path):
    """Three small frames and a folder to work in."""
    (tmp_path / "frames").mkdir()
    (tmp_path / "out").mkdir()
    for name in NAMES:
        Image.new("RGB", (64, 48)).save(tmp_path / "frames" / name)
    return Job(
        frames=tmp_path / "frames", denoised=tmp_path / "frames", out=tmp_path / "out",
        groups=(CameraGroup(NAMES, 64, 48),), masks=None, poses=None,
        pose_use="keep", given_points=False, pairs="auto", max_features=500,
        min_registered=0.5, accept_weak=False, max_minutes=1.0, seed=0, threads=1,
        sharpness={}, times={})


def camera(job):
    with pycolmap.Database.open(job.database) as opened:
        found, = opened.read_all_cameras()
    return found


def test_all_images_share_one_distorted_camera(job):
    create_database(job)
    assert database.is_sound(job.database, NAMES, 1)
    assert camera(job).model.name == "OPENCV"
    assert not camera(job).has_prior_focal_length


def test_images_are_numbered_by_name(job):
    create_database(job)
    with pycolmap.Database.open(job.database) as opened:
        assert [(i.image_id, i.name) for i in opened.read_all_images()] == [
            (1, "a.png"), (2, "b.png"), (3, "c.png")]


def test_a_known_focal_length_is_the_first_guess(job):
    create_database(replace(job, groups=(replace(job.groups[0], focal_px=51.5),)))
    np.testing.assert_array_equal(camera(job).params, [51.5, 51.5, 32, 24, 0, 0, 0, 0])
    assert camera(job).has_prior_focal_length


def test_frames_of_two_cameras_get_a_camera_each(job):
    groups = (CameraGroup(NAMES[:1], 64, 48), CameraGroup(NAMES[1:], 64, 48, focal_px=51.5))
    create_database(replace(job, groups=groups))
    with pycolmap.Database.open(job.database) as opened:
        assert [image.camera_id for image in opened.read_all_images()] == [1, 2, 2]
    assert database.is_sound(job.database, NAMES, 2)
    assert not database.is_sound(job.database, NAMES, 1)


def test_known_intrinsics_are_taken_as_they_are(job):
    lens = Lens("SIMPLE_RADIAL", 64, 48, (50.25, 31.5, 24.5, 0.125))
    create_database(replace(job, groups=(replace(job.groups[0], lens=lens),)))
    assert camera(job).model.name == "SIMPLE_RADIAL"
    np.testing.assert_array_equal(camera(job).params, lens.params)


def test_a_frame_that_cannot_be_read_is_named(job):
    (job.frames / "b.png").write_bytes(b"no picture")
    with pytest.raises(FormatError, match=r"1 of 3 frames cannot be read .* b\.png"):
        create_database(job)
    assert not job.database.exists()


def test_a_frame_of_another_size_is_named(job):
    Image.new("RGB", (48, 64)).save(job.frames / "c.png")
    with pytest.raises(FormatError, match=r"differ from the first in size: c\.png"):
        create_database(job)


def test_a_database_cut_short_is_not_sound(job):
    create_database(job)
    data = job.database.read_bytes()
    job.database.write_bytes(data[:len(data) // 2])
    assert not database.is_sound(job.database, NAMES, 1)


@pytest.mark.parametrize("data", [b"", b"noise" * 1000])
def test_a_file_that_is_no_database_is_not_sound(job, data):
    job.database.write_bytes(data)
    assert not database.is_sound(job.database, NAMES, 1)


def test_a_database_of_other_images_is_not_sound(job):
    create_database(job)
    assert not database.is_sound(job.database, (*NAMES, "d.png"), 1)
    assert not database.is_sound(job.database, NAMES[:2], 1)


def test_a_missing_database_is_not_sound(tmp_path):
    assert not database.is_sound(Path(tmp_path / "none.db"), NAMES, 1)


def test_a_broken_database_is_replaced_with_its_side_files(job):
    job.database.write_bytes(b"noise")
    side = job.database.with_name("database.db-wal")
    side.write_bytes(b"noise")
    create_database(job)
    assert database.is_sound(job.database, NAMES, 1)
    assert not side.exists()
