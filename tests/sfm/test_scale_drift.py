"""How well the scale of a stretch of a walk is known: against dense algebra, and where it is not.

A camera every half metre along a wall; where the cameras of both halves see nothing in common but
what is far away, neither half says how large the other one is.
"""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pycolmap
import pytest
from made_model import FOCAL, HEIGHT, WIDTH, MadeModel, along, moved, wall
from scipy.spatial.transform import Rotation

from recon_cli.sfm.limits import LOSS_SCALE
from recon_cli.sfm.mapping import mapper
from recon_cli.sfm.verdict.evidence import gather_evidence
from recon_cli.sfm.verdict.scale_drift import (
    MAX_SCALE_ERROR,
    MAX_SCALE_INTERVAL,
    MIN_SURE_EXPLAINED,
    SHARED_ERRORS,
    ScaleCut,
    describe_scale,
    find_weakest_scale,
    is_scale_known,
)

NOISE = 0.3  # pixels


class NoisyModel(MadeModel):
    """A model whose observations are off by noise."""

    def _seen(self, index):
        rows, places = super()._seen(index)
        draws = np.random.default_rng(index).normal(0, NOISE, (len(self.points), 2))
        return rows, places + draws[rows]


def halves(tie: np.ndarray, *, count: int = 24) -> NoisyModel:
    """Cameras of two halves that see a wall each, and both see `tie`, [T, 3]."""
    walls = wall(-3, 15, count=900)
    points = np.concatenate([walls, tie])
    middle = count // 2 * 0.5
    left, right = (np.flatnonzero(side) for side in (walls[:, 0] > middle, walls[:, 0] < middle))
    hidden = {index: left if index < count // 2 else right for index in range(count)}
    return NoisyModel(points, along(np.arange(count) * 0.5), hidden=hidden)


def far(count: int) -> np.ndarray:
    return wall(-40, 50, count=count, seed=3) * [1, 8, 20]


def near(count: int) -> np.ndarray:
    return wall(3, 9, count=count, seed=4)


def weakest(made: MadeModel, *, model=None, ordered: bool = True, **options):
    model = made.model() if model is None else model
    with TemporaryDirectory() as folder:
        database = made.write_database(Path(folder) / "database.db")
        evidence = gather_evidence(model, database, made.names)
    order = np.arange(len(made.names)) if ordered else None
    return find_weakest_scale(model, evidence, order, **options)


@pytest.mark.integration
def test_what_both_halves_see_near_by_ties_their_scales():
    cut = weakest(halves(near(300)))
    assert cut.error < MAX_SCALE_ERROR
    assert is_scale_known(cut)


@pytest.mark.integration
def test_where_only_the_distance_is_seen_from_both_halves_their_scale_is_unknown():
    made = halves(far(60))
    cut = weakest(made)
    assert cut.error > MAX_SCALE_ERROR
    assert not is_scale_known(cut)
    assert abs(made.names.index(cut.after) - 12) <= 2, "the halves meet at frame 12"
    assert sorted(cut.sides[0] + cut.sides[1]) == made.names


@pytest.mark.integration
def test_the_cut_is_searched_between_two_images_where_they_are_named():
    made = halves(far(60))
    cut = weakest(made, between=(made.names[6], made.names[11]))
    assert made.names[6] <= cut.before < cut.after <= made.names[11]


@pytest.mark.integration
def test_photos_without_an_order_are_cut_where_few_points_tie_them():
    made = halves(far(60), count=14)
    cut = weakest(made, ordered=False)
    assert not is_scale_known(cut)
    assert set(cut.sides) == {tuple(made.names[:7]), tuple(made.names[7:])}
    assert is_scale_known(weakest(halves(near(300), count=14), ordered=False))


@pytest.mark.integration
def test_photos_given_twice_have_no_scale_of_their_own():
    twice = np.repeat(np.arange(8) * 0.5, 2) + np.tile([0, 1e-14], 8)
    made = NoisyModel(wall(-3, 6, count=600), along(twice))
    cut = weakest(made, ordered=False)
    assert cut.error < MAX_SCALE_ERROR


def test_pixels_that_a_bent_lens_has_no_direction_for_say_nothing():
    """COLMAP 4.2: what lies beyond the radius where the distortion turns back has no ray, NaN."""
    made = halves(near(300), count=14)
    model = made.model()
    corner = np.hypot(WIDTH, HEIGHT) / 2 / FOCAL
    camera = model.camera(1)
    camera.model = pycolmap.CameraModelId.SIMPLE_RADIAL
    camera.params = [FOCAL, WIDTH / 2, HEIGHT / 2, -4 / 27 / (0.9 * corner) ** 2]
    assert np.isnan(camera.cam_from_img(np.array([[0.5, 0.5]]))).all()
    model.update_point_3d_errors()
    assert np.isfinite(weakest(made, model=model, ordered=False).error)


@pytest.mark.integration
@pytest.mark.parametrize("ordered", [False, True])
def test_a_side_that_collapsed_is_measured_by_itself(ordered):
    """One half shrinks with all that it alone sees; the distance is as it was."""
    made = halves(far(60))
    model = made.model()
    pivot = model.find_image_with_name(made.names[12]).projection_center()
    for name in made.names[12:]:
        image = model.find_image_with_name(name)
        turn = image.cam_from_world().rotation
        center = pivot + (image.projection_center() - pivot) / 2400
        image.frame.rig_from_world = pycolmap.Rigid3d(turn, -(turn.matrix() @ center))
    for number, point in model.points3D.items():
        if all(element.image_id > 12 for element in point.track.elements):
            model.point3D(number).xyz = pivot + (point.xyz - pivot) / 2400
    cut = weakest(made, model=model, ordered=ordered)
    assert not is_scale_known(cut)
    assert cut.error > MAX_SCALE_INTERVAL


@pytest.mark.parametrize("error", [0.06, 0.10, 0.15])
def test_a_scale_that_nothing_contradicts_is_an_interval_and_no_reason_to_cut(error):
    cut = ScaleCut(error, "a", "b", (("a",), ("b",)))
    assert is_scale_known(cut)
    assert f"{error:.0%}" in describe_scale(cut)
    assert cut.spread == error
    assert replace(cut, drift=0.2).spread == 0.2
    assert not is_scale_known(replace(cut, off=0.09)), "the floor says so"
    assert not is_scale_known(replace(cut, explained=0.7)), "matches contradict"
    assert not is_scale_known(replace(cut, error=0.16))


@pytest.mark.integration
def test_the_matches_across_contradict_a_half_of_another_scale():
    made = halves(far(60))
    right = weakest(made)
    model = made.model()
    for name in made.names[12:]:  # moved aside, so that what both see lies elsewhere
        image = model.find_image_with_name(name)
        image.frame.rig_from_world = image.cam_from_world() * moved(0, 0.8, 0)
    assert weakest(made, model=model).explained < MIN_SURE_EXPLAINED <= right.explained


@pytest.mark.integration
@pytest.mark.parametrize("drift", [0.02, 0.05, 0.10])
def test_a_drift_that_observations_leave_is_inside_the_interval(drift):
    """Points are seen from five cameras in a row: nothing else ties the ends of the walk."""
    count = 40
    walls = wall(-3, count * 0.5 + 3, count=60 * count)
    first = np.clip(np.round(walls[:, 0] / 0.5).astype(int) - 2, 0, count - 5)
    hidden = {index: np.flatnonzero((first > index) | (first < index - 4))
              for index in range(count)}
    made = NoisyModel(walls, along(np.arange(count) * 0.5), hidden=hidden)
    model = made.model()
    each = (1 + drift) ** (1 / (count - 1))
    growth = each ** np.arange(count)
    start = np.array([model.image(index + 1).projection_center() for index in range(count)])
    centers = start[0] + np.concatenate([
        np.zeros((1, 3)), np.cumsum(np.diff(start, axis=0) * growth[1:, None], axis=0)])
    for number, point in model.points3D.items():
        row = min(element.image_id for element in point.track.elements) - 1
        model.point3D(number).xyz = centers[row] + growth[row] * (point.xyz - start[row])
    for row in range(count):
        turn = model.image(row + 1).cam_from_world().rotation
        model.image(row + 1).frame.rig_from_world = pycolmap.Rigid3d(
            turn, -(turn.matrix() @ centers[row]))
    mapper.adjust(model)
    found = np.array([model.image(index + 1).projection_center() for index in range(count)])
    lengths = np.linalg.norm(np.diff(found, axis=0), axis=1) / np.linalg.norm(
        np.diff(start, axis=0), axis=1)
    left = abs(np.log(np.median(lengths[-10:]) / np.median(lengths[:10])))
    cut = weakest(made, model=model)
    assert left <= 1.96 * cut.drift < 0.3
    assert cut.drift > cut.error, "the errors along the walk add up"


@pytest.mark.integration
def test_a_camera_that_stands_still_moves_too_little_for_its_scale_to_matter():
    cut = weakest(NoisyModel(wall(-3, 3, count=300), along(np.arange(24) * 0.01)))
    assert is_scale_known(cut)
    assert is_scale_known(None)


def test_the_error_is_that_of_dense_normal_equations():
    """All unknowns in one matrix, its derivatives by differences, its inverse by the SVD."""
    made = NoisyModel(wall(-3, 11, count=40), along(np.arange(20) * 0.5))
    model, place = made.model(), 10
    cut = weakest(made, between=(made.names[place - 1], made.names[place]))
    images = [model.image(index + 1) for index in range(20)]
    numbers = sorted(model.points3D)
    seen = [(row, numbers.index(spot.point3D_id), spot.xy) for row, image in enumerate(images)
            for spot in image.points2D if spot.has_point3D()]
    row, point, pixels = (np.array(values) for values in zip(*seen, strict=True))
    centers = np.array([image.projection_center() for image in images])
    turns = np.array([image.cam_from_world().rotation.matrix() for image in images])
    points = np.array([model.point3D(number).xyz for number in numbers])

    def residuals(unknowns):
        poses = unknowns[:120].reshape(20, 6)
        rotations = Rotation.from_rotvec(poses[:, :3]).as_matrix() @ turns
        moved = points + unknowns[124:].reshape(-1, 3)
        rays = moved[point] - (centers + poses[:, 3:])[row]
        local = np.einsum("oij,oj->oi", rotations[row], rays)
        lens = unknowns[120:124]
        return ((FOCAL + lens[:2]) * local[:, :2] / local[:, 2:]
                + [WIDTH / 2, HEIGHT / 2] + lens[2:] - pixels)

    zero = np.zeros(124 + 3 * len(points))
    step = 1e-6
    derivatives = np.stack([(residuals(zero + step * axis) - residuals(zero - step * axis)).ravel()
                            / (2 * step) for axis in np.eye(len(zero))], axis=1)
    sizes = np.linalg.norm(residuals(zero), axis=1)
    weights = 1 / (1 + (sizes / (LOSS_SCALE * sizes.mean())) ** 2)
    free = 2 * len(row) - 120 - 3 * len(points)
    covariance = (weights @ sizes**2) / free * np.linalg.pinv(
        derivatives.T @ (np.repeat(weights, 2)[:, None] * derivatives), rcond=1e-12, hermitian=True)

    def scale_of(rows):
        change = np.zeros((20, 6))
        arms = centers[rows] - centers[rows].mean(axis=0)
        change[rows, 3:] = arms / (arms**2).sum()
        return np.concatenate([change.ravel(), zero[120:]])

    change = scale_of(np.arange(place, place + 10)) - scale_of(np.arange(place - 10, place))
    assert cut.error == pytest.approx(
        SHARED_ERRORS * np.sqrt(change @ covariance @ change), rel=0.02)
