"""Joins of segments in closed form: known similarities, wrong points, and loops that are none."""

import dataclasses

import numpy as np
import pytest
from facts import assert_facts
from scipy.spatial.transform import Rotation

from recon_cli.scene.similarity import Similarity
from recon_cli.sfm.segments.segment_joins import (
    camera_residuals,
    judge_join,
    place_segments,
)
from recon_cli.sfm.segments.shared_points import SegmentCameras, SharedPoints

DEPTH = 3.0
EXACT = 1e-6


def motion(scale, degrees, shift):
    """A similarity that turns about the vertical."""
    return Similarity(scale, Rotation.from_euler("y", degrees, degrees=True).as_matrix(),
                      np.array(shift, float))


STAY = motion(1, 0, (0, 0, 0))
FIRST, SECOND = motion(0.5, 30, (3, 0, -2)), motion(2.0, -80, (0, 1, 5))


class World:
    """A walk of 60 frames on a circle, a point cloud at each frame, and segments in own frames."""

    def __init__(self, stretches, frames, seed=0):
        draws = np.random.default_rng(seed)
        angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
        self.centers = np.column_stack([5 * np.cos(angle), 0.1 * draws.normal(size=60),
                                        5 * np.sin(angle)])
        self.rotations = Rotation.from_euler("y", -angle[:, None]).as_matrix()
        self.points = self.centers[:, None] + draws.normal(size=(60, 40, 3)) * DEPTH
        self.names = [f"{index:06d}.png" for index in range(60)]
        self.stretches, self.frames = stretches, frames

    def cameras(self, index):
        rows = list(self.stretches[index])
        return SegmentCameras(
            tuple(self.names[row] for row in rows), self.frames[index].points(self.centers[rows]),
            self.rotations[rows] @ self.frames[index].rotation.T, self.frames[index].scale * DEPTH)

    def shared(self, first, second, pairs=(), clouds=None):
        """The points of common frames, and of pairs of frames that show the cloud of one."""
        common = sorted(set(self.stretches[first]) & set(self.stretches[second]))
        entries = [(row, row) for row in common] + list(pairs)
        clouds = clouds or {}
        ours = [self.points[a] for a, _ in entries]
        theirs = [clouds.get((a, b), self.points[a]) for a, b in entries]
        return SharedPoints(
            first, second, self.frames[first].points(np.concatenate(ours)),
            self.frames[second].points(np.concatenate(theirs)),
            np.repeat(np.arange(len(entries)), 40),
            tuple((self.names[a], self.names[b]) for a, b in entries))

    def judge(self, first, second, **shared):
        return judge_join(self.shared(first, second, **shared), self.cameras(first),
                          self.cameras(second), seed=0)


@pytest.fixture
def chain():
    """Three segments in a row; the last one ends where the first began."""
    return World([range(25), range(20, 45), range(40, 60)],
                 [STAY, FIRST, SECOND])


def assert_same(found, wanted):
    np.testing.assert_allclose(found.matrix, wanted.matrix, atol=EXACT)


def test_common_frames_give_the_similarity_between_two_segments(chain):
    join = chain.judge(0, 1)
    assert join.holds
    assert len(join.witnesses) == 2  # the points of the frames, and their cameras
    assert_same(join.motion, FIRST)
    assert join.frames


