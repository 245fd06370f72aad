"""Whether a capture can be mapped and a model trusted; each failed check says what to do.

A mapper's own figures do not show a failure: turning on the spot gave a model of 15 of 16 frames
with a reprojection error of 0.1 pixels.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import pycolmap

from recon_cli.errors import SfmError

# Shift of the principal point as a share of the longer side. Measured: 0 to 0.025 in rooms, walks
# and photos of ten and more frames, 0.032 with three; 0.114 in a walk that was torn in two places,
# 0.97 of whose matches agreed with the cameras.
MAX_SHIFT = 0.06


def describe_shifted_centres(model: pycolmap.Reconstruction, database: Path) -> list[str]:
    """Returns a sentence for each camera of a model whose principal point moved too far.

    Args:
        model: the reconstruction.
        database: holds its cameras before mapping, under the same ids.
    """
    with pycolmap.Database.open(database) as opened:
        initial = {camera.camera_id: camera for camera in opened.read_all_cameras()}
    shifts = {number: _shift(camera, initial[number])
              for number, camera in sorted(model.cameras.items()) if number in initial}
    return [
        f"The principal point of camera {number} moved by {shift:.0%} of the image's longer side, "
        f"at most {MAX_SHIFT:.0%} is usual: parts of the model may be displaced against each other."
        for number, shift in shifts.items() if shift > MAX_SHIFT]


def _shift(camera: pycolmap.Camera, initial: pycolmap.Camera) -> float:
    off = math.hypot(camera.principal_point_x - initial.principal_point_x,
                     camera.principal_point_y - initial.principal_point_y)
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
    """Raises SfmError when fewer than three frames have enough features to be matched."""
    usable = sum(count >= MIN_KEYPOINTS for count in keypoints.values())
    if usable >= MIN_FRAMES:
        return
    raise SfmError(
        f"No features: {usable} of {len(keypoints)} frames show any texture, but at least "
        f"{MIN_FRAMES} are needed.",
        hint="Record again with more light and with furniture in view: bare walls and darkness "
        "cannot be matched.")


def check_motion(pairs: int, matches: int, flat: int) -> None:
    """Raises SfmError when no pair of frames matches, or none shows depth.

    Args:
        pairs: verified pairs of frames.
        matches: verified matches in all of them.
        flat: those of pairs that a homography explains.
    """
    if pairs == 0:
        raise SfmError(
            "No two frames match.",
            hint="Use more frames of one room, so that neighbours overlap by two thirds: "
            "recon ingest --frames N.")
    if flat > MAX_FLAT_SHARE * matches:
        raise SfmError(
            f"The camera did not move, or sees only one flat surface: {flat / matches:.0%} of the "
            f"matches show no depth, but at most {MAX_FLAT_SHARE:.0%} may.",
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
        f"needed. Missing: {list_names(missing)}.",
        hint="Use more frames, so that neighbours overlap (recon ingest --frames N), match all of "
        "them (--pairs exhaustive), or accept a part of the room with a lower --min-registered.")


def check_parallax(median_angle_deg: float) -> None:
    """Raises SfmError when the points are seen from nearly one place, so that depth is unsure."""
    if median_angle_deg < MIN_ANGLE_DEG:
        raise SfmError(
            f"The camera did not move enough: half of the points are seen at angles below "
            f"{median_angle_deg:.1f} degrees, but {MIN_ANGLE_DEG:g} are needed.",
            hint=_MOVE)


def list_names(names: Sequence[str], most: int = 5) -> str:
    """Returns the first names and the number of the others."""
    more = len(names) - most
    return ", ".join(names[:most]) + (f" and {more} more" if more > 0 else "")
