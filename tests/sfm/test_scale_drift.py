"""How well the scale of a stretch of a walk is known: against dense algebra, and where it is not.

A camera every half metre along a wall; where the cameras of both halves see nothing in common but
what is far away, neither half says how large the other one is.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from made_model import FOCAL, HEIGHT, WIDTH, MadeModel, along, wall
from scipy.spatial.transform import Rotation

from recon_cli.sfm.evidence import gather_evidence
from recon_cli.sfm.limits import LOSS_SCALE
from recon_cli.sfm.scale_drift import (
    MAX_SCALE_ERROR,
    SHARED_ERRORS,
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


def weakest(made: MadeModel, *, ordered: bool = True, **options):
    with TemporaryDirectory() as folder:
        database = made.write_database(Path(folder) / "database.db")
        evidence = gather_evidence(made.model(), database, made.names)
    order = np.arange(len(made.names)) if ordered else None
    return find_weakest_scale(made.model(), evidence, order, **options)


def test_what_both_halves_see_near_by_ties_their_scales():
    cut = weakest(halves(near(300)))
    assert cut.error < MAX_SCALE_ERROR
    assert is_scale_known(cut)


def test_where_only_the_distance_is_seen_from_both_halves_their_scale_is_unknown():
    made = halves(far(60))
    cut = weakest(made)
    assert cut.error > MAX_SCALE_ERROR
    assert not is_scale_known(cut)
    assert abs(made.names.index(cut.after) - 12) <= 2, "the halves meet at frame 12"
    assert sorted(cut.sides[0] + cut.sides[1]) == made.names


def test_the_cut_is_searched_between_two_images_where_they_are_named():
    made = halves(far(60))
    cut = weakest(made, between=(made.names[6], made.names[11]))
    assert made.names[6] <= cut.before < cut.after <= made.names[11]


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
