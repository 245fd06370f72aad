import io
from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest
from facts import assert_facts
from synthetic import center_error, make_capture, part

from recon_cli.sfm import database
from recon_cli.sfm.features import bridge, matching, xfeat_weights
from recon_cli.sfm.features.bridge import PhotoFeatures, find_bridge, match_rows, match_sift
from recon_cli.sfm.features.xfeat import DESCRIPTOR_STEPS, LearnedFeatures
from recon_cli.sfm.job import Reporter, parse
from recon_cli.sfm.mapping import fallbacks, mapper

NONE = np.zeros((0, 2), np.int64)
FOCAL, WIDTH, HEIGHT = 500.0, 640, 480


def learned_rows(generator, count):
    rows = generator.normal(size=(count, 64))
    rows *= DESCRIPTOR_STEPS / np.linalg.norm(rows, axis=1, keepdims=True)
    return np.rint(rows).astype(np.float32)


def sift_rows(generator, count):
    root = np.sqrt(generator.dirichlet(np.full(128, 0.3), count))
    return np.rint(512 * root).clip(0, 255).astype(np.float32)


def project(points, turn_deg, shift):
    """Pixels [N, 2] of points in a camera that was moved and turned about its vertical axis."""
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    seen = (points - shift) @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]).T
    return FOCAL * seen[:, :2] / seen[:, 2:] + [WIDTH / 2, HEIGHT / 2]


class Pair:
    """Two photos of points: some with learned features, others with SIFT's, the rest alone."""

    def __init__(self, *, learned=80, sift=20, alone=200, seed=0):
        self.generator = generator = np.random.default_rng(seed)
        self.points = generator.uniform([-2, -1.5, 3], [2, 1.5, 6], (learned + sift, 3))
        self.learned = slice(0, learned)
        self.sift = slice(learned, learned + sift)
        self.alone = alone
        self.own = learned_rows(generator, learned), sift_rows(generator, sift)

    def photo(self, turn_deg, shift, points=None):
        xy = project(self.points if points is None else points, turn_deg, np.array(shift))
        camera = pycolmap.Camera.create_from_model_name(1, "OPENCV", 600, WIDTH, HEIGHT)
        return PhotoFeatures(
            1, camera, np.concatenate([xy[self.sift], self._anywhere()]),
            np.concatenate([self.own[1], sift_rows(self.generator, self.alone)]),
            LearnedFeatures(
                np.concatenate([xy[self.learned], self._anywhere()]),
                np.concatenate([self.own[0], learned_rows(self.generator, self.alone)])))

    def _anywhere(self):
        return self.generator.uniform(0, [WIDTH, HEIGHT], (self.alone, 2))


def find(first, second, known=NONE):
    return find_bridge(first, second, known, seed=0)


def test_a_pair_on_which_both_kinds_of_features_agree_is_bridged():
    pair = Pair()
    first, second = pair.photo(0, (0, 0, 0)), pair.photo(12, (1, 0.1, 0.2))
    found = find(first, second)
    rows = found.inlier_matches.astype(int)
    start = len(first.xy)
    sift, learned = rows[rows[:, 0] < start], rows[rows[:, 0] >= start] - start
    assert (sift[:, 0] == sift[:, 1]).all()
    assert len(sift) == 20  # all that there are
    assert (learned[:, 0] == learned[:, 1]).all()
    assert len(learned) >= 75


def test_known_matches_stay_and_no_keypoint_has_two():
    pair = Pair(sift=40)
    first, second = pair.photo(0, (0, 0, 0)), pair.photo(12, (1, 0.1, 0.2))
    known = np.repeat(np.arange(15, 30)[:, None], 2, axis=1)
    rows = find(first, second, known).inlier_matches.astype(int)
    assert {tuple(row) for row in known.tolist()} <= {tuple(row) for row in rows.tolist()}
    for side in (0, 1):
        assert len(np.unique(rows[:, side])) == len(rows)


