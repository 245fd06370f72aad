"""Features of frames, in COLMAP's database."""

import io
import sqlite3
from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image
from sfm_inputs import texture

from recon_cli.errors import SfmError
from recon_cli.io.images import write_png
from recon_cli.sfm import database
from recon_cli.sfm.features import features
from recon_cli.sfm.features.features import extract_features
from recon_cli.sfm.features.matching import create_database
from recon_cli.sfm.job import CameraGroup, MappingJob, Phase, Reporter, parse

NAMES = ("a.png", "b.png", "c.png")
WIDTH, HEIGHT = 240, 180
SILENT = Reporter(io.BytesIO())


def make_job(folder, pictures, **changes):
    """A job and its database with one camera for some pictures, [H, W, 3]."""
    (folder / "frames").mkdir(parents=True)
    names = NAMES[:len(pictures)]
    for name, picture in zip(names, pictures, strict=True):
        write_png(folder / "frames" / name, picture)
    height, width = pictures[0].shape[:2]
    job = replace(MappingJob(
        frames=folder / "frames", out=folder,
        groups=(CameraGroup(names, width, height),), masks=None, poses=None,
        pose_use="keep", given_points=False, pairs="auto", max_features=5000,
        min_registered=0.5, accept_weak=False, partial=True,
        max_minutes=1.0, seed=0, threads=2, sharpness={}, times={}), **changes)
    create_database(job)
    return job


def textures(size=(HEIGHT, WIDTH)):
    return [texture(*size, seed) for seed in range(3)]


@pytest.fixture
def job(tmp_path):
    """Three frames full of keypoints."""
    return make_job(tmp_path / "job", textures())


def keypoints(job):
    with pycolmap.Database.open(job.database) as opened:
        return {image.name: opened.read_keypoints(image.image_id)
                for image in opened.read_all_images()}


def descriptors(job):
    with pycolmap.Database.open(job.database) as opened:
        return {image.name: np.asarray(opened.read_descriptors(image.image_id).data)
                for image in opened.read_all_images()}


def blobs(centers, sigma):
    """A picture with bright Gaussians; (.5, .5) is the middle of the first pixel."""
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    gray = 20 + sum(200 * np.exp(-((x - u)**2 + (y - v)**2) / (2 * sigma**2)) for u, v in centers)
    return np.repeat(np.rint(gray)[:, :, None], 3, axis=2).astype(np.uint8)


def test_a_blob_is_found_where_it_is_and_as_large_as_it_is(tmp_path, monkeypatch):
    monkeypatch.setattr(features.checks, "check_texture", lambda _: None)
    centers = [(60.3, 40.8), (170.0, 120.5)]
    job = make_job(tmp_path / "job", [blobs(centers, 6.0)])
    extract_features(job, SILENT)
    found = keypoints(job)["a.png"]
    for center in centers:
        off = np.linalg.norm(found[:, :2] - center, axis=1)
        assert off.min() < 0.05
        # A blob answers most to a difference of Gaussians of its own sigma.
        assert database.scales(found[[off.argmin()]])[0] == pytest.approx(6.0, rel=0.15)


@pytest.mark.integration
def test_features_are_those_that_colmap_finds(job):
    extract_features(job, SILENT)
    theirs = make_job(job.out / "colmap", textures())
    options = pycolmap.FeatureExtractionOptions()
    options.sift.max_num_features = 5000
    pycolmap.extract_features(
        theirs.database, theirs.frames, extraction_options=options, device=pycolmap.Device.cpu)
    for name, points in keypoints(job).items():
        others, rows = keypoints(theirs)[name], descriptors(theirs)[name].astype(float)
        ours = descriptors(job)[name].astype(float)
        matches = cv2.BFMatcher(cv2.NORM_L2, crossCheck=True).match(
            ours.astype(np.float32), rows.astype(np.float32))
        near = [np.linalg.norm(points[m.queryIdx, :2] - others[m.trainIdx, :2]) < 1
                for m in matches]
        assert np.mean(near) > 0.6
        # Both scale a descriptor to the same length.
        assert np.linalg.norm(ours, axis=1).mean() == pytest.approx(
            np.linalg.norm(rows, axis=1).mean(), rel=0.02)


