"""The loops of a walk, closed: the pose graph of its frames, built and optimized.

A walk drifts, and where it comes back it does not meet itself. The pairs of frames that match there
say by how much, in scale too. A node of the graph is a frame in a segment; a whole model is one
segment. Edges lead from frame to frame of a segment; constraints are the points of frames that two
segments have in common, of loops that a segment has closed itself, and of loops that are open.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon_cli.io.colmap_library import pycolmap
from recon_cli.scene.similarity import Similarity
from recon_cli.sfm.limits import (
    MAX_DRIFT,
    MAX_DRIFT_DEG,
    MAX_POINT_ERROR,
    MAX_RESIDUAL,
    MIN_LOOP_SHARE,
    NEAR_IN_WALK,
)
from recon_cli.sfm.model_arrays import Pair, registered_images, viewmat_of
from recon_cli.sfm.segments.edge_information import RUN, measure_information
from recon_cli.sfm.segments.pose_graph import (
    Constraints,
    Edges,
    Poses,
    measure_residuals,
    optimize,
)
from recon_cli.sfm.segments.segment_joins import SAMPLED
from recon_cli.sfm.segments.shared_points import (
    Segment,
    SharedPoints,
    choose_owners,
    describe_segment,
    estimate_similarity,
    join_matches,
)

Geometries = Mapping[Pair, pycolmap.TwoViewGeometry]
Node = tuple[int, str]  # a segment and a frame of it

COMMON = 20  # constraints of a frame in common
MIN_LOOP_POINTS = 5  # points of a pair in a loop


@dataclass(frozen=True, eq=False)
class Loop:
    """Frames that see again what others saw: points that agree on one similarity."""

    pairs: tuple[Pair, ...]
    constraints: Constraints


@dataclass(frozen=True, eq=False)
class OptimizedSegments:
    """What became of segments once their pose graph was optimized."""

    poses: Mapping[Node, Similarity]  # from the frame of a segment to the common one
    # of frames in common of two segments, in MAX_POINT_ERROR
    residuals: Mapping[tuple[int, int], float]
    loops: tuple[Loop, ...]  # that were closed


def optimize_model(
    model: pycolmap.Reconstruction, geometries: Geometries, *, seed: int
) -> pycolmap.Reconstruction | None:
    """Returns a model whose open loops were closed; None where none is open and closes."""
    segment = describe_segment(0, model)
    graph = _Graph([segment], {0: Similarity()})
    loops = graph.find_loops(geometries, seed)
    still = Poses.identity(len(graph.number))
    gaping = [loop for loop in loops if _residual(loop.constraints, still) > 1]
    if not gaping:
        return None
    optimized = graph.optimize([], loops)
    if not any(loop in optimized.loops for loop in gaping):
        return None
    return move_frames(model, {name: motion for (_, name), motion in optimized.poses.items()})


def optimize_segments(
    segments: Sequence[Segment], start: Mapping[int, Similarity],
    common: Sequence[SharedPoints], geometries: Geometries, *, seed: int,
) -> OptimizedSegments:
    """Returns the poses of segments, moved to a common frame by `start`, that close their loops.

    Only those in `start` are taken.
    """
    graph = _Graph([segment for segment in segments if segment.index in start], start)
    return graph.optimize(common, graph.find_loops(geometries, seed))


def move_frames(
    model: pycolmap.Reconstruction, poses: Mapping[str, Similarity]
) -> pycolmap.Reconstruction:
    """Returns a model with its frames moved; a point goes with the first that shows it."""
    moved = pycolmap.Reconstruction(model)
    owner: dict[int, str] = {}
    for image in sorted(registered_images(moved), key=lambda image: image.name):
        view = poses[image.name].viewmat(viewmat_of(image))
        moved.frame(image.frame_id).set_cam_from_world(
            image.camera_id, pycolmap.Rigid3d(pycolmap.Rotation3d(view[:3, :3]), view[:3, 3]))
        for point in image.get_observation_points2D():
            owner.setdefault(point.point3D_id, image.name)
    for number, name in owner.items():
        point = moved.point3D(number)
        point.xyz = poses[name].points(np.asarray(point.xyz))
    return moved


class _Graph:
    """The frames of segments as nodes, in one frame of coordinates."""

    def __init__(self, segments: Sequence[Segment], start: Mapping[int, Similarity]) -> None:
        self._segments, self._start = segments, start
        self.number = {node: row for row, node in enumerate(
            (segment.index, name) for segment in segments for name in segment.cameras.names)}
        self._centers = np.concatenate(
            [start[segment.index].points(segment.cameras.centers) for segment in segments])
        self._owner = choose_owners(segments)
        names = sorted(self._owner)
        self._place = {name: row for row, name in enumerate(names)}  # in the walk
        way = self._centers[[self.number[self._owner[name].index, name] for name in names]]
        self._travelled = np.append(0, np.linalg.norm(np.diff(way, axis=0), axis=1).cumsum())

    def optimize(self, common: Sequence[SharedPoints], loops: Sequence[Loop]) -> OptimizedSegments:
        """Optimizes the graph; a loop that contradicts the rest is left open."""
        edges, closed = self._connect_segments()
        shared = {(points.first, points.second): self._constrain_common(points) for points in common
                  if points.first in self._start and points.second in self._start}
        shared = {pair: points for pair, points in shared.items() if len(points.unit)}
        kept = list(loops)
        while True:
            poses = optimize(edges, Constraints.concatenate(
                [closed, *shared.values(), *(loop.constraints for loop in kept)]), self._centers)
            residuals = [_residual(loop.constraints, poses) for loop in kept]
            if max(residuals, default=0.0) <= MAX_RESIDUAL:
                break
            kept.pop(int(np.argmax(residuals)))
        return OptimizedSegments(
            {node: poses[row].after(self._start[node[0]]) for node, row in self.number.items()},
            {pair: _residual(points, poses) for pair, points in shared.items()},
            tuple(kept))

    def _connect_segments(self) -> tuple[Edges, Constraints]:
        """Returns the edges of the segments, and constraints where they have closed a loop."""
        edges, constraints = [], []
        for segment in self._segments:
            motion, names = self._start[segment.index], segment.cameras.names
            rows = np.array([self.number[segment.index, name] for name in names])
            known = measure_information(segment.model, names)
            edges.append(Edges(
                np.column_stack([rows[:-1], rows[1:]]),
                (self._centers[rows[:-1]] + self._centers[rows[1:]]) / 2,
                known.scale, known.turn, known.shift * motion.scale))
            chosen = _thin(known.loops // NEAR_IN_WALK, SAMPLED)
            points = motion.points(known.points[chosen])
            constraints.append(Constraints(rows[known.loops[chosen]], points, points,
                             np.full(len(chosen), self._unit(segment))))
        return Edges.concatenate(edges), Constraints.concatenate(constraints)

    def _unit(self, segment: Segment) -> float:
        """Returns how far apart equal points of a segment may be, in the common frame."""
        return MAX_POINT_ERROR * segment.cameras.depth * self._start[segment.index].scale

    def _constrain_common(self, shared: SharedPoints) -> Constraints:
        """Returns constraints between the frames that two segments have in common."""
        nodes = np.array([
            [self.number[shared.first, ours], self.number[shared.second, theirs]]
            for ours, theirs in shared.pairs]).reshape(-1, 2)[shared.pair]
        rows = np.flatnonzero(shared.common)
        rows = rows[_thin(shared.pair[rows, None], COMMON)]
        theirs = next(each for each in self._segments if each.index == shared.second)
        return Constraints(nodes[rows], self._start[shared.first].points(shared.ours[rows]),
                    self._start[shared.second].points(shared.theirs[rows]),
                    np.full(len(rows), self._unit(theirs)))

    def find_loops(self, geometries: Geometries, seed: int) -> list[Loop]:
        """Returns the loops that are open, by verified matches of frames more than RUN apart."""
        found = {pair: constraints for pair, geometry in sorted(geometries.items())
                 if (constraints := self._constrain_pair(pair, geometry)) is not None}
        loops = (self._agree(group, [found[pair] for pair in group], seed)
                 for group in self._group(list(found)))
        return [loop for loop in loops if loop is not None]

    def _constrain_pair(self, pair: Pair, geometry: pycolmap.TwoViewGeometry) -> Constraints | None:
        """Returns the points that matches of two frames say are one, where they are not."""
        if any(name not in self._owner for name in pair) or (
                abs(self._place[pair[0]] - self._place[pair[1]]) <= RUN):
            return None
        one, other = (self._owner[name] for name in pair)
        ours, theirs = one.shown[pair[0]], other.shown[pair[1]]
        first, second = join_matches(ours, theirs, geometry.inlier_matches)
        if one is other:
            open_ones = (first != second).any(axis=1)
            if open_ones.sum() <= len(open_ones) / 2:
                return None
            first, second = first[open_ones], second[open_ones]
        if len(first) < MIN_LOOP_POINTS:
            return None
        nodes = [self.number[one.index, pair[0]], self.number[other.index, pair[1]]]
        return Constraints(np.tile(nodes, (len(first), 1)), self._start[one.index].points(first),
                    self._start[other.index].points(second), np.full(len(first), self._unit(other)))

    def _group(self, pairs: Sequence[Pair]) -> Iterator[list[Pair]]:
        """Yields pairs that lie near each other on the walk, both ends of them."""
        left = list(pairs)
        while left:
            places = np.array([[self._place[name] for name in pair] for pair in left])
            near = (np.abs(places - places[len(left) // 2]) <= NEAR_IN_WALK).all(axis=1)
            yield [pair for pair, close in zip(left, near, strict=True) if close]
            left = [pair for pair, close in zip(left, near, strict=True) if not close]

    def _agree(self, pairs: Sequence[Pair], parts: Sequence[Constraints], seed: int) -> Loop | None:
        """Returns the loop that most points of pairs say; None without one, or where no drift."""
        points = Constraints.concatenate(parts)
        unit = float(np.median(points.unit))
        agreed = None if len(pairs) < 2 else estimate_similarity(
            points.ours, points.theirs, max_error=unit, min_share=MIN_LOOP_SHARE, seed=seed)
        if agreed is None:
            return None
        rows = agreed.rows
        shift = np.median(np.linalg.norm(points.ours[rows] - points.theirs[rows], axis=1))
        ends = np.array([[self._travelled[self._place[name]] for name in pair] for pair in pairs])
        way = float(np.median(np.abs(ends[:, 1] - ends[:, 0])))
        if agreed.turn_deg > MAX_DRIFT_DEG or shift > MAX_DRIFT * way:
            return None
        rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), SAMPLED)).astype(int)]
        return Loop(tuple(pairs), Constraints(
            points.nodes[rows], points.ours[rows], points.theirs[rows], np.full(len(rows), unit)))


def _residual(constraints: Constraints, poses: Poses) -> float:
    """Returns how far apart the points of constraints are in the median, standard deviations."""
    return float(np.median(measure_residuals(constraints, poses)))


def _thin(cells: NDArray[np.int64], most: int) -> NDArray[np.int64]:
    """Returns which rows to keep so that each cell, a row [*] of `cells`, has at most so many."""
    _, label = np.unique(cells, axis=0, return_inverse=True)
    order = np.argsort(label.ravel(), kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(label.ravel()[order])) + 1)
    return np.sort(np.concatenate([
        part[np.linspace(0, len(part) - 1, min(len(part), most)).astype(int)] for part in parts]))