def test_a_tenth_of_wrong_points_changes_nothing(chain):
    shared = chain.shared(0, 1)
    wrong = np.random.default_rng(1).permutation(len(shared.ours))[:len(shared.ours) // 10]
    theirs = shared.theirs.copy()
    theirs[wrong] = theirs[np.roll(wrong, 1)]
    join = judge_join(dataclasses.replace(shared, theirs=theirs), chain.cameras(0),
                      chain.cameras(1), seed=0)
    assert join.holds
    assert_same(join.motion, FIRST)


def test_most_points_wrong_contradict_a_join(chain):
    shared = chain.shared(0, 1)
    draws = np.random.default_rng(1)
    wrong = draws.permutation(len(shared.ours))[:2 * len(shared.ours) // 3]
    theirs = shared.theirs.copy()
    theirs[wrong] = draws.permutation(theirs[wrong])
    join = judge_join(dataclasses.replace(shared, theirs=theirs), chain.cameras(0),
                      chain.cameras(1), seed=0)
    assert not join.holds
    assert_facts("\n".join(join.contradictions), "points", "common", "frames")


@pytest.mark.parametrize(("scale", "degrees"), [(0.8, 0), (1.25, 0), (1, 10)])
def test_a_segment_that_is_broken_within_the_common_frames_is_not_joined(scale, degrees):
    world = World([range(32), range(20, 52)], [STAY, FIRST])
    shared, cameras = world.shared(0, 1), world.cameras(1)
    middle = cameras.centers[5]  # frame 25 of 20 to 31 in common
    turn = Rotation.from_euler("y", degrees, degrees=True).as_matrix()

    def break_off(points, after):
        moved = middle + scale * (points - middle) @ turn.T
        return np.where(after[:, None], moved, points)

    later = np.arange(len(cameras.names)) > 5
    broken = dataclasses.replace(
        cameras, centers=break_off(cameras.centers, later),
        rotations=np.where(later[:, None, None], cameras.rotations @ turn.T, cameras.rotations))
    theirs = break_off(shared.theirs, shared.pair > 5)
    assert judge_join(shared, world.cameras(0), cameras, seed=0).holds
    join = judge_join(dataclasses.replace(shared, theirs=theirs), world.cameras(0), broken, seed=0)
    assert not join.holds
    assert join.contradictions


def test_cameras_that_lie_elsewhere_contradict_points_that_agree(chain):
    cameras = chain.cameras(1)
    moved = dataclasses.replace(cameras, centers=cameras.centers + np.array([0.0, 0.0, 1.0]))
    join = judge_join(chain.shared(0, 1), chain.cameras(0), moved, seed=0)
    assert not join.holds
    assert_facts("\n".join(join.contradictions), "cameras")


def test_the_residuals_of_cameras_are_known(chain):
    cameras = chain.cameras(1)
    turn = Rotation.from_euler("z", 3, degrees=True).as_matrix()
    off = dataclasses.replace(
        cameras, centers=cameras.centers + np.array([0.0, 0.3 * cameras.extent, 0.0]),
        rotations=turn @ cameras.rotations)
    extent = min(FIRST.scale * chain.cameras(0).extent, off.extent)
    shift, degrees = camera_residuals(FIRST, chain.cameras(0), off)
    assert shift == pytest.approx(0.3 * cameras.extent / extent)
    assert degrees == pytest.approx(3.0)


# Frames 0 to 4 and 55 to 59 lie beside each other on the circle: pairs of them see one cloud.
LOOP = [(0, 58), (1, 59), (2, 59)]
APART = [(12, 50), (13, 51), (14, 51)]


def test_one_stretch_of_pairs_is_one_witness_and_makes_no_join(chain):
    join = chain.judge(0, 2, pairs=LOOP)
    assert join.motion is not None
    assert len(join.witnesses) == 1
    assert not join.holds


def test_two_stretches_of_pairs_make_a_join_without_common_frames(chain):
    join = chain.judge(0, 2, pairs=LOOP + APART)
    assert join.holds
    assert_same(join.motion, SECOND)
    assert not join.frames


def test_a_single_pair_is_no_witness(chain):
    assert chain.judge(0, 2, pairs=[(0, 58), (12, 50)]).witnesses == ()


def test_segments_of_a_chain_come_into_one_frame(chain):
    cameras = {index: chain.cameras(index) for index in range(3)}
    joins = [chain.judge(0, 1), chain.judge(1, 2)]
    group, = place_segments(cameras, joins)
    for index, frame in enumerate((STAY, FIRST, SECOND)):
        assert_same(group.poses[index], frame.inverse())
    assert group.refused == ()


def test_a_break_in_the_chain_leaves_two_groups_and_is_told(chain):
    cameras = {index: chain.cameras(index) for index in range(3)}
    shared = chain.shared(1, 2)
    nonsense = dataclasses.replace(
        shared, theirs=np.random.default_rng(2).normal(size=shared.theirs.shape))
    broken = judge_join(nonsense, cameras[1], cameras[2], seed=0)
    groups = place_segments(cameras, [chain.judge(0, 1), broken])
    assert [sorted(group.poses) for group in groups] == [[0, 1], [2]]
    assert_facts("\n".join(groups[0].refused), 1, 2, "segments")


def drifted(chain, degrees=2.0, scale=0.97):
    """The same walk with a middle segment that is bent: its end is turned and smaller."""
    off = motion(scale, degrees, (0.05, 0, 0))
    shared = chain.shared(1, 2)
    moved = dataclasses.replace(shared, ours=off.points(shared.ours))
    cameras = dict(enumerate(map(chain.cameras, range(3))))
    rows = [chain.stretches[1].index(row) for row in range(40, 45)]
    centers, rotations = cameras[1].centers.copy(), cameras[1].rotations.copy()
    centers[rows], rotations[rows] = off.points(centers[rows]), rotations[rows] @ off.rotation.T
    cameras[1] = dataclasses.replace(cameras[1], centers=centers, rotations=rotations)
    return cameras, [chain.judge(0, 1), judge_join(moved, cameras[1], cameras[2], seed=0)]


def end_error(group, chain, cameras):
    """How far the last segment is from where it belongs, as a share of the walk's extent."""
    found = group.poses[2].points(cameras[2].centers)
    return np.linalg.norm(found - chain.centers[40:], axis=1).max() / 10


def test_a_loop_takes_the_drift_off_the_way(chain):
    cameras, joins = drifted(chain)
    open_way, = place_segments(cameras, joins)
    closed, = place_segments(cameras, [*joins, chain.judge(0, 2, pairs=LOOP + APART)])
    assert end_error(open_way, chain, cameras) > 0.04
    assert end_error(closed, chain, cameras) < 0.4 * end_error(open_way, chain, cameras)


def test_a_loop_that_is_none_is_refused_and_moves_nothing(chain):
    cameras = {index: chain.cameras(index) for index in range(3)}
    # Frames on opposite sides of the circle show what looks alike: points of 12 at 40.
    away = {pair: chain.points[pair[0]] - [9.0, 0.0, 9.0] for pair in LOOP + APART}
    wrong = chain.judge(0, 2, pairs=LOOP + APART, clouds=away)
    assert wrong.holds  # it agrees with itself
    group, = place_segments(cameras, [chain.judge(0, 1), chain.judge(1, 2), wrong])
    assert_same(group.poses[2], SECOND.inverse())
    assert_facts("\n".join(group.refused), 0, 2, "segments")
