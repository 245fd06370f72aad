"""The similarity that points of two models agree on."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recon_cli.scene.similarity import Similarity
from recon_cli.sfm.limits import MIN_POSE_INLIERS
from recon_cli.sfm.segments.shared_points import estimate_similarity, to_sim3d

TRUTH = Similarity(
    2.0, Rotation.from_euler("y", 30, degrees=True).as_matrix(), np.array([1.0, -2.0, 3.0]))


def points(count, seed=0):
    return np.random.default_rng(seed).normal(size=(count, 3))


def test_a_similarity_is_found_beside_wrong_points_and_says_which_agree():
    source = points(200)
    target = TRUTH.points(source)
    target[:50] = points(50, seed=1)
    found = estimate_similarity(source, target, max_error=1e-3, min_share=0.5, seed=0)
    np.testing.assert_allclose(found.motion.matrix, TRUTH.matrix, atol=1e-6)
    assert found.rows.tolist() == list(range(50, 200))
    assert found.turn_deg == pytest.approx(30)
    assert estimate_similarity(source, target, max_error=1e-3, min_share=0.8, seed=0) is None


def test_points_that_contradict_each_other_give_none():
    assert estimate_similarity(points(200), points(200, seed=1), max_error=0.1, seed=0) is None


def test_too_few_points_give_none():
    few = points(MIN_POSE_INLIERS - 1)
    assert estimate_similarity(few, few, max_error=0.1, seed=0) is None


def test_colmap_moves_points_by_it_to_the_same_place():
    np.testing.assert_allclose(to_sim3d(TRUTH) * points(1)[0], TRUTH.points(points(1))[0])
