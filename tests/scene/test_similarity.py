"""A change of the world frame is a group, and leaves every pixel where it was."""

import json

import numpy as np
import pytest
from facts import raises

from recon_cli.scene.camera import Camera
from recon_cli.scene.similarity import Similarity

EXACT = 1e-12  # float64 on numbers of about ten, some dozen operations


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


def random_similarity(seed: int) -> Similarity:
    rng = np.random.default_rng(seed)
    return Similarity(rng.uniform(0.2, 5), random_rotation(rng), rng.normal(size=3))


def equal(a: Similarity, b: Similarity) -> bool:
    return bool(np.allclose(a.matrix, b.matrix, rtol=0, atol=EXACT))


@pytest.mark.parametrize("seed", range(5))
def test_composing_is_applying_one_after_the_other(seed):
    first, second = random_similarity(seed), random_similarity(seed + 100)
    points = np.random.default_rng(seed).normal(size=(7, 3))
    both = second.after(first)
    assert np.allclose(both.points(points), second.points(first.points(points)), atol=EXACT)
    assert np.allclose(both.matrix, second.matrix @ first.matrix, atol=EXACT)


@pytest.mark.parametrize("seed", range(5))
def test_the_inverse_undoes_from_either_side(seed):
    similarity = random_similarity(seed)
    assert equal(similarity.after(similarity.inverse()), Similarity())
    assert equal(similarity.inverse().after(similarity), Similarity())


def test_the_default_changes_nothing_and_knows_it():
    points = np.random.default_rng(0).normal(size=(5, 3))
    assert Similarity().is_identity
    assert np.array_equal(Similarity().points(points), points)
    assert not Similarity(scale=1.0 + 1e-15).is_identity
    assert not Similarity(translation=np.array([0, 0, 1e-300])).is_identity


@pytest.mark.parametrize("seed", range(5))
def test_a_point_keeps_its_pixel_and_its_depth_grows_with_the_scale(seed):
    similarity = random_similarity(seed)
    rng = np.random.default_rng(seed)
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = random_rotation(rng), rng.normal(size=3)
    camera = Camera(40, 30, 35.0, 36.0, 20.0, 15.0, viewmat)
    moved = similarity.camera(camera)
    point = rng.normal(size=3)
    before = viewmat[:3, :3] @ point + viewmat[:3, 3]
    after = moved.viewmat[:3, :3] @ similarity.points(point) + moved.viewmat[:3, 3]
    assert np.allclose(after, similarity.scale * before, atol=EXACT)
    assert np.allclose(moved.center, similarity.points(camera.center), atol=EXACT)
    assert np.allclose(moved.viewmat[:3, :3] @ moved.viewmat[:3, :3].T, np.eye(3), atol=EXACT)
    assert moved.fx == camera.fx


def test_json_keeps_every_bit():
    similarity = random_similarity(3)
    back = Similarity.from_json(json.loads(json.dumps(similarity.to_json())))
    assert np.array_equal(back.matrix, similarity.matrix)


@pytest.mark.parametrize("wrong", [
    {"scale": 0.0}, {"scale": -1.0}, {"scale": float("nan")},
    {"rotation": np.diag([1.0, 1.0, -1.0])},  # a mirror
    {"rotation": 2 * np.eye(3)}, {"rotation": np.full((3, 3), np.nan)}, {"rotation": np.eye(2)},
    {"translation": np.array([0.0, np.inf, 0.0])}, {"translation": np.zeros(4)},
])
def test_what_is_no_similarity_is_refused(wrong):
    with raises(ValueError, *wrong):
        Similarity(**wrong)


def test_a_matrix_gives_back_the_similarity_that_it_was_made_of():
    turn = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0], [0.48, 0.64, 0.6]])
    wanted = Similarity(0.3, turn, np.array([1.0, -2, 5]))
    found = Similarity.from_matrix(wanted.matrix)
    assert np.allclose(found.matrix, wanted.matrix, atol=1e-15)
    assert Similarity.from_matrix(np.diag([2.0, 2, 2, 1])).scale == pytest.approx(2)
    assert np.array_equal(
        Similarity.from_matrix(np.diag([1.0, -1, -1, 1])).rotation, np.diag([1, -1, -1]))


@pytest.mark.parametrize(("matrix", "reason"), [
    (np.diag([1.0, 1, -1, 1]), "mirrors"), (np.diag([1.0, 1, 1.001, 1]), "stretches"),
    (np.diag([0.0, 0, 0, 1]), "stretches"), (np.diag([1e200, 1e200, 1e200, 1]), "stretches"),
    (np.diag([np.nan, 1, 1, 1]), "finite"), (np.eye(4) * 2, "row")])
def test_a_matrix_that_is_no_similarity_is_refused_with_the_reason(matrix, reason):
    with raises(ValueError, reason):
        Similarity.from_matrix(matrix)
