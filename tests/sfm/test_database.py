"""What the database held at the end of a step is told from what came later, and from damage."""

import contextlib
import sqlite3

import numpy as np
import pycolmap
import pytest
from PIL import Image

from recon_cli.sfm import database
from recon_cli.sfm.features.matching import create_database
from recon_cli.sfm.job import CameraGroup, MappingJob

NAMES = ("a.png", "b.png", "c.png")


def write_features(path, numbers):
    with pycolmap.Database.open(path) as opened:
        for number in numbers:
            opened.write_keypoints(number, np.full((4, 6), number, np.float32))
            opened.write_descriptors(number, pycolmap.FeatureDescriptors(
                pycolmap.FeatureExtractorType.SIFT, np.full((4, 128), number, np.uint8)))


def write_matches(path, first, second):
    with pycolmap.Database.open(path) as opened:
        opened.write_matches(first, second, np.array([[0, 0], [1, 1]], np.uint32))
        opened.write_two_view_geometry(first, second, pycolmap.TwoViewGeometry())


@pytest.fixture
def path(tmp_path):
    """A database of three images with recorded rows: features of two and their matches."""
    for name in NAMES:
        Image.new("RGB", (64, 48)).save(tmp_path / name)
    job = MappingJob(
        frames=tmp_path, out=tmp_path, groups=(CameraGroup(NAMES, 64, 48),),
        masks=None, poses=None, pose_use="keep", given_points=False, pairs="auto",
        max_features=500, min_registered=0.5, accept_weak=False, partial=True,
        max_minutes=1.0, seed=0, threads=1, sharpness={}, times={})
    create_database(job)
    write_features(job.database, (1, 2))
    write_matches(job.database, 1, 2)
    database.record_rows(job.database)
    return job.database


def change(path, statement):
    with contextlib.closing(sqlite3.connect(path)) as opened, opened:
        assert opened.execute(statement).rowcount != 0


def test_recorded_rows_are_kept(path):
    assert database.restore_rows(path) is None
    assert database.progress(path, "features") == 2
    assert database.pair_names(path) == {("a.png", "b.png")}


def test_rows_that_were_written_later_are_deleted(path):
    write_features(path, (3,))
    write_matches(path, 2, 3)
    assert database.restore_rows(path) is None
    assert database.progress(path, "features") == 2
    assert sorted(database.keypoint_counts(path)) == ["a.png", "b.png"]
    assert database.pair_names(path) == {("a.png", "b.png")}
    assert database.matched_ids(path) == [(1, 2)]


@pytest.mark.parametrize(("statement", "step"), [
    ("UPDATE descriptors SET data = zeroblob(512) WHERE image_id = 2", "features"),
    ("UPDATE keypoints SET rows = 3 WHERE image_id = 1", "features"),
    ("DELETE FROM descriptors WHERE image_id = 1", "features"),
    ("UPDATE cameras SET width = 65", "features"),
    ("UPDATE matches SET data = zeroblob(16)", "matches"),
    ("UPDATE two_view_geometries SET config = 3", "matches"),
    ("DELETE FROM matches", "matches")])
def test_a_recorded_row_that_changed_names_the_step_to_take_again(path, statement, step):
    change(path, statement)
    assert database.restore_rows(path) == step


@pytest.mark.parametrize("text", [None, "", "{", "[]", "{}", '{"features": 3, "rest": 0}'])
def test_without_its_digests_a_database_is_not_believed(path, text):
    digests = path.with_name("database.steps")
    digests.unlink()
    if text is not None:
        digests.write_text(text)
    assert database.restore_rows(path) == "features"


def test_a_file_that_is_no_database_has_no_rows(path):
    path.write_bytes(b"no database")
    database.record_rows(path)
    assert database.restore_rows(path) == "features"


def test_matches_can_be_cleared(path):
    database.clear_matches(path)
    assert database.pair_names(path) == set()
    assert database.matched_ids(path) == []
    database.forget_rows(path)
    assert not path.with_name("database.steps").exists()
