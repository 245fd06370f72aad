"""Which segments belong together, and how all of them lie to each other.

A join is a similarity from points that both segments have: those of the frames in common, and those
that verified pairs of their other frames match. It is made where two witnesses support it and none
contradicts: the points of the common frames, their cameras, and pairs of other frames, each stretch
of a walk for itself.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.sparse import lil_matrix
from scipy.spatial.transform import Rotation

from recon_cli.scene.matches import MIN_PAIR_INLIERS
from recon_cli.scene.similarity import Similarity
from recon_cli.scene.statistics import COARSE_SAMPLE
from recon_cli.sfm.limits import (
    MAX_DRIFT,
    MAX_DRIFT_DEG,
    MAX_POINT_ERROR,
    MAX_RESIDUAL,
    MIN_COMMON_SHARE,
    MIN_LOOP_SHARE,
    MIN_POSE_INLIERS,
    NEAR_IN_WALK,
)
from recon_cli.sfm.model_arrays import Pair
from recon_cli.sfm.segments.shared_points import SegmentCameras, SharedPoints, estimate_similarity

# Nine of ten cameras of common frames: of the extent of the smaller segment, and degrees. A median
# would not see that the others are off.
CAMERAS, MAX_OFF, MAX_TURN_DEG = 0.9, 0.05, 3.0
SAMPLED = 60  # points of a join in the common adjustment


@dataclass(frozen=True, eq=False)
class Join:
    """How two segments lie to each other, and the evidence for and against it."""

    first: int
    second: int
    motion: Similarity | None  # from the frame of `first` to that of `second`; None without one
    witnesses: tuple[str, ...]  # that support it, in words
    contradictions: tuple[str, ...]  # likewise
    ours: NDArray[np.float64]  # [K, 3], points that agree
    theirs: NDArray[np.float64]  # [K, 3]
    frames: bool  # they have frames in common

    @property
    def holds(self) -> bool:
        """Whether the segments can be joined by it."""
        return self.motion is not None and len(self.witnesses) >= 2 and not self.contradictions

    @property
    def touches(self) -> bool:
        """Whether points of frames in common show about where the segments lie."""
        return self.motion is not None and self.frames


def judge_join(
    shared: SharedPoints, first: SegmentCameras, second: SegmentCameras, *, seed: int
) -> Join:
    """Returns the join of two segments that their points and cameras support or contradict."""
    common = shared.common
    has_frames = bool(set(first.names) & set(second.names))
    motion = _similarity(shared, common, second.depth, seed)
    if motion is None:
        # of other pairs nothing is expected: most that are matched only look alike
        why = ("too few points of their common frames agree",) if has_frames else ()
        return Join(shared.first, shared.second, None, (), why, np.zeros((0, 3)),
                    np.zeros((0, 3)), has_frames)
    off = np.linalg.norm(motion.points(shared.ours) - shared.theirs, axis=1)
    agree = off <= MAX_POINT_ERROR * second.depth
    support: list[str] = []
    against: list[str] = []
    if has_frames:
        share = float(agree[common].mean()) if common.any() else 0.0
        text = f"{share:.0%} of {np.count_nonzero(common)} points of common frames agree"
        enough = share >= MIN_COMMON_SHARE and np.count_nonzero(agree & common) >= MIN_POSE_INLIERS
        (support if enough else against).append(text)
        shift, turn = camera_residuals(motion, first, second)
        text = (f"{CAMERAS:.0%} of their common cameras are at most {shift:.1%} of the extent and "
                f"{turn:.1f} degrees off")
        (support if shift <= MAX_OFF and turn <= MAX_TURN_DEG else against).append(text)
    places = _agreeing_pairs(shared, agree)
    for stretch in _stretches(places, first, second):
        support.append(f"{len(stretch)} pairs of other frames, like {' and '.join(stretch[0])}")
    rows = np.flatnonzero(agree)
    rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), SAMPLED)).astype(int)]
    return Join(shared.first, shared.second, motion, tuple(support), tuple(against),
                shared.ours[rows], shared.theirs[rows], has_frames)


def _similarity(
    shared: SharedPoints, common: NDArray[np.bool_], depth: float, seed: int
) -> Similarity | None:
    """Returns the motion from the first segment to the second that most points agree with.

    Points of common frames decide where there are enough: others may only look alike.
    """
    rows = np.flatnonzero(common if np.count_nonzero(common) >= MIN_POSE_INLIERS else common | True)
    rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), COARSE_SAMPLE)).astype(int)]
    agreed = estimate_similarity(
        shared.ours[rows], shared.theirs[rows], max_error=MAX_POINT_ERROR * depth, seed=seed)
    return None if agreed is None else agreed.motion


def camera_residuals(
    motion: Similarity, first: SegmentCameras, second: SegmentCameras
) -> tuple[float, float]:
    """Returns how far nine of ten cameras of common frames are apart at most after a motion.

    As a share of the extent of the smaller segment, and in degrees; infinity without any.
    """
    place = {name: row for row, name in enumerate(second.names)}
    pairs = [(row, place[name]) for row, name in enumerate(first.names) if name in place]
    if not pairs:
        return np.inf, np.inf
    ours, theirs = np.array(pairs).T
    off = np.linalg.norm(motion.points(first.centers[ours]) - second.centers[theirs], axis=1)
    turned = first.rotations[ours] @ motion.rotation.T
    turns = Rotation.from_matrix(turned.transpose(0, 2, 1) @ second.rotations[theirs]).magnitude()
    extent = min(motion.scale * first.extent, second.extent)
    return (float(np.quantile(off, CAMERAS)) / max(extent, 1e-12),
            float(np.degrees(np.quantile(turns, CAMERAS))))


def _agreeing_pairs(shared: SharedPoints, agree: NDArray[np.bool_]) -> list[Pair]:
    """Returns the pairs of frames not in common most of whose points agree."""
    counts = np.bincount(shared.pair, minlength=len(shared.pairs))
    good = np.bincount(shared.pair[agree], minlength=len(shared.pairs))
    return [pair for pair, count, fine in zip(shared.pairs, counts, good, strict=True)
            if pair[0] != pair[1] and count >= MIN_PAIR_INLIERS and fine >= MIN_LOOP_SHARE * count]


def _stretches(
    pairs: Sequence[Pair], first: SegmentCameras, second: SegmentCameras
) -> Iterator[list[Pair]]:
    """Yields groups of pairs that are near each other in both segments, of two pairs or more.

    Frames of one place are mistaken for another together: only pairs far from them say more.
    """
    rows = [{name: row for row, name in enumerate(each.names)} for each in (first, second)]
    left = list(pairs)
    while left:
        places = np.array([[rows[side][pair[side]] for side in (0, 1)] for pair in left])
        near = (np.abs(places - places[0]) <= NEAR_IN_WALK).all(axis=1)
        group = [pair for pair, close in zip(left, near, strict=True) if close]
        left = [pair for pair, close in zip(left, near, strict=True) if not close]
        if len(group) >= 2:
            yield group


@dataclass(frozen=True, eq=False)
class Placement:
    """Segments that were joined, each with the motion from its frame to a common one."""

    poses: Mapping[int, Similarity]
    refused: tuple[str, ...]  # joins that were not made, in words


def place_segments(
    cameras: Mapping[int, SegmentCameras], joins: Sequence[Join], *, with_graph: bool = False
) -> tuple[Placement, ...]:
    """Returns the groups of segments that joins hold together, most cameras first.

    Segments with frames in common are joined first. A loop between two of one group counts where it
    is off by no more than a way drifts; then all are adjusted to what all joins say. Where segments
    get a pose graph next (`with_graph`), a motion is enough for those with frames in common,
    and loops are left to that.
    """
    order = sorted((join for join in joins if join.holds or (with_graph and join.touches)),
                   key=lambda join: (not join.frames, -len(join.ours), join.first, join.second))
    group = {index: index for index in cameras}
    tree: list[Join] = []
    for join in order:
        ours, theirs = group[join.first], group[join.second]
        if ours != theirs:
            tree.append(join)
            group = {index: ours if which == theirs else which for index, which in group.items()}
    placements = []
    for root in sorted(set(group.values())):
        members = {index for index, which in group.items() if which == root}
        start = _chain(members, tree)
        made = {(join.first, join.second) for join in order}
        inner = [join for join in order if join.first in members]
        near = [join for join in inner if join in tree or _is_near(join, start, cameras)]
        poses, kept = (start, near) if with_graph else _close_loops(start, near, tree, cameras)
        refused = [*(f"the loop of segments {join.first} and {join.second} contradicts the walk"
                     for join in inner if join not in kept), *(
            f"segments {join.first} and {join.second} are not joined: " + "; ".join(
                join.contradictions or ("fewer than two witnesses support it",))
            for join in joins if (join.first, join.second) not in made and join.frames
            and join.first in members)]
        placements.append(Placement(poses, tuple(refused)))
    return tuple(sorted(placements, key=lambda each: -sum(
        len(cameras[index].names) for index in each.poses)))


def _chain(members: Collection[int], tree: Sequence[Join]) -> dict[int, Similarity]:
    """Returns poses to the frame of the first member, along the joins of a tree."""
    poses = {min(members): Similarity()}
    while len(poses) < len(members):
        for join in tree:
            if join.motion is None:
                continue
            if join.second in poses and join.first not in poses:
                poses[join.first] = poses[join.second].after(join.motion)
            elif join.first in poses and join.second not in poses:
                poses[join.second] = poses[join.first].after(join.motion.inverse())
    return poses


def _is_near(
    join: Join, poses: Mapping[int, Similarity], cameras: Mapping[int, SegmentCameras]
) -> bool:
    """Returns whether a join is off by no more than the way between its segments may drift."""
    assert join.motion is not None
    off = poses[join.second].after(join.motion).after(poses[join.first].inverse())
    turn = np.degrees(Rotation.from_matrix(off.rotation).magnitude())
    between = [index for index in poses
               if min(join.first, join.second) <= index <= max(join.first, join.second)]
    places = np.concatenate([poses[index].points(cameras[index].centers) for index in between])
    way = float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())
    ours = poses[join.first].points(join.ours)
    shift = np.linalg.norm(poses[join.second].points(join.theirs) - ours, axis=1)
    return bool(turn <= MAX_DRIFT_DEG and np.median(shift) <= MAX_DRIFT * way)


def _close_loops(
    start: Mapping[int, Similarity], joins: Sequence[Join], tree: Sequence[Join],
    cameras: Mapping[int, SegmentCameras],
) -> tuple[dict[int, Similarity], list[Join]]:
    """Returns poses adjusted to joins, and those joins: without loops that tear at others."""
    kept = list(joins)
    while True:
        poses = adjust_poses(start, kept, cameras)
        residuals = [_residual(join, poses, cameras) for join in kept]
        loops = [row for row, join in enumerate(kept) if join not in tree]
        if not loops or max(residuals) <= MAX_RESIDUAL:
            return poses, kept
        kept.pop(max(loops, key=lambda row: residuals[row]))


def _residual(
    join: Join, poses: Mapping[int, Similarity], cameras: Mapping[int, SegmentCameras]
) -> float:
    """Returns how far the points of a join are apart, in the median, over what they may be."""
    ours = poses[join.first].points(join.ours)
    off = np.linalg.norm(poses[join.second].points(join.theirs) - ours, axis=1)
    return float(np.median(off)) / _unit(join, poses, cameras)


def _unit(
    join: Join, poses: Mapping[int, Similarity], cameras: Mapping[int, SegmentCameras]
) -> float:
    """Returns how far apart equal points of a join may be, in the common frame."""
    return MAX_POINT_ERROR * poses[join.second].scale * cameras[join.second].depth


def adjust_poses(
    start: Mapping[int, Similarity], joins: Sequence[Join], cameras: Mapping[int, SegmentCameras]
) -> dict[int, Similarity]:
    """Returns poses at which the points of all joins lie closest together; the first stays."""
    order = sorted(start)
    if len(joins) < len(order):  # a chain has nothing to share out
        return dict(start)
    place = {index: row for row, index in enumerate(order)}
    pairs = [(place[join.first], place[join.second], start[join.first].points(join.ours),
              start[join.second].points(join.theirs), _unit(join, start, cameras))
             for join in joins]
    # Poses about the middle of each segment, so that their parts are about independent.
    middles = np.array([start[index].points(cameras[index].centers).mean(axis=0)
                        for index in order])

    def moved(values: NDArray[np.float64]) -> list[Similarity]:
        return [Similarity()] + [
            Similarity(
                scale := float(np.exp(row[0])), turn := Rotation.from_rotvec(row[1:4]).as_matrix(),
                middle + row[4:] - scale * turn @ middle)
            for row, middle in zip(values.reshape(-1, 7), middles[1:], strict=True)]

    def residuals(values: NDArray[np.float64]) -> NDArray[np.float64]:
        poses = moved(values)
        return np.concatenate([
            ((poses[first].points(ours) - poses[second].points(theirs)) / unit).ravel()
            for first, second, ours, theirs, unit in pairs])

    sizes = [3 * len(ours) for _, _, ours, _, _ in pairs]
    sparsity = lil_matrix((sum(sizes), 7 * (len(order) - 1)), dtype=np.int8)
    row = 0
    for (first, second, *_), size in zip(pairs, sizes, strict=True):
        for index in (first, second):
            if index:
                sparsity[row:row + size, 7 * (index - 1):7 * index] = 1
        row += size
    result = least_squares(
        residuals, np.zeros(7 * (len(order) - 1)), jac_sparsity=sparsity, x_scale="jac",
        max_nfev=100)
    return {index: motion.after(start[index])
            for index, motion in zip(order, moved(result.x), strict=True)}