def test_two_places_that_only_learned_features_confuse_are_refused():
    # As of two lockers: what XFeat matches moves as one, and what SIFT matches does not.
    pair = Pair(sift=40)
    moved = pair.points.copy()
    moved[pair.sift] = pair.generator.uniform([-2, -1.5, 3], [2, 1.5, 6], (40, 3))
    first = pair.photo(0, (0, 0, 0))
    assert find(first, pair.photo(12, (1, 0.1, 0.2))) is not None
    assert find(first, pair.photo(12, (1, 0.1, 0.2), moved)) is None


@pytest.mark.parametrize("few", [
    {"sift": bridge.MIN_AGREEING[0] - 1}, {"learned": bridge.MIN_POSE_INLIERS - 5}])
def test_too_few_features_that_agree_are_no_bridge(few):
    pair = Pair(**few)
    assert find(pair.photo(0, (0, 0, 0)), pair.photo(12, (1, 0.1, 0.2))) is None


def test_learned_matches_of_which_few_agree_are_no_bridge():
    pair = Pair(learned=160, sift=40)
    moved = pair.points.copy()
    moved[:120] = pair.generator.uniform([-2, -1.5, 3], [2, 1.5, 6], (120, 3))
    assert find(pair.photo(0, (0, 0, 0)), pair.photo(12, (1, 0.1, 0.2), moved)) is None


@pytest.mark.integration
def test_sift_is_matched_as_colmap_does(tmp_path):
    job, _ = make_capture(tmp_path, frames=3, points=50)
    generator = np.random.default_rng(0)
    first = sift_rows(generator, 300)
    noisy = np.abs(first + generator.normal(0, 18, first.shape)).clip(0, 255).round()
    second = np.concatenate([noisy[::-1][:250], sift_rows(generator, 50)]).astype(np.float32)
    with pycolmap.Database.open(job.database) as opened:
        for table in ("matches", "two_view_geometries", "descriptors", "keypoints"):
            getattr(opened, f"clear_{table}")()
        for number, rows in ((1, first), (2, second)):
            opened.write_keypoints(number, generator.uniform(0, 600, (300, 6)).astype(np.float32))
            opened.write_descriptors(number, pycolmap.FeatureDescriptors(
                pycolmap.FeatureExtractorType.SIFT, rows.astype(np.uint8)))
        images = {image.image_id: image.name for image in opened.read_all_images()}
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads, options.sift.cpu_brute_force_matcher = 1, True
    listed = tmp_path / "pairs.txt"
    listed.write_text(f"{images[1]} {images[2]}\n")
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = listed
    pycolmap.match_image_pairs(job.database, options, pairing, device=pycolmap.Device.cpu)
    with pycolmap.Database.open(job.database) as opened:
        expected = {tuple(row) for row in opened.read_matches(1, 2).tolist()}
    assert len(expected) > 50
    assert {tuple(row) for row in match_sift(first @ second.T).tolist()} == expected


def test_of_two_equal_neighbours_none_is_taken():
    similarity = np.array([[9e4, 0, 0], [0, 2.5e5, 2.5e5]], np.float32)
    assert match_rows(similarity, least=1e5, ratio=0.8).tolist() == []
    assert match_rows(similarity[:, :2], least=1e5, ratio=0.8).tolist() == [[1, 1]]


@pytest.fixture
def without_some(tmp_path):
    """Twenty cameras of which the matches tie ten together, and the others to none."""
    job, truth = make_capture(tmp_path, points=150)
    with pycolmap.Database.open(job.database) as opened:
        images = {image.name: image.image_id for image in opened.read_all_images()}
        for first, second in matching.exhaustive_pairs(job.names):
            if first in job.names[10:] or second in job.names[10:]:
                opened.update_two_view_geometry(
                    images[first], images[second], pycolmap.TwoViewGeometry())
    return job, truth


