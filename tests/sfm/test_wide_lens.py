"""Fisheyes are told from ordinary lenses by matches, and mapped as fisheyes.

In a room of points around the cameras, projected by COLMAP's own models.
"""

import dataclasses
import io
import itertools

import numpy as np
import pycolmap
import pytest
from facts import assert_facts, raises
from synthetic import make_capture

from recon_cli.errors import SfmError
from recon_cli.sfm.features import matching
from recon_cli.sfm.job import CameraGroup, Reporter
from recon_cli.sfm.mapping import fallbacks, mapper, wide_lens

WIDTH, HEIGHT = 1024, 768
FISHEYE = ("OPENCV_FISHEYE", (360.0, 363.0, 518.0, 380.0, 0.03, -0.006, 0.001, -0.0001))
WIDE = ("OPENCV", (620.0, 620.0, 510.0, 386.0, -0.12, 0.02, 0.0, 0.0))  # 79 degrees and a barrel
GROUP = CameraGroup((), WIDTH, HEIGHT)


def camera_of(lens):
    model, params = lens
    return pycolmap.Camera(camera_id=1, model=model, width=WIDTH, height=HEIGHT, params=params)


def walk(count):
    """Poses [4, 4], world to camera, of a walk that looks about."""
    poses = []
    for step in np.linspace(0, 1, count):
        turn = pycolmap.Rotation3d(np.array([0.1 * step, 1.1 * step - 0.5, 0.0])).matrix()
        center = np.array([step - 0.5, 0.1 * np.sin(6 * step), 0.8 * step * (1 - step)])
        poses.append(np.vstack([np.column_stack([turn, -turn @ center]), [0, 0, 0, 1]]))
    return poses


