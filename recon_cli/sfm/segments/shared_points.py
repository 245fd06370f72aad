"""The points that two models have in common, and the similarity between the models from them.

A model is described by its cameras and by the points that each of its images shows. Points of two
models are one where an image that is in both shows them at one spot, or where verified matches
between two images join them.
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recon_cli.io.colmap_library import pycolmap
from recon_cli.scene.similarity import Similarity
from recon_cli.sfm.limits import MAX_TRIALS, MIN_POSE_INLIERS
from recon_cli.sfm.model_arrays import ModelArrays, Pair


@dataclass(frozen=True, eq=False)
class SegmentCameras:
    """The cameras of one segment in its own frame, F of them."""

    names: tuple[str, ...]  # in the order of the walk
    centers: NDArray[np.float64]  # [F, 3]
    rotations: NDArray[np.float64]  # [F, 3, 3], world to camera
    depth: float  # median distance of a point from a camera that sees it

    @property
    def extent(self) -> float:
        """The diagonal of the box around the cameras."""
        return float(np.linalg.norm(np.ptp(self.centers, axis=0)))


@dataclass(frozen=True, eq=False)
class ObservedPoints:
    """The points of a segment that one of its images shows, K of them."""

    rows: NDArray[np.int64]  # [K], sorted keypoints
    xy: NDArray[np.float64]  # [K, 2] pixels
    points: NDArray[np.float64]  # [K, 3], in the segment's frame


@dataclass(frozen=True, eq=False)
class Segment:
    """A segment that was mapped."""

    index: int
    model: pycolmap.Reconstruction
    cameras: SegmentCameras
    shown: Mapping[str, ObservedPoints]


@dataclass(frozen=True, eq=False)
class SharedPoints:
    """M points that two segments have in common, each in the frame of either."""

    first: int  # segments by index, first < second
    second: int
    ours: NDArray[np.float64]  # [M, 3]
    theirs: NDArray[np.float64]  # [M, 3]
    pair: NDArray[np.int64]  # [M], index into pairs
    pairs: tuple[Pair, ...]  # frames that show them; twice the same name for a frame in common

    @property
    def common(self) -> NDArray[np.bool_]:  # [M]
        """Which of them a frame in common shows."""
        return np.array([a == b for a, b in self.pairs], np.bool_)[self.pair]


@dataclass(frozen=True, eq=False)
class AgreedSimilarity:
    """The similarity that most of some pairs of points agree on."""

    motion: Similarity
    rows: NDArray[np.int64]  # [K], pairs that agree

    @property
    def turn_deg(self) -> float:
        """The angle of its rotation."""
        return float(np.degrees(Rotation.from_matrix(self.motion.rotation).magnitude()))


def describe_segment(index: int, model: pycolmap.Reconstruction) -> Segment:
    """Returns a model as a segment."""
    arrays = ModelArrays.from_model(model)
    points = arrays.points[arrays.point]
    shown = {name: ObservedPoints(arrays.keypoint[own], arrays.xy[own], points[own])
             for row, name in enumerate(arrays.names) for own in [arrays.observed(row)]}
    depths = np.linalg.norm(points - arrays.centers[arrays.image], axis=1)
    cameras = SegmentCameras(arrays.names, arrays.centers, arrays.viewmats[:, :3, :3],
                             float(np.median(depths if arrays.images else [0.0])))
    return Segment(index, model, cameras, shown)


def choose_owners(segments: Sequence[Segment]) -> dict[str, Segment]:
    """Returns the segment that shows most points of each frame."""
    owners: dict[str, Segment] = {}
    for segment in segments:
        for name, shown in segment.shown.items():
            best = owners.get(name)
            if best is None or len(shown.rows) > len(best.shown[name].rows):
                owners[name] = segment
    return owners


def find_shared_points(
    segments: Sequence[Segment], geometries: Mapping[Pair, pycolmap.TwoViewGeometry]
) -> list[SharedPoints]:
    """Returns the points that two segments have in common, for each two that have some.

    `geometries` are verified matches by pair, of the keypoints that the segments have.
    """
    parts: dict[tuple[int, int], list[tuple[Pair, NDArray[np.float64], NDArray[np.float64]]]]
    parts = defaultdict(list)
    for one, other in itertools.combinations(segments, 2):
        for name in sorted(one.shown.keys() & other.shown.keys()):
            ours, theirs = one.shown[name], other.shown[name]
            # Keypoints of features are the same in both, those of tracks are numbered anew.
            _, left, right = np.intersect1d(
                _spots(ours.xy), _spots(theirs.xy), return_indices=True)
            parts[one.index, other.index].append(
                ((name, name), ours.points[left], theirs.points[right]))
    for pair, geometry in geometries.items():
        holders = [[segment for segment in segments if name in segment.shown] for name in pair]
        if set(map(id, holders[0])) & set(map(id, holders[1])):
            continue  # within a segment
        for one, other in itertools.product(*holders):
            ours, theirs = one.shown[pair[0]], other.shown[pair[1]]
            entry = pair, *join_matches(ours, theirs, geometry.inlier_matches)
            if one.index > other.index:
                entry = pair[::-1], entry[2], entry[1]
            parts[min(one.index, other.index), max(one.index, other.index)].append(entry)
    return [
        SharedPoints(
            first, second, np.concatenate([ours for _, ours, _ in entries]),
            np.concatenate([theirs for _, _, theirs in entries]),
            np.repeat(np.arange(len(entries)), [len(ours) for _, ours, _ in entries]),
            tuple(pair for pair, _, _ in entries))
        for (first, second), entries in sorted(parts.items())]


def _spots(xy: NDArray[np.float64]) -> NDArray[np.int64]:
    """Returns a number for each spot of an image, to a sixteenth of a pixel."""
    whole = np.round(xy * 16).astype(np.int64)
    return np.asarray(whole[:, 0] << 32 | whole[:, 1])


def join_matches(
    ours: ObservedPoints, theirs: ObservedPoints,
    matches: NDArray[np.uint32],  # [M, 2] keypoints of the two images
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:  # [K, 3], [K, 3]
    """Returns the points that matches of two images make one, where both show one."""
    left, right = (_find_rows(shown.rows, matches[:, side])
                   for side, shown in enumerate((ours, theirs)))
    both = (left >= 0) & (right >= 0)
    return ours.points[left[both]], theirs.points[right[both]]


def to_sim3d(similarity: Similarity) -> pycolmap.Sim3d:
    """Returns a similarity as COLMAP has it."""
    return pycolmap.Sim3d(
        similarity.scale, pycolmap.Rotation3d(similarity.rotation), similarity.translation)


def estimate_similarity(
    source: NDArray[np.float64],  # [N, 3]
    target: NDArray[np.float64],  # [N, 3]
    *,
    max_error: float,  # distance of two points that agree, in units of the target
    min_share: float = 0.0,  # of the points that must agree, besides MIN_POSE_INLIERS of them
    seed: int,
) -> AgreedSimilarity | None:
    """Returns the similarity from source to target, by RANSAC; None where too few points agree."""
    if len(source) < MIN_POSE_INLIERS:
        return None
    options = pycolmap.RANSACOptions()
    options.max_error = max_error
    options.max_num_trials = MAX_TRIALS
    options.random_seed = seed
    found = pycolmap.estimate_sim3d_robust(source, target, options)
    if found is None or found["num_inliers"] < max(MIN_POSE_INLIERS, min_share * len(source)):
        return None
    motion = found["tgt_from_src"]
    return AgreedSimilarity(
        Similarity(float(motion.scale), motion.rotation.matrix(), np.asarray(motion.translation)),
        np.flatnonzero(found["inlier_mask"]))


def _find_rows(rows: NDArray[np.int64], wanted: NDArray[np.uint32]) -> NDArray[np.int64]:
    """Returns where sorted rows hold the wanted ones, [M]; -1 where they do not."""
    if not len(rows):
        return np.full(len(wanted), -1)
    place = np.minimum(np.searchsorted(rows, wanted), len(rows) - 1)
    return np.where(rows[place] == wanted, place, -1)
