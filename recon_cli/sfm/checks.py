"""Whether a capture can be mapped and a model be trusted; each check says what to do about it.

A mapper that finds little says little, and one that is led astray still reports a small
reprojection error: turning on the spot gave a model of 15 of 16 frames with an error of 0.1 pixels.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from recon_cli.errors import SfmError

BINS = 10


@dataclass(frozen=True)
class Histogram:
    """How often counts fall between edges.

    Attributes:
        edges: bin k holds the counts from edges[k] up to, but without, edges[k + 1].
        counts: one less than there are edges.
        median: of all counts; zero where there are none.
    """

    edges: tuple[int, ...]
    counts: tuple[int, ...]
    median: float

    @classmethod
    def of(cls, values: NDArray[np.int64]) -> Histogram:
        """Returns the histogram of whole numbers, [N], from zero up, in ten bins of one width."""
        top = int(values.max()) if len(values) else 0
        width = top // BINS + 1
        counts = np.bincount(values // width, minlength=BINS)
        return cls(
            tuple(range(0, (BINS + 1) * width, width)),
            tuple(int(count) for count in counts),
            float(np.median(values)) if len(values) else 0.0)

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> Histogram:
        """Returns a histogram whose fields came as lists."""
        return cls(tuple(value["edges"]), tuple(value["counts"]), value["median"])


# Shift of the principal point as a share of the longer side. Measured: 0 to 0.025 in rooms, walks
# and photos of ten and more frames, 0.032 with three; 0.114 in a walk that was torn in two places,
# 0.97 of whose matches agreed with the cameras.
MAX_SHIFT = 0.06


def bent(model: pycolmap.Reconstruction, database: Path) -> list[str]:
    """Returns a sentence for each camera of a model whose principal point went too far.

    Args:
        model: the reconstruction.
        database: holds its cameras as the mapper began with them, under the same ids.
    """
    with pycolmap.Database.open(database) as opened:
        begun = {camera.camera_id: camera for camera in opened.read_all_cameras()}
    shifts = {number: _shift(camera, begun[number])
              for number, camera in sorted(model.cameras.items()) if number in begun}
    return [
        f"The principal point of camera {number} has gone {shift:.0%} of the image's side from "
        f"where it was expected, at most {MAX_SHIFT:.0%} is usual: parts of the model may be "
        "displaced against each other."
        for number, shift in shifts.items() if shift > MAX_SHIFT]


def _shift(camera: pycolmap.Camera, begun: pycolmap.Camera) -> float:
    off = math.hypot(camera.principal_point_x - begun.principal_point_x,
                     camera.principal_point_y - begun.principal_point_y)
    return off / float(max(camera.width, camera.height))


MIN_FRAMES = 3
# COLMAP accepts a pair of images from 15 inliers on.
MIN_KEYPOINTS = 15
# Share of the verified matches that lie in pairs explained by one homography, which is what a
# camera turning on the spot, or one flat surface, gives. Measured: 0.03 to 0.38 in photos and walks
# around rooms, 0.50 in a short walk with small steps, 0.99 and 1.00 in two turns on the spot.
MAX_FLAT_SHARE = 0.9
# COLMAP drops points below 1.5 degrees, so that no median lies under that. Measured medians: 13 and
# 14 in the rendered rooms, 23 around an object, 7.2 in a short walk, 3.9 in a capture that failed.
MIN_ANGLE_DEG = 2.0

_MOVE = (
    "Record again while walking: move the camera sideways around the room instead of turning on "
    "the spot.")


def check_texture(keypoints: Mapping[str, int]) -> None:
    """Raises SfmError when fewer than three frames hold anything that could be matched."""
    usable = sum(count >= MIN_KEYPOINTS for count in keypoints.values())
    if usable >= MIN_FRAMES:
        return
    raise SfmError(
        f"No features: {usable} of {len(keypoints)} frames show any texture, but at least "
        f"{MIN_FRAMES} are needed.",
        hint="Check that the capture shows more than bare walls and darkness; record again with "
        "more light and with furniture in view.")


def check_motion(pairs: int, matches: int, flat: int) -> None:
    """Raises SfmError when no pair of frames matches, or none shows depth.

    Args:
        pairs: verified pairs of frames.
        matches: verified matches in all of them.
        flat: those of pairs that a homography explains.
    """
    if pairs == 0:
        raise SfmError(
            "No two frames show the same things.",
            hint="Use more frames of the same room, so that neighbours overlap by two thirds: "
            "recon ingest --frames N.")
    if flat > MAX_FLAT_SHARE * matches:
        raise SfmError(
            f"The camera did not move, or sees one flat surface only: {flat / matches:.0%} of the "
            f"matches show no depth, at most {MAX_FLAT_SHARE:.0%} may.",
            hint=_MOVE)


def check_registered(
    names: Sequence[str], registered: Sequence[str], min_registered: float
) -> None:
    """Raises SfmError when too few of the frames `names` have a camera."""
    needed = max(MIN_FRAMES, math.ceil(min_registered * len(names)))
    if len(registered) >= needed:
        return
    missing = sorted(set(names) - set(registered))
    raise SfmError(
        f"Only {len(registered)} of {len(names)} frames have a camera, but at least {needed} are "
        f"needed. Missing: {listed(missing)}.",
        hint="Use more frames, so that neighbours overlap (recon ingest --frames N), match all of "
        "them (--pairs exhaustive), or accept a part of the room with a lower --min-registered.")


def check_parallax(median_angle_deg: float) -> None:
    """Raises SfmError when the points are seen from nearly one place, so that depth is a guess."""
    if median_angle_deg < MIN_ANGLE_DEG:
        raise SfmError(
            f"The camera did not move enough: half of the points are seen under less than "
            f"{median_angle_deg:.1f} degrees, at least {MIN_ANGLE_DEG:g} are needed.",
            hint=_MOVE)


def listed(names: Sequence[str], most: int = 5) -> str:
    """Returns the first names, and how many more there are."""
    more = len(names) - most
    return ", ".join(names[:most]) + (f" and {more} more" if more > 0 else "")