@pytest.mark.integration
def test_an_image_keeps_its_coarsest_keypoints_and_no_more_than_asked_for(job):
    extract_features(job, SILENT)
    few = make_job(job.out / "few", textures(), max_features=100)
    extract_features(few, SILENT)
    assert [len(found) for found in keypoints(few).values()] == [100, 100, 100]
    for name, every in keypoints(job).items():
        coarsest = np.sort(database.scales(every))[-100:]
        np.testing.assert_array_equal(
            np.sort(database.scales(keypoints(few)[name])), coarsest)
        places = [int(np.flatnonzero((every == point).all(axis=1))[0])
                  for point in keypoints(few)[name]]
        # Without the finest OpenCV starts from the image itself, not from one of twice its size.
        off = descriptors(few)[name].astype(int) - descriptors(job)[name][places]
        assert np.abs(off).mean() < 1


@pytest.mark.integration
def test_a_large_image_is_reduced_where_that_leaves_enough(tmp_path, monkeypatch):
    monkeypatch.setattr(features.checks, "check_texture", lambda _: None)
    spots = np.zeros((1080, 1800), np.float32)
    spots[60:1000:40, 100:1700:40] = 1
    gray = 20 + 200 * (spread := cv2.GaussianBlur(spots, None, 7.0)) / spread.max()
    picture = np.repeat(np.rint(gray)[:, :, None], 3, axis=2).astype(np.uint8)
    found = {}
    for most in (200, 12_000, 50_000):
        job = make_job(tmp_path / str(most), [picture], max_features=most)
        extract_features(job, SILENT)
        found[most] = keypoints(job)["a.png"]
    assert len(found[200]) == 200
    assert 960 <= len(found[50_000]) < 50_000  # all of them, at full size
    # Half of what is wanted is enough: the full size, which has more, is not looked at.
    assert 6_000 <= len(found[12_000]) < len(found[50_000])
    y, x = np.nonzero(spots)
    middles = np.column_stack([x, y]) + 0.5
    places = np.concatenate([middles, middles + 20])  # the spots, and the dips between them
    off = np.linalg.norm(found[200][:, None, :2] - places, axis=2).min(axis=1)
    assert np.median(off) < 0.1


def test_progress_is_reported_up_to_the_last_image(job):
    stream = io.BytesIO()
    extract_features(job, Reporter(stream))
    phase, *counts = map(parse, stream.getvalue().splitlines())
    assert isinstance(phase, Phase)
    assert (phase.done, phase.total) == (0, 3)
    assert counts == [1, 2, 3]


def test_nothing_is_found_where_the_mask_is_black(job, tmp_path):
    (tmp_path / "masks").mkdir()
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:, 120:] = 255
    Image.fromarray(mask).save(tmp_path / "masks" / "b.png")
    extract_features(replace(job, masks=tmp_path / "masks"), SILENT)
    found = keypoints(job)
    assert len(found["b.png"]) > 20
    assert found["b.png"][:, 0].min() >= 120
    assert found["a.png"][:, 0].min() < 120


def test_a_dim_frame_keeps_its_strongest_keypoints(tmp_path, monkeypatch):
    monkeypatch.setattr(features.checks, "check_texture", lambda _: None)
    dim = [(100 + (picture.astype(float) - 128) / 6).astype(np.uint8) for picture in textures()]
    counts = []
    for usual in (1, 60):
        monkeypatch.setattr(features, "USUAL", usual)
        job = make_job(tmp_path / str(usual), dim)
        extract_features(job, SILENT)
        counts.append([len(found) for found in keypoints(job).values()])
    assert max(counts[0]) < 10
    assert all(60 <= count < 75 for count in counts[1])  # of equal contrast all are kept


def test_frames_without_texture_are_refused(tmp_path):
    flat = make_job(tmp_path / "job", [np.full((HEIGHT, WIDTH, 3), 128, np.uint8)] * 3)
    with pytest.raises(SfmError):
        extract_features(flat, SILENT)


@pytest.mark.integration
def test_an_extraction_that_goes_on_gives_the_same(job):
    one = replace(job.groups[0], names=NAMES[:1])
    two = replace(job.groups[0], names=NAMES[1:])
    job = replace(job, groups=(one, two))
    create_database(job)
    extract_features(job, SILENT)
    whole = keypoints(job)
    # As a kill leaves it: the second image lacks its descriptors, the third both.
    with sqlite3.connect(job.database) as connection:
        connection.execute("DELETE FROM descriptors WHERE image_id > 1")
        connection.execute("DELETE FROM keypoints WHERE image_id = 3")
    connection.close()
    extract_features(job, SILENT)
    assert database.is_sound(job.database, NAMES, 2)
    with pycolmap.Database.open(job.database) as opened:
        assert [image.camera_id for image in opened.read_all_images()] == [1, 2, 2]
    for name, found in keypoints(job).items():
        np.testing.assert_array_equal(found, whole[name])
    assert {name: len(rows) for name, rows in descriptors(job).items()} == {
        name: len(rows) for name, rows in whole.items()}