def test_pairs_across_parts_and_of_unplaced_frames_are_asked_where_sift_has_few(without_some):
    job, _ = without_some
    names = job.names
    pairs = bridge.choose_pairs(job, [names[:10], names[10:14]], ())
    placed = {name: index for index, part in enumerate((names[:10], names[10:14])) for name in part}
    assert pairs
    for first, second in pairs:
        assert placed.get(first, first) != placed.get(second, second)
    assert not bridge.choose_pairs(job, [names], ())
    thin = bridge.choose_pairs(job, [names], names[-1:])
    assert thin
    assert all(names[-1] in pair for pair in thin)


@pytest.fixture
def bridges(monkeypatch):
    """Puts the true matches in the place of those that learned features would give."""
    monkeypatch.setattr(xfeat_weights, "are_installed", lambda: True)
    monkeypatch.setattr(xfeat_weights, "load_weights", dict)
    monkeypatch.setattr(bridge, "_read_photos", lambda job, _, names: {
        name: PhotoFeatures(job.names.index(name) + 1, None, None, None, LearnedFeatures(
            np.zeros((0, 2)), np.zeros((0, 64), np.float32))) for name in names})

    def find(job, photos, pairs, _):
        with pycolmap.Database.open(job.database) as opened:
            for pair in sorted(pairs):
                first, second = (photos[name].number for name in pair)
                known = opened.read_matches(first, second)
                geometry = pycolmap.TwoViewGeometry()
                geometry.config, geometry.inlier_matches = 3, known
                geometry.F = np.eye(3)
                yield pair, geometry if len(known) else None

    monkeypatch.setattr(bridge, "_find_bridges", find)


def build(job):
    stream = io.BytesIO()
    result = fallbacks.build_model(job, Reporter(stream))
    return result, [event for line in stream.getvalue().splitlines()
                    if isinstance(event := parse(line), str)]


@pytest.mark.integration
@pytest.mark.usefixtures("bridges")
def test_what_sift_cannot_place_is_bridged_in_a_database_of_its_own(without_some):
    job, truth = without_some
    before = matching.read_verified(job.database).keys()
    result, told = build(job)
    assert [(item.name, item.registered, item.kept) for item in result.attempts] == [
        ("exhaustive", 10, False), ("bridge", 20, True)]
    assert not [text for text in told if xfeat_weights.COMMAND in text]
    assert matching.read_verified(job.database).keys() == before
    assert center_error(pycolmap.Reconstruction(job.model), truth) < 1e-2


@pytest.mark.integration
def test_without_weights_the_command_is_named_and_all_is_as_before(without_some, monkeypatch):
    job, _ = without_some
    monkeypatch.setattr(xfeat_weights, "are_installed", lambda: False)
    result, told = build(job)
    assert [(item.name, item.registered) for item in result.attempts] == [("exhaustive", 10)]
    named = [text for text in told if xfeat_weights.COMMAND in text]
    assert len(named) == 1
    assert_facts(named[0], xfeat_weights.COMMAND, "recon sfm --again")


@pytest.mark.integration
@pytest.mark.usefixtures("bridges")
def test_damaged_weights_are_told_and_not_used(without_some, monkeypatch):
    job, _ = without_some
    monkeypatch.setattr(xfeat_weights, "load_weights", lambda: None)
    result, told = build(job)
    assert [(item.name, item.registered) for item in result.attempts][:2] == [
        ("exhaustive", 10), ("bridge", 0)]
    assert sum(xfeat_weights.COMMAND in text for text in told) == 1


@pytest.mark.integration
@pytest.mark.usefixtures("bridges")
def test_a_bridge_that_makes_nothing_better_leaves_the_old_model(without_some, monkeypatch):
    job, _ = without_some
    monkeypatch.setattr(bridge, "_find_bridges", lambda *_: iter(()))
    result, _ = build(job)
    assert [(item.name, item.kept) for item in result.attempts][:2] == [
        ("exhaustive", True), ("bridge", False)]


