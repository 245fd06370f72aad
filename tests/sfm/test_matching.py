"""The database, the choice of pairs, and their matching."""

import io
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from facts import raises
from PIL import Image
from sfm_inputs import texture

from recon_cli.errors import FormatError
from recon_cli.io.images import write_png
from recon_cli.scene.camera import Lens
from recon_cli.sfm import database
from recon_cli.sfm.features import matching
from recon_cli.sfm.features.features import extract_features
from recon_cli.sfm.features.matching import (
    create_database,
    exhaustive_pairs,
    match_descriptors,
    match_pairs,
    read_verified,
    sequential_pairs,
    similar_pairs,
)
from recon_cli.sfm.job import CameraGroup, MappingJob, Reporter, parse

NAMES = ("a.png", "b.png", "c.png")


@pytest.fixture
def job(tmp_path):
    """Three small frames and a folder to work in."""
    (tmp_path / "frames").mkdir()
    (tmp_path / "out").mkdir()
    for name in NAMES:
        Image.new("RGB", (64, 48)).save(tmp_path / "frames" / name)
    return MappingJob(
        frames=tmp_path / "frames", out=tmp_path / "out",
        groups=(CameraGroup(NAMES, 64, 48),), masks=None, poses=None,
        pose_use="keep", given_points=False, pairs="auto", max_features=500,
        min_registered=0.5, accept_weak=False, partial=True,
        max_minutes=1.0, seed=0, threads=1,
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
    with raises(FormatError, 1, 3, "b.png"):
        create_database(job)
    assert not job.database.exists()


def test_a_frame_of_another_size_is_named(job):
    Image.new("RGB", (48, 64)).save(job.frames / "c.png")
    with raises(FormatError, "c.png"):
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


def textured(job, **changes):
    """The same job with frames full of keypoints, and its database."""
    for seed, name in enumerate(NAMES):
        write_png(job.frames / name, texture(180, 240, seed))
    group = replace(job.groups[0], width=240, height=180)
    job = replace(job, groups=(group,), **changes)
    create_database(job)
    return job


def test_progress_is_reported_up_to_the_last_pair(job):
    job, stream = textured(job), io.BytesIO()
    extract_features(job, Reporter(io.BytesIO()))
    match_pairs(job, exhaustive_pairs(job.names), Reporter(stream))
    phase, *counts = map(parse, stream.getvalue().splitlines())
    assert (phase.done, phase.total) == (0, 3)
    assert counts == [1, 2, 3]


def look_alike(counts, seed=0):
    """Descriptors [K, 128] of images that show the same things, with noise, in another order."""
    noise = np.random.default_rng(seed)
    things = noise.gamma(0.5, 20, (max(counts), 128))
    images = [things[noise.permutation(max(counts))[:count]] for count in counts]
    return [np.clip(512 * rows / np.linalg.norm(rows, axis=1, keepdims=True), 0, 255).astype(
        np.uint8) for rows in (each + noise.gamma(0.5, 12, each.shape) for each in images)]


def match_by_definition(ours, theirs):
    """Matches of one row after the other, in whole numbers."""
    products = ours.astype(np.int64) @ theirs.T.astype(np.int64)
    angles = np.arccos(np.minimum(products / 512**2, 1))
    matches = []
    for row in range(len(ours) if len(theirs) else 0):
        column = int(angles[row].argmin())
        angle = angles[row, column]
        others = [*np.delete(angles[row], column), *np.delete(angles[:, column], row), np.pi / 2]
        if angle <= 0.7 and angle == angles[:, column].min() and angle < 0.8 * min(others):
            matches.append((row, column))
    return np.array(matches, np.uint32).reshape(-1, 2)


@pytest.mark.parametrize("counts", [(90, 70), (70, 90), (40, 1), (1, 1), (0, 5), (5, 0)])
@pytest.mark.parametrize("chunk", [16, 1024])
def test_matches_are_those_of_their_definition(counts, chunk, monkeypatch):
    monkeypatch.setattr(matching, "CHUNK", chunk)
    ours, theirs = look_alike(counts)
    found = match_descriptors(ours, theirs)
    np.testing.assert_array_equal(found, match_by_definition(ours, theirs))
    assert found.dtype == np.uint32
    assert len(found) > 30 or min(counts) < 2


def test_two_equal_descriptors_are_no_match_of_a_third():
    ours, theirs = look_alike((60, 60))
    (row, column), *_ = match_descriptors(ours, theirs)
    assert (row, column) not in match_descriptors(np.concatenate([ours, ours[[row]]]), theirs)
    assert row not in match_descriptors(ours, np.concatenate([theirs, theirs[[column]]]))[:, 0]


@pytest.mark.integration
def test_the_matches_are_those_of_colmaps_brute_force(job):
    job = textured(job)
    for seed, name in enumerate(NAMES):  # the same texture, moved
        write_png(job.frames / name, np.roll(texture(180, 240, 0), 9 * seed, axis=1))
    extract_features(job, Reporter(io.BytesIO()))
    match_pairs(job, exhaustive_pairs(NAMES), Reporter(io.BytesIO()))
    ours = read_matches(job)
    with pycolmap.Database.open(job.database) as opened:
        opened.clear_matches()
        opened.clear_two_view_geometries()
    options = pycolmap.FeatureMatchingOptions()
    options.sift.cpu_brute_force_matcher = True
    pycolmap.match_exhaustive(job.database, options)
    theirs = read_matches(job)
    assert min(map(len, ours)) > 30
    for found, expected in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(found, expected)


def read_matches(job):
    with pycolmap.Database.open(job.database) as opened:
        return [opened.read_matches(*pair) for pair in ((1, 2), (1, 3), (2, 3))]


def test_a_pair_whose_numbers_are_not_in_the_order_of_its_names_is_turned_round(tmp_path):
    geometry = pycolmap.TwoViewGeometry()
    geometry.inlier_matches = np.array([[row, row + 100] for row in range(60)], np.uint32)
    geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
    with pycolmap.Database.open(tmp_path / "database.db") as opened:
        camera = opened.write_camera(pycolmap.Camera.create_from_model_name(
            1, "PINHOLE", 100.0, 64, 48))
        ids = [opened.write_image(pycolmap.Image(name=name, camera_id=camera))
               for name in ("b.png", "a.png")]
        opened.write_two_view_geometry(*ids, geometry)
    ((names, found),) = read_verified(tmp_path / "database.db").items()
    assert names == ("a.png", "b.png")
    assert found.inlier_matches[:, 0].min() == 100
    assert found.inlier_matches[:, 1].max() == 59


@pytest.mark.parametrize("threads", [2, 3])
def test_any_number_of_threads_writes_the_same_rows(job, threads):
    job = textured(job)
    extract_features(job, Reporter(io.BytesIO()))
    tables = []
    for count in (1, threads):
        database.clear_matches(job.database)
        match_pairs(replace(job, threads=count), exhaustive_pairs(NAMES), Reporter(io.BytesIO()))
        with closing(sqlite3.connect(job.database)) as connection:
            tables.append([connection.execute(f"SELECT * FROM {table}").fetchall()
                           for table in ("matches", "two_view_geometries")])
    assert tables[0] == tables[1]
    assert [len(rows) for rows in tables[0]] == [3, 3]


def names(count):
    return [f"{index:06d}.png" for index in range(count)]


def test_all_pairs_of_a_hundred_images_are_4950():
    assert len(exhaustive_pairs(names(100))) == 4950


def test_a_pair_is_named_in_order():
    assert exhaustive_pairs(["b", "c", "a"]) == {("a", "b"), ("a", "c"), ("b", "c")}


def test_sequential_pairs_are_neighbours_and_powers_of_two():
    # 20 images: 19 + 18 + ... + 10 neighbours at 1 to 10, and 4 pairs that are 16 apart.
    found = sequential_pairs(names(20))
    assert len(found) == sum(range(10, 20)) + 4
    assert ("000000.png", "000016.png") in found
    assert ("000000.png", "000011.png") not in found


def test_two_images_are_one_pair():
    assert sequential_pairs(["b", "a"]) == exhaustive_pairs(["a", "b"]) == {("a", "b")}


GROUPS, EACH = 4, 5


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    """Twenty images of four places: each place has its own kinds of descriptors."""
    noise = np.random.default_rng(0)
    path = tmp_path_factory.mktemp("retrieval") / "database.db"
    kinds = noise.integers(0, 256, (GROUPS, 30, 128))
    with pycolmap.Database.open(path) as opened:
        camera = opened.write_camera(pycolmap.Camera(
            model="PINHOLE", width=8, height=6, params=[5, 5, 4, 3]))
        for index in range(GROUPS * EACH):
            image = opened.write_image(pycolmap.Image(name=f"{index:02d}.png", camera_id=camera))
            rows = kinds[index % GROUPS][noise.integers(0, 30, 200)]
            rows = np.clip(rows + noise.normal(scale=10, size=rows.shape), 0, 255)
            opened.write_keypoints(image, noise.random((200, 6)).astype(np.float32))
            opened.write_descriptors(image, pycolmap.FeatureDescriptors(
                type=pycolmap.FeatureExtractorType.SIFT, data=rows.astype(np.uint8)))
        bare = opened.write_image(pycolmap.Image(name="bare.png", camera_id=camera))
        opened.write_keypoints(bare, np.zeros((0, 6), np.float32))
        opened.write_descriptors(bare, pycolmap.FeatureDescriptors(
            type=pycolmap.FeatureExtractorType.SIFT, data=np.zeros((0, 128), np.uint8)))
    return path


PLACES = [f"{index:02d}.png" for index in range(GROUPS * EACH)]


def test_images_of_one_place_are_paired(places):
    pairs = similar_pairs(places, PLACES, seed=0, nearest=EACH - 1)
    assert pairs == {
        (name, other) for name in PLACES for other in PLACES
        if name < other and int(name[:2]) % GROUPS == int(other[:2]) % GROUPS}


def test_pairs_that_are_known_make_room_for_others(places):
    known = {("00.png", "04.png"), ("00.png", "08.png")}
    pairs = similar_pairs(places, PLACES, seed=0, nearest=2, besides=known)
    assert not pairs & known
    assert {("00.png", "12.png"), ("00.png", "16.png")} <= pairs


def test_where_all_pairs_are_known_nothing_is_left(places):
    assert similar_pairs(places, PLACES, seed=0, besides=exhaustive_pairs(PLACES)) == set()


def test_the_same_pairs_come_out_every_time(places):
    assert similar_pairs(places, PLACES, seed=3) == similar_pairs(places, PLACES[::-1], seed=3)


def test_an_image_without_features_does_no_harm(places):
    pairs = similar_pairs(places, [*PLACES, "bare.png"], seed=0, nearest=EACH - 1)
    assert pairs >= similar_pairs(places, PLACES, seed=0, nearest=EACH - 1) - {
        pair for pair in pairs if "bare.png" in pair}
