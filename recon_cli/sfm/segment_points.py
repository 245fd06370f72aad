"""What the models of segments show: their cameras, and the points that their frames show.

A whole model is one segment. Points of two segments are one where a frame in common shows both at
one spot, or where verified pairs of their frames match them.
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon_cli.io.colmap_library import pycolmap
from recon_cli.sfm.matching import Pair
from recon_cli.sfm.segment_joins import SegmentCameras, SharedPoints


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


def describe_segment(index: int, model: pycolmap.Reconstruction) -> Segment:
    """Returns a model as a segment."""
    images = sorted((model.image(number) for number in model.reg_image_ids()),
                    key=lambda image: image.name)
    places = {number: point.xyz for number, point in model.points3D.items()}
    shown, depths = {}, []
    for image in images:
        seen = [(row, point.xy, places[point.point3D_id])
                for row, point in enumerate(image.points2D) if point.has_point3D()]
        points = np.array([xyz for _, _, xyz in seen]).reshape(-1, 3)
        shown[image.name] = ObservedPoints(
            np.array([row for row, _, _ in seen], np.int64),
            np.array([xy for _, xy, _ in seen]).reshape(-1, 2), points)
        depths.append(np.linalg.norm(points - image.projection_center(), axis=1))
    cameras = SegmentCameras(
        tuple(image.name for image in images),
        np.array([image.projection_center() for image in images]).reshape(-1, 3),
        np.array([image.cam_from_world().rotation.matrix() for image in images]).reshape(-1, 3, 3),
        float(np.median(np.concatenate([np.zeros(0), *depths]) if depths else [0.0])))
    return Segment(index, model, cameras, shown)


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
            left, right = (find_rows(shown.rows, geometry.inlier_matches[:, side])
                           for side, shown in enumerate((ours, theirs)))
            both = (left >= 0) & (right >= 0)
            entry = pair, ours.points[left[both]], theirs.points[right[both]]
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


def find_rows(rows: NDArray[np.int64], wanted: NDArray[np.uint32]) -> NDArray[np.int64]:
    """Returns where sorted rows hold the wanted ones, [M]; -1 where they do not."""
    if not len(rows):
        return np.full(len(wanted), -1)
    place = np.minimum(np.searchsorted(rows, wanted), len(rows) - 1)
    return np.where(rows[place] == wanted, place, -1)