@pytest.mark.integration
@pytest.mark.usefixtures("bridges")
def test_bridges_that_place_too_few_are_mapped_again_with_lower_thresholds(
    without_some, monkeypatch
):
    job, truth = without_some
    real, databases = mapper.map_relaxed, []

    def relaxed(job, report):
        databases.append(job.database)
        models = real(job, report)
        if len(databases) == 1:
            raise KeyboardInterrupt
        return models

    monkeypatch.setattr(mapper, "map_relaxed", relaxed)
    find = mapper.map_incrementally
    monkeypatch.setattr(mapper, "map_incrementally", lambda job, report: (
        [part(truth, job.names[:12])] if job.matches_db else find(job, report)))
    with pytest.raises(KeyboardInterrupt):
        build(job)
    assert not job.tried.find_damage()
    result, _ = build(job)
    assert [(item.name, item.registered) for item in result.attempts] == [
        ("exhaustive", 10), ("bridge", 12), ("bridge relaxed", 20)]
    assert databases == [job.attempts / "bridge relaxed" / "linked.db"] * 2
    assert sum(item.kept for item in result.attempts) == 1
    assert result.attempts[2].kept


@pytest.mark.parametrize("change", [
    {"pairs": "exhaustive"}, {"is_segment": True}, {"segments": (("0",), ("1",))}])
def test_segments_and_named_pairs_are_not_bridged(without_some, monkeypatch, change):
    job, _ = without_some
    monkeypatch.setattr(xfeat_weights, "are_installed", lambda: True)
    attempt = fallbacks.MapperAttempt("exhaustive", "")
    report = Reporter(io.BytesIO())
    assert fallbacks._with_bridge(job, [attempt], [], report) is not None
    assert fallbacks._with_bridge(replace(job, **change), [attempt], [], report) is None


def test_a_thin_model_is_bridged_though_nothing_else_is_wrong(without_some, monkeypatch):
    job, _ = without_some
    monkeypatch.setattr(xfeat_weights, "are_installed", lambda: True)
    sound = fallbacks.MapperAttempt(
        "exhaustive", "", registered=job.names, shortfall="", trusted=True, weak_link=1.0,
        reprojection_error_px=0.2)
    report = Reporter(io.BytesIO())
    assert fallbacks._with_bridge(job, [sound], [], report) is None
    thin = replace(sound, thin=job.names[-3:])
    assert fallbacks._with_bridge(job, [thin], [], report) is not None
    bridged = replace(sound, name="bridge", weak_link=0.9, reprojection_error_px=0.4)
    assert fallbacks.best_attempt([thin, bridged]) is bridged
    assert fallbacks.best_attempt([thin, replace(bridged, thin=job.names[-3:])]) is thin
    assert fallbacks.best_attempt([thin, replace(bridged, registered=job.names[:9])]) is thin


def test_images_are_thin_that_few_points_place_which_two_others_show(tmp_path):
    few = fallbacks.FEW_PAIR_MATCHES
    _, firm = make_capture(tmp_path / "firm", frames=12, points=few)
    assert fallbacks.list_thin(firm) == ()
    _, thin = make_capture(tmp_path / "thin", frames=12, points=few - 1)
    assert len(fallbacks.list_thin(thin)) == 12
    names = [image.name for image in firm.images.values()]
    for name in names[:2]:
        image = firm.find_image_with_name(name)
        firm.delete_observation(image.image_id, 0)
        assert fallbacks.list_thin(firm) == (() if name == names[0] else tuple(sorted(names[:2])))


def test_bridges_that_give_no_trusted_model_replace_nothing():
    few = fallbacks.MapperAttempt(
        "exhaustive", "", registered=("a", "b", "c"), trusted=False, weak_link=0.1)
    names = tuple(map(str, range(20)))
    bridged = replace(few, name="bridge", registered=names, weak_link=0.9)
    assert fallbacks.best_attempt([few, bridged]) is few
    assert fallbacks.best_attempt([few, replace(bridged, trusted=True)]).registered == names