def shots(lens, count, seed=0, points=900):
    """The poses of a walk through points on the walls of a room, and their pixels by number."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (points, 3))
    axis = rng.integers(0, 3, len(points))
    points[np.arange(len(points)), axis] = np.sign(points[np.arange(len(points)), axis])
    points *= [3.0, 1.5, 3.0]
    camera, pictures = camera_of(lens), []
    for pose in walk(count):
        local = points @ pose[:3, :3].T + pose[:3, 3]
        rows = np.flatnonzero(local[:, 2] > 0.15 * np.linalg.norm(local, axis=1))
        pixels = np.array(camera.img_from_cam(local[rows])) + rng.normal(0, 0.3, (len(rows), 2))
        inside = ((pixels > 0) & (pixels < [WIDTH, HEIGHT])).all(axis=1)
        pictures.append(dict(zip(rows[inside].tolist(), pixels[inside], strict=True)))
    return walk(count), pictures


def samples(lens):
    _, pictures = shots(lens, 6)
    found = []
    for one, other in itertools.combinations(pictures, 2):
        both = sorted(one.keys() & other.keys())
        found.append((np.array([one[row] for row in both]), np.array([other[row] for row in both])))
    return found


@pytest.mark.integration
def test_a_fisheye_is_found_with_about_its_focal_length():
    focal = wide_lens._find_focal(GROUP, samples(FISHEYE), seed=0)
    assert focal == pytest.approx(360, rel=0.12)  # steps are a fifth


@pytest.mark.integration
@pytest.mark.parametrize("lens", [
    WIDE, ("SIMPLE_PINHOLE", (900.0, 512.0, 384.0)), ("SIMPLE_PINHOLE", (480.0, 512.0, 384.0))])
def test_an_ordinary_lens_is_none(lens):
    assert wide_lens._find_focal(GROUP, samples(lens), seed=0) is None


@pytest.mark.parametrize(("last", "found"), [(200, True), (175, False)])
def test_a_lens_is_tried_on_as_many_pairs_as_may_change_the_answer(monkeypatch, last, found):
    """An ordinary lens explains 120 of 200 matches, a fisheye 110, and more in the last pair."""
    pairs = [(np.full((200, 2), pair), np.zeros((200, 2))) for pair in range(5)]
    tried = []

    def explain(camera, sample, **_):
        tried.append(camera.model_name)
        if camera.model_name == wide_lens.ORDINARY:
            return 120
        return last if sample[0][0, 0] == 4 else 110

    monkeypatch.setattr(wide_lens, "count_explained", explain)
    focal = wide_lens._find_focal(GROUP, pairs, seed=0)  # 600 of 1,000 against 640 or 615
    assert focal == (wide_lens.FOCALS[0] * WIDTH if found else None)
    monkeypatch.setattr(wide_lens, "count_explained", lambda camera, *_, **__: (
        tried.append(camera.model_name) or 195))
    tried.clear()
    assert wide_lens._find_focal(GROUP, pairs, seed=0) is None
    assert set(tried) == {wide_lens.ORDINARY}  # a fisheye has too little left to gain


def test_few_matches_decide_nothing_unless_the_lens_is_named():
    few = [(ours[:10], theirs[:10]) for ours, theirs in samples(FISHEYE)]
    assert wide_lens._find_focal(GROUP, few, seed=0) is None
    named = dataclasses.replace(GROUP, model="RADIAL_FISHEYE")
    assert wide_lens._find_focal(named, few, seed=0) is not None
    assert wide_lens._camera(named, wide_lens.FISHEYE, 300.0).model_name == "RADIAL_FISHEYE"


def capture_of(folder, lens, count=8, points=900):
    """A job whose database has the matches of a walk, and the true centres [N, 3]."""
    job, _ = make_capture(folder, frames=count)
    poses, pictures = shots(lens, count, points=points)
    with pycolmap.Database.open(job.database) as opened:
        ids = {image.name: image.image_id for image in opened.read_all_images()}
        opened.clear_keypoints()
        opened.clear_matches()
        opened.clear_two_view_geometries()
        order = [ids[name] for name in job.names]
        rows = [sorted(picture) for picture in pictures]
        for number, picture, own in zip(order, pictures, rows, strict=True):
            opened.write_keypoints(
                number, np.array([picture[row] for row in own], np.float32))
        for one, other in itertools.combinations(range(count), 2):
            both = sorted(set(rows[one]) & set(rows[other]))
            opened.write_matches(order[one], order[other], np.array(
                [[rows[one].index(row), rows[other].index(row)] for row in both], np.uint32))
    matching.verify_pairs(job, itertools.combinations(job.names, 2))
    return job, np.array([-pose[:3, :3].T @ pose[:3, 3] for pose in poses])


@pytest.mark.integration
def test_a_fisheye_is_mapped_as_one_and_its_distortion_is_found(tmp_path):
    job, centers = capture_of(tmp_path, FISHEYE)
    result = fallbacks.build_model(job, Reporter(io.BytesIO()))
    (attempt,) = result.attempts
    assert attempt.name == "fisheye"
    assert_facts(attempt.reason, "fisheye")
    model = pycolmap.Reconstruction(job.model)
    assert model.camera(1).model_name == "OPENCV_FISHEYE"
    np.testing.assert_allclose(model.camera(1).params[:4], FISHEYE[1][:4], atol=3)
    found = np.array([model.find_image_with_name(name).projection_center() for name in job.names])
    motion = pycolmap.estimate_sim3d(found, centers).matrix()
    assert np.abs(found @ motion[:, :3].T + motion[:, 3] - centers).max() < 0.005


@pytest.mark.integration
def test_where_the_incremental_mapper_cannot_start_the_global_one_is_asked(tmp_path):
    job, centers = capture_of(tmp_path, FISHEYE, points=60)  # fewer than COLMAP starts from
    job = dataclasses.replace(job, matches_db=job.attempts / "own.db", groups=(
        dataclasses.replace(job.groups[0], model="OPENCV_FISHEYE"),))
    job.attempts.mkdir(exist_ok=True)
    (model,) = wide_lens.map_fisheye(job, Reporter(io.BytesIO()))
    assert mapper.map_incrementally(job, Reporter(io.BytesIO())) == []
    assert mapper.list_registered(model) == list(job.names)
    assert model.camera(1).model_name == "OPENCV_FISHEYE"
    found = np.array([model.find_image_with_name(name).projection_center() for name in job.names])
    motion = pycolmap.estimate_sim3d(found, centers).matrix()
    assert np.abs(found @ motion[:, :3].T + motion[:, 3] - centers).max() < 0.02


@pytest.mark.slow
def test_a_lens_that_the_errors_show_is_mapped_anew(tmp_path, monkeypatch):
    monkeypatch.setattr(wide_lens, "CLEARLY", np.inf)  # its matches pass for an ordinary lens
    job, _ = capture_of(tmp_path, FISHEYE)
    result = fallbacks.build_model(job, Reporter(io.BytesIO()))
    assert [attempt.name for attempt in result.attempts] == ["exhaustive", "lens"]
    assert [attempt.kept for attempt in result.attempts] == [False, True]
    assert "OPENCV_FISHEYE" in result.attempts[1].reason
    model = pycolmap.Reconstruction(job.model)
    assert model.camera(1).model_name == "OPENCV_FISHEYE"
    np.testing.assert_allclose(model.camera(1).params[:4], FISHEYE[1][:4], atol=3)


@pytest.mark.integration
def test_a_lens_that_was_asked_for_wrongly_is_refused_with_the_right_one(tmp_path):
    job, _ = capture_of(tmp_path, FISHEYE)
    job = dataclasses.replace(job, groups=(dataclasses.replace(job.groups[0], model="OPENCV"),))
    with raises(SfmError, "OPENCV", 1) as caught:
        fallbacks.build_model(job, Reporter(io.BytesIO()))
    assert "--camera-model OPENCV_FISHEYE" in caught.value.message
    kept = fallbacks.build_model(dataclasses.replace(job, accept_weak=True),
                                 Reporter(io.BytesIO()))
    assert kept.broken == ()
    assert kept.parts[0].names == job.names


@pytest.mark.integration
def test_an_ordinary_capture_is_mapped_as_before(tmp_path):
    job, _ = capture_of(tmp_path, WIDE)
    ways = fallbacks.list_fallbacks(job)
    report = Reporter(io.BytesIO())
    assert fallbacks._begin_with_fisheye(job, ways, report) is ways
    named = dataclasses.replace(job, groups=(
        dataclasses.replace(job.groups[0], model="OPENCV_FISHEYE"),))
    (way,) = fallbacks._begin_with_fisheye(named, ways, report)
    assert (way.name, way.reason) == ("fisheye", "--camera-model asks for it")


def test_matches_of_a_named_fisheye_are_verified_without_its_focal_length_at_first(tmp_path):
    job, _ = capture_of(tmp_path, FISHEYE, points=60)
    named = dataclasses.replace(job.groups[0], model="OPENCV_FISHEYE")
    assert matching.first_model(job, named) == "OPENCV"
    segment = dataclasses.replace(job, is_segment=True)
    assert matching.first_model(segment, named) == "OPENCV_FISHEYE"
    radial = dataclasses.replace(named, model="RADIAL")
    assert matching.first_model(job, radial) == "RADIAL"
    assert matching.first_model(job, job.groups[0]) == "OPENCV"


@pytest.mark.integration
def test_segments_stay_with_one_model_of_lenses_and_say_so(tmp_path):
    job, _ = capture_of(tmp_path, FISHEYE)
    ways, stream = fallbacks.list_fallbacks(job), io.BytesIO()
    segment = dataclasses.replace(job, is_segment=True)
    assert fallbacks._begin_with_fisheye(segment, ways, Reporter(stream)) is ways
    assert not stream.getvalue()
    joined = dataclasses.replace(job, segments=(job.names[:5], job.names[3:]))
    assert fallbacks._begin_with_fisheye(joined, ways, Reporter(stream)) is ways
    assert b"--segments off" in stream.getvalue()
