"""A chain of nodes that drifted in a known way is corrected where it is known least."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recon_cli.sfm.segments.pose_graph import (
    Constraints,
    Edges,
    Poses,
    measure_residuals,
    optimize,
)

COUNT = 30
CENTERS = np.column_stack([np.arange(COUNT, dtype=float), np.zeros(COUNT), np.zeros(COUNT)])
CLOUD = np.random.default_rng(0).normal((0, 2, 0), size=(20, 3))


def chain(scale=None):
    """Edges along a straight walk, all alike but for the deviation of scale."""
    rows = np.arange(COUNT - 1)
    return Edges(
        np.column_stack([rows, rows + 1]), (CENTERS[1:] + CENTERS[:-1]) / 2,
        np.full(COUNT - 1, 0.002) if scale is None else scale, np.full(COUNT - 1, 0.001),
        np.full(COUNT - 1, 0.002))


def constrain(first, second, ours, theirs, unit=0.05):
    nodes = np.tile([first, second], (len(ours), 1))
    return Constraints(nodes, ours, theirs, np.full(len(ours), unit))


def test_nothing_moves_where_nothing_pulls():
    constraints = constrain(3, 20, CLOUD, CLOUD)
    poses = optimize(chain(), constraints, CENTERS)
    np.testing.assert_allclose(poses.scale, 1, atol=1e-9)
    np.testing.assert_allclose(poses.points(CENTERS), CENTERS, atol=1e-9)
    assert measure_residuals(constraints, poses).max() < 1e-9


@pytest.mark.integration
@pytest.mark.parametrize("factor", [0.7, 1.4])
def test_a_break_of_scale_is_taken_back_at_the_weak_edge(factor):
    deviations = np.full(COUNT - 1, 0.002)
    deviations[14] = 0.2
    broken = CENTERS.copy()
    broken[15:] = broken[14] + (CENTERS[15:] - CENTERS[14]) * factor
    seen = CENTERS[2] + CLOUD  # by node 2, and by node 25 after the break
    constraints = constrain(2, 25, seen, CENTERS[14] + (seen - CENTERS[14]) * factor)
    poses = optimize(chain(deviations), constraints, broken)
    found = poses.scale[-1] / poses.scale[0]
    assert found == pytest.approx(1 / factor, rel=0.02)
    np.testing.assert_allclose(poses.scale[:15], 1, atol=0.02)
    # the edge is half a step beside the break
    np.testing.assert_allclose(poses.points(broken), CENTERS, atol=0.35)


def test_a_drift_is_shared_out_where_all_edges_are_alike():
    turn = Rotation.from_euler("y", 8, degrees=True).as_matrix()
    seen = CENTERS[2] + CLOUD
    drifted = (seen - CENTERS[28]) @ turn.T + CENTERS[28]
    poses = optimize(chain(), constrain(2, 28, seen, drifted), CENTERS)
    turns = np.degrees([
        Rotation.from_matrix(poses.rotation[row].T @ poses.rotation[row + 1]).magnitude()
        for row in range(2, 28)])
    assert turns.max() < 2 * turns.mean()


def test_what_is_tied_to_a_node_turns_with_it():
    turn = Rotation.from_euler("z", 40, degrees=True).as_matrix()
    edges = Edges(
        np.array([[0, 1], [1, 2]]), (CENTERS[:2] + CENTERS[1:3]) / 2, np.full(2, 0.01),
        np.array([10.0, 0.001]), np.array([10.0, 0.001]))  # the first hardly holds
    seen = CENTERS[1] + CLOUD
    poses = optimize(edges, constrain(0, 1, seen @ turn.T, seen, unit=0.001), CENTERS[:3])
    for node in (1, 2):
        np.testing.assert_allclose(poses.rotation[node], turn, atol=0.01)
    np.testing.assert_allclose(poses.points(CENTERS[:3])[2], turn @ CENTERS[2], atol=0.02)


def test_a_few_wrong_constraints_do_not_move_the_rest():
    right = constrain(2, 25, CLOUD + CENTERS[2], CLOUD + CENTERS[2])
    wrong = constrain(2, 25, CLOUD[:5] + CENTERS[2], CLOUD[:5] + CENTERS[2] + [0, 5, 0])
    poses = optimize(chain(), Constraints.concatenate([right, wrong]), CENTERS)
    np.testing.assert_allclose(poses.points(CENTERS), CENTERS, atol=0.05)


def test_a_pose_of_a_node_is_a_similarity():
    poses = Poses.identity(2).after(
        np.array([[np.log(2), 0, 0, np.pi / 2, 1, 0, 0], [0] * 7], float), np.zeros((2, 3)))
    np.testing.assert_allclose(poses[0].points(np.array([1.0, 0, 0])), [1, 2, 0], atol=1e-12)
    np.testing.assert_allclose(poses[1].points(np.array([1.0, 0, 0])), [1, 0, 0], atol=1e-12)
