"""A skeleton from tracks, and which pairs of frames agree with it."""

import io
import shutil
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from made_model import HEIGHT, WIDTH, MadeModel, along, moved, wall

from recon_cli.io.tracks import Tracks
from recon_cli.sfm import database
from recon_cli.sfm.features import matching
from recon_cli.sfm.features.matching import read_verified
from recon_cli.sfm.features.pair_checks import check_pairs, list_models
from recon_cli.sfm.job import CameraGroup, MappingJob, Phase, Reporter, parse
from recon_cli.sfm.mapping import mapper, skeleton
from recon_cli.sfm.mapping.skeleton import (
    build_beside,
    build_skeleton,
    choose_coarse_pairs,
    complete_coarse,
    complete_tracked,
    copy_coarsest,
    is_continuous,
    list_keyframes,
    near_pairs,
    write_usable_matches,
)
from recon_cli.sfm.segments.view_overlap import WIDEST, overlapping_images, overlapping_pairs
from recon_cli.sfm.verdict.evidence import gather_evidence

SILENT = Reporter(io.BytesIO())


def make_tracks(made, reach=6, breaks=()):
    """What a tracker would see: each point for `reach` frames, and nothing across a break."""
    image, track, xy, numbers = [], [], [], {}
    for index in range(len(made.poses)):
        points, places = made._seen(index)
        stretch = sum(index >= start for start in breaks)
        rows = []
        for point, place in zip(points.tolist(), places, strict=True):
            number = numbers.setdefault((point, stretch, index // reach), len(numbers))
            rows.append((number, place))
            if index % reach >= reach // 2:  # the next ones begin before these end
                rows.append((numbers.setdefault(
                    (point, stretch, index // reach + 1), len(numbers)), place))
        for number, place in sorted(rows, key=lambda row: row[0]):
            image.append(index)
            track.append(number)
            xy.append(place / [WIDTH, HEIGHT])
    return Tracks(tuple(made.names), np.array(image, np.int32), np.array(track, np.int32),
                  np.array(xy, np.float32))


def make_job(folder, made, tracks=None):
    """A job whose database holds the matches of a made model."""
    if tracks is not None:
        tracks.write(folder / "tracks.safetensors")
    made.write_database(folder / "database.db")
    with pycolmap.Database.open(folder / "database.db") as opened:
        for index in range(1, len(made.names) + 1):
            places = opened.read_keypoints(index)
            shaped = np.zeros((len(places), 6), np.float32)
            shaped[:, :2], shaped[:, 2], shaped[:, 5] = places, 2, 2
            opened.update_keypoints(index, shaped)
    (folder / "rungs").mkdir()
    return MappingJob(
        frames=folder, out=folder,
        groups=(CameraGroup(tuple(made.names), WIDTH, HEIGHT),), masks=None, poses=None,
        pose_use="keep", given_points=False,
        tracks=None if tracks is None else folder / "tracks.safetensors", pairs="auto",
        max_features=2000, min_registered=0.5, accept_weak=False, partial=True,
        max_minutes=5.0, seed=0, threads=1, sharpness={}, times={})


def linked(job):
    return replace(job, matches_db=job.out / skeleton.MATCHES_DB)


def walk(count=16, step=0.5, **changes):
    """Cameras along a wall with depth, so that parallax tells their places."""
    points = wall(-4, 4 + count * step, count=60 * count)
    points[:, 2] += np.random.default_rng(1).uniform(-1.5, 1.5, len(points))
    return MadeModel(points, along(np.arange(count) * step), **changes)


def errors(model, made):
    """The worst error of a distance from each camera to another, at the best scale."""
    images = {model.image(i).name: model.image(i) for i in model.reg_image_ids()}
    found = np.array([images[name].projection_center() for name in sorted(images)])
    rows = [made.names.index(name) for name in sorted(images)]
    truth = np.array([made.poses[row].inverse().translation for row in rows])
    # Cameras on a line fix no similarity: all distances between them are compared.
    ours, true = (np.linalg.norm(places[:, None] - places, axis=2) for places in (found, truth))
    return np.abs(ours * (true * ours).sum() / (ours**2).sum() - true).max(axis=0)


def test_a_video_is_continuous_where_its_frames_share_tracks(tmp_path):
    made = walk()
    job = make_job(tmp_path, made, make_tracks(made))
    assert is_continuous(job)
    assert not is_continuous(replace(job, tracks=None))
    make_tracks(made, breaks=range(1, 16, 2)).write(tmp_path / "tracks.safetensors")
    assert not is_continuous(job)


def test_near_frames_are_paired_within_a_camera_alone():
    groups = (CameraGroup(("a", "b", "c"), 10, 10), CameraGroup(("d", "e"), 10, 10))
    assert near_pairs(replace_groups(groups), 1) == {("a", "b"), ("b", "c"), ("d", "e")}
    assert near_pairs(replace_groups(groups), 5) == {
        ("a", "b"), ("b", "c"), ("a", "c"), ("d", "e")}
    assert near_pairs(replace_groups(groups), 1, ("a", "c", "d")) == {("a", "c")}


def replace_groups(groups):
    class Job:
        pass

    job = Job()
    job.groups = groups
    job.names = [name for group in groups for name in group.names]
    return job


def test_views_of_one_surface_overlap_and_those_of_others_do_not():
    made = walk(30)
    pairs = overlapping_pairs(made.model())
    gaps = [made.names.index(second) - made.names.index(first) for first, second in pairs]
    assert {1, 2, 3, 4, 5} <= set(gaps)
    # At a distance of 5 a view is 7.5 wide: those 6 apart have nothing in common.
    assert max(gaps) < 15
    backwards = MadeModel(made.points, [moved(0, 0, 0, 180) * pose for pose in made.poses])
    assert overlapping_pairs(backwards.model()) == set()


def test_known_pairs_that_overlap_take_the_place_of_others():
    model = walk(12).model()
    images = [model.image(number) for number in model.reg_image_ids()]
    models = [model] * len(images)
    held = {image.name: {index % 3} for index, image in enumerate(images)}
    one_each = overlapping_images(images, models, held, most=1)
    assert 6 <= len(one_each) <= 12
    assert all(held[first].isdisjoint(held[second]) for first, second in one_each)
    assert overlapping_images(images, models, held, most=1, besides=one_each) == set()
    two_each = overlapping_images(images, models, held, most=2, besides=one_each)
    assert two_each
    assert not two_each & one_each


@pytest.mark.integration
def test_known_pairs_that_cannot_see_the_same_take_no_place():
    model = walk(30).model()
    images = sorted((model.image(number) for number in model.reg_image_ids()),
                    key=lambda image: image.name)
    ends = images[0].name, images[-1].name
    models = [model] * len(images)
    assert ends not in overlapping_pairs(model)
    assert overlapping_images(images, models, most=1, besides={ends}) == overlapping_images(
        images, models, most=1)
    # a pair that does see the same takes the only place of both
    near = images[0].name, images[1].name
    assert near in overlapping_images(images, models, most=1)
    others = overlapping_images(images, models, most=1, besides={near})
    assert not any(images[0].name in pair for pair in others)


def test_pairs_are_read_in_order_of_their_names(tmp_path):
    made = walk(6)
    path = made.write_database(tmp_path / "database.db")
    verified = read_verified(path)
    assert len(verified) == 15
    assert all(first < second for first, second in verified)


def test_observations_of_tracks_follow_the_features_of_an_image(tmp_path):
    made = walk(6)
    tracks = make_tracks(made)
    job = make_job(tmp_path, made, tracks)
    few = {pair: geometry for pair, geometry in read_verified(job.database).items()
           if pair == (made.names[0], made.names[1])}
    write_usable_matches(linked(job), job.database, few, tracks, range(6))
    with pycolmap.Database.open(job.out / skeleton.MATCHES_DB) as opened:
        features = len(made._seen(0)[0])
        keypoints = opened.read_keypoints(1)
        own = tracks.xy[tracks.image == 0] * [WIDTH, HEIGHT]
        np.testing.assert_allclose(keypoints[features:, :2], own, atol=1e-3)
        # Enough features match between 0 and 1: tracks, which are less exact, are left out.
        assert opened.read_matches(1, 2)[:, 0].max() < features
        rows = opened.read_matches(1, 3)
        assert rows.min() >= min(features, len(made._seen(2)[0]))
        first, _ = tracks.matches(0, 2)
        assert len(rows) == len(first)
        assert opened.read_two_view_geometry(1, 3).inlier_matches.shape[0] > 0.9 * len(first)


def test_pairs_that_were_matched_in_vain_are_remembered(tmp_path):
    made = walk(6)
    tracks = make_tracks(made)
    job = make_job(tmp_path, made, tracks)
    geometries = read_verified(job.database)
    dropped = made.names[0], made.names[4]  # tracks are matched 1, 2, 3, 5, ... apart
    kept = {pair: geometry for pair, geometry in geometries.items() if pair != dropped}
    write_usable_matches(linked(job), job.database, kept, tracks, range(6))
    assert set(read_verified(linked(job).database)) == set(kept)
    with pycolmap.Database.open(linked(job).database) as opened:
        assert opened.exists_matches(1, 5)
        assert len(opened.read_matches(1, 5)) == 0
    evidence = gather_evidence(made.model(), linked(job).database, made.names)
    assert evidence.tried[0, 4]


@pytest.mark.integration
def test_pairs_that_look_alike_contradict_the_cameras(tmp_path):
    made = walk()
    job = make_job(tmp_path, made)
    model = made.model()
    geometries = read_verified(job.database)
    checked = check_pairs(job.database, list_models([model]), geometries)
    assert checked.agreeing == set(geometries)
    turned = walk(motions=dict.fromkeys(range(8, 16), moved(1, 0, 0, 40))).model()
    checked = check_pairs(job.database, list_models([turned]), geometries)
    across = {pair for pair in geometries if pair[0] < made.names[8] <= pair[1]}
    assert len(across - checked.contradicting) <= 1  # a turn about the vertical may fit a pair
    assert checked.contradicting <= across
    assert set(geometries) - across <= checked.agreeing


@pytest.mark.integration
def test_pairs_that_a_drift_explains_are_kept_apart(tmp_path):
    made = walk()
    job = make_job(tmp_path, made)
    geometries = read_verified(job.database)
    bent = walk(motions=dict.fromkeys(range(8, 16), moved(0, 0.35, 0, 3))).model()
    checked = check_pairs(job.database, list_models([bent]), geometries)
    across = {pair for pair in geometries if pair[0] < made.names[8] <= pair[1]}
    assert len(checked.drifted) > 0.6 * len(across)
    assert checked.drifted <= across


@pytest.mark.integration
def test_a_single_pair_closes_no_loop(tmp_path):
    made = walk()
    job = make_job(tmp_path, made)
    bent = walk(motions=dict.fromkeys(range(8, 16), moved(0, 0.35, 0, 3))).model()
    pair = made.names[5], made.names[9]
    geometries = read_verified(job.database)
    assert pair in check_pairs(job.database, list_models([bent]), geometries).drifted
    lonely = check_pairs(job.database, list_models([bent]), {pair: geometries[pair]})
    assert lonely.contradicting == {pair}


def test_images_of_different_models_are_no_contradiction(tmp_path):
    made = walk()
    job = make_job(tmp_path, made)
    halves = [walk(unregistered=frozenset(range(8))).model(),
              walk(unregistered=frozenset(range(8, 16))).model()]
    geometries = read_verified(job.database)
    checked = check_pairs(job.database, list_models(halves), geometries)
    assert checked.unplaced == {
        pair for pair in geometries if pair[0] < made.names[8] <= pair[1]}


@pytest.fixture
def repeated(tmp_path):
    """A walk along a wall whose end looks like its beginning, with tracks."""
    made = walk(24)
    looks = np.arange(len(made.points))
    first = np.flatnonzero(made.points[:, 0] < 2)
    # The points around x = 12 look like those around x = 0, in the same arrangement.
    points = np.concatenate([made.points[made.points[:, 0] < 9],
                             made.points[first] + [13.0, 0, 0]])
    count = len(points) - len(first)
    looks = np.concatenate([np.arange(count), np.zeros(len(first), int)])
    place = np.full(len(made.points), -1)
    place[made.points[:, 0] < 9] = np.arange(count)
    looks[count:] = place[first]
    alike = MadeModel(points, made.poses, looks=looks)
    return alike, make_job(tmp_path, alike, make_tracks(alike))


@pytest.mark.integration
def test_cameras_from_tracks_are_counted_whether_built_first_or_beside_features(tmp_path):
    job = make_job(tmp_path, walk(), make_tracks(walk()))
    stream = io.BytesIO()
    skeleton.load_skeleton(job, Reporter(stream))
    shutil.rmtree(job.attempts)
    alone = [parse(line) for line in stream.getvalue().splitlines()]
    assert [event for event in alone if isinstance(event, Phase)] == [
        Phase("skeleton", len(list_keyframes(job)), 0)]
    assert max(event for event in alone if isinstance(event, int)) == len(list_keyframes(job))
    stream = io.BytesIO()
    with build_beside(job, Reporter(stream)):
        assert not stream.getvalue()
    for line in stream.getvalue().splitlines():
        assert isinstance(parse(line), Phase | int)


@pytest.mark.integration
def test_tracks_place_what_looks_alike_where_it_is(repeated):
    made, job = repeated
    models = build_skeleton(job, job.database, SILENT)
    assert [model.num_reg_images() for model in models] == [24]
    assert errors(models[0], made).max() < 0.2
    checked = check_pairs(job.database, list_models(models), read_verified(job.database))
    alike = {pair for pair in read_verified(job.database)
             if made.names.index(pair[1]) - made.names.index(pair[0]) > 17}
    assert alike
    assert not alike & checked.agreeing


@pytest.mark.integration
def test_a_model_is_completed_without_what_only_looks_alike(repeated):
    made, job = repeated
    (folder := job.attempts / skeleton.SKELETON / "0").mkdir(parents=True)
    build_skeleton(job, job.database, SILENT)[0].write(folder)
    models = complete_tracked(linked(job), SILENT)
    assert [model.num_reg_images() for model in models] == [24]
    assert errors(models[0], made).max() < 0.02


@pytest.mark.integration
def test_models_that_tracks_leave_apart_are_joined_by_matches(tmp_path, monkeypatch):
    made = walk()
    # No mapper places by tracks what they do not tie together.
    monkeypatch.setattr(mapper, "map_globally", lambda *_: pytest.fail("was asked"))
    tracks = make_tracks(made, breaks=[8])
    job = make_job(tmp_path, made, tracks)
    models = build_skeleton(job, job.database, SILENT)
    assert sorted(model.num_reg_images() for model in models) == [8, 8]
    for index, model in enumerate(models):
        (job.attempts / skeleton.SKELETON / str(index)).mkdir(parents=True)
        model.write(job.attempts / skeleton.SKELETON / str(index))
    completed = complete_tracked(linked(job), SILENT)
    assert [model.num_reg_images() for model in completed] == [16]
    assert errors(completed[0], made).max() < 0.02


def make_photos(folder, made):
    """A job whose database holds features, those of one point alike in all images, and no match."""
    job = make_job(folder, made)
    looks = np.random.default_rng(3).random((len(made.points), 128))
    looks *= 512 / np.linalg.norm(looks, axis=1, keepdims=True)  # as long as SIFT's
    with pycolmap.Database.open(job.database) as opened:
        opened.clear_matches()
        opened.clear_two_view_geometries()
        for index in range(len(made.names)):
            opened.write_descriptors(index + 1, pycolmap.FeatureDescriptors(
                pycolmap.FeatureExtractorType.SIFT, looks[made._seen(index)[0]].astype(np.uint8)))
    return job


def features(path):
    """Keypoints and descriptors of each image."""
    with pycolmap.Database.open(path) as opened:
        return [(np.asarray(opened.read_keypoints(image.image_id)),
                 np.asarray(opened.read_descriptors(image.image_id).data))
                for image in opened.read_all_images()]


def test_the_coarsest_features_are_copied_and_no_matches(tmp_path, monkeypatch):
    monkeypatch.setattr(skeleton, "COARSEST", 17)
    job = make_photos(tmp_path, walk(6))
    matching.match_pairs(job, [("000000.png", "000001.png")], SILENT)
    copy_coarsest(job.database, tmp_path / "coarse.db")
    for before, after in zip(
            features(job.database), features(tmp_path / "coarse.db"), strict=True):
        for rows, first in zip(before, after, strict=True):
            assert len(rows) > 17
            np.testing.assert_array_equal(first, rows[:17])
    assert len(read_verified(job.database)) == 1
    assert not database.pair_names(tmp_path / "coarse.db")
    with pycolmap.Database.open(tmp_path / "coarse.db") as opened:
        assert not opened.num_matched_image_pairs()


@pytest.mark.slow
def test_photos_that_overlap_by_their_coarsest_features_are_matched_in_full(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(skeleton, "COARSEST", 120)
    monkeypatch.setattr(skeleton, "SIMILAR", 0)
    made = walk(36)
    job = make_photos(tmp_path, made)
    (job.attempts / f"{skeleton.COARSE_SKELETON}.mapping").mkdir()  # what a killed run left
    (job.attempts / f"{skeleton.COARSE_SKELETON}.found" / "0").mkdir(parents=True)
    pairs = choose_coarse_pairs(job, SILENT)
    gaps = [made.names.index(second) - made.names.index(first) for first, second in pairs]
    assert min(np.bincount([made.names.index(name) for pair in pairs for name in pair])) >= 5
    assert max(gaps) < 15  # those of 630 pairs that see the same
    assert not database.pair_names(job.database)
    # What was found is not found again.
    monkeypatch.setattr(skeleton, "build_coarse_skeleton", lambda *_: pytest.fail("built again"))
    assert choose_coarse_pairs(job, SILENT) == pairs
    matching.match_pairs(job, pairs, SILENT)
    model, = complete_coarse(job, SILENT)
    assert model.num_reg_images() == 36
    assert errors(model, made).max() < 0.02
    seen = [point.point2D_idx for found in model.points3D.values()
            for point in found.track.elements]
    assert max(seen) > 150


@pytest.mark.integration
def test_photos_are_mapped_from_their_matches_where_coarse_features_place_too_few(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(skeleton, "COARSEST", 10)  # fewer than a pair needs
    monkeypatch.setattr(skeleton, "SIMILAR", 6)
    made = walk()
    job = make_photos(tmp_path, made)
    pairs = choose_coarse_pairs(job, SILENT)
    assert len(pairs) >= 3 * len(made.names)  # as many as look alike
    matching.match_pairs(job, pairs, SILENT)
    model, = complete_coarse(job, SILENT)
    assert model.num_reg_images() == 16
    assert errors(model, made).max() < 0.02


@pytest.mark.integration
def test_a_photo_without_features_hinders_no_other(tmp_path, monkeypatch):
    monkeypatch.setattr(skeleton, "COARSEST", 120)
    job = make_photos(tmp_path, walk(12))
    with pycolmap.Database.open(job.database) as opened:
        kept = {image.image_id: opened.read_descriptors(image.image_id)
                for image in opened.read_all_images()}
        kept[6] = pycolmap.FeatureDescriptors(
            pycolmap.FeatureExtractorType.SIFT, np.zeros((0, 128), np.uint8))
        opened.clear_descriptors()
        opened.update_keypoints(6, np.zeros((0, 6), np.float32))
        for number, rows in kept.items():
            opened.write_descriptors(number, rows)
    matching.match_pairs(job, choose_coarse_pairs(job, SILENT), SILENT)
    model, = complete_coarse(job, SILENT)
    assert model.num_reg_images() == 11


def test_what_looks_alike_is_matched_where_the_models_do_not_show_it_to_overlap(
    tmp_path, monkeypatch
):
    made = walk(12, step=1.0)  # from one end to the other nothing is seen twice
    job = make_photos(tmp_path, made)
    first, last = made.names[0], made.names[-1]
    overlap = overlapping_pairs(made.model(), WIDEST)
    chosen = set(sorted(overlap)[::2])
    monkeypatch.setattr(skeleton, "similar_pairs", lambda *_, besides, **__: (
        {(first, last)} | overlap) - set(besides))
    assert skeleton._unexpected_pairs(job, [made.model()], chosen, job.names) == {(first, last)}
    assert skeleton._unexpected_pairs(job, [], chosen, job.names) == (
        {(first, last)} | overlap - chosen)