@pytest.mark.integration
@pytest.mark.usefixtures("bridges")
def test_a_killed_bridge_gives_the_same_model_when_it_is_run_again(
    without_some, monkeypatch, tmp_path
):
    job, _ = without_some
    finished = tmp_path / "whole"
    database_bytes = job.database.read_bytes()
    build(job)
    (finished).mkdir()
    whole = {path.name: path.read_bytes() for path in job.model.glob("*.bin")}
    job.database.write_bytes(database_bytes)
    for path in sorted(job.parts.rglob("*"), reverse=True):
        path.rmdir() if path.is_dir() else path.unlink()

    def interrupt(*_):
        raise KeyboardInterrupt

    real = mapper.map_incrementally
    monkeypatch.setattr(mapper, "map_incrementally", lambda job, report: (
        interrupt if job.matches_db else real)(job, report))
    with pytest.raises(KeyboardInterrupt):
        build(job)
    assert job.tried.is_finished("exhaustive")
    assert not job.tried.is_finished("bridge")
    own = job.attempts / "bridge" / "linked.db"
    own.write_bytes(own.read_bytes()[:5000])  # and what it left was damaged
    monkeypatch.setattr(mapper, "map_incrementally", real)
    result, _ = build(job)
    assert result.attempts[1].name == "bridge"
    assert result.attempts[1].kept
    assert {path.name: path.read_bytes() for path in job.model.glob("*.bin")} == whole


@pytest.mark.integration
def test_two_photos_are_bridged_by_the_network_itself(learned_network, tmp_path):
    del learned_network  # its weights are where they are looked for
    generator = np.random.default_rng(0)
    job, _ = make_capture(tmp_path, frames=3, points=20)
    job = replace(job, groups=(replace(job.groups[0], width=640, height=480),))
    layers = []
    for depth in (3.0, 4.0, 6.0):
        image = np.zeros((700, 900, 4), np.uint8)
        count = 250 if depth < 6 else 900
        for x, y, w, h in generator.integers([0, 0, 10, 10], [900, 700, 50, 50], (count, 4)):
            colour = (*generator.integers(0, 256, 3).tolist(), 255)
            cv2.rectangle(image, (x, y), (x + w, y + h), colour, -1)
        image[:, :, 3] = np.where(generator.random((14, 18)).repeat(50, 0).repeat(50, 1) < (
            0.25 if depth < 6 else 1.1), image[:, :, 3], 0)
        layers.append((depth, image))
    for name, shift in zip(job.names, (0.0, 0.4, 0.8), strict=True):
        photo = np.full((480, 640, 3), 128, np.uint8)
        for depth, image in reversed(layers):
            move = np.array([[1, 0, -130 - FOCAL * shift / depth], [0, 1, -110]])
            seen = cv2.warpAffine(image, move, (640, 480), flags=cv2.INTER_LINEAR)
            photo = np.where(seen[:, :, 3:] > 127, seen[:, :, :3], photo)
        cv2.imwrite(str(job.frames / name), photo)
    from recon_cli.sfm.features.features import extract_features

    matching.create_database(job)
    extract_features(job, Reporter(io.BytesIO()))
    own = replace(job, matches_db=tmp_path / "own.db")
    bridge.map_bridged(own, Reporter(io.BytesIO()), [], ())
    verified = matching.read_verified(own.database)
    assert set(verified) == matching.exhaustive_pairs(job.names)
    with pycolmap.Database.open(own.database) as opened:
        xy = [opened.read_keypoints(number)[:, :2] for number in (1, 2)]
    rows = verified[job.names[0], job.names[1]].inlier_matches
    moved = (xy[0][rows[:, 0]] - xy[1][rows[:, 1]])
    assert len(rows) > 300
    assert (np.abs(moved[:, 1]) < 2).mean() > 0.95
    steps = FOCAL * 0.4 / np.array([3.0, 4.0, 6.0])
    assert (np.abs(moved[:, :1] - steps).min(axis=1) < 2.5).mean() > 0.9
    assert database.pair_names(job.database) == set()
