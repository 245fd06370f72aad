"""Whether a capture can be mapped and a model trusted; each failed check says what to do.

A mapper's own figures do not show a failure: turning on the spot gave a model of 15 of 16 frames
with a reprojection error of 0.1 pixels.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from recon_cli.errors import SfmError, list_names, name_command
from recon_cli.scene.matches import MIN_PAIR_INLIERS
from recon_cli.sfm.limits import MAX_FLAT_SHARE, MIN_FRAMES, MIN_PARALLAX_DEG

_MOVE = (
    "Record again while walking: move the camera sideways around the room instead of turning on "
    "the spot.")


def check_texture(keypoints: Mapping[str, int]) -> None:
    """Raises SfmError when fewer than three frames have enough features to be matched."""
    usable = sum(count >= MIN_PAIR_INLIERS for count in keypoints.values())
    if usable >= MIN_FRAMES:
        return
    raise SfmError(
        f"No features: {usable} of {len(keypoints)} frames show any texture, but at least "
        f"{MIN_FRAMES} must.",
        hint="Record again with more light and with furniture in view: bare walls and darkness "
        "cannot be matched.")


def check_motion(pairs: int, matches: int, flat: int) -> None:
    """Raises SfmError when no pair of frames matches, or none shows depth.

    Of the verified matches, `flat` belong to pairs that a homography explains.
    """
    if pairs == 0:
        raise SfmError(
            "No two frames match.",
            hint="Use more frames of one room, so that neighbours overlap by two thirds: "
            f"{name_command('ingest --frames N')}.")
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
        hint=f"Use more frames, so that neighbours overlap ({name_command('ingest --frames N')}), "
        "match all "
        "of them (--pairs exhaustive), or accept a part of the room with a lower --min-registered.")


def shows_depth(median_angle_deg: float) -> bool:
    """Returns whether the points are seen from places far enough apart."""
    return median_angle_deg >= MIN_PARALLAX_DEG


def check_parallax(median_angle_deg: float) -> None:
    """Raises SfmError when the points are seen from nearly one place, so that depth is unsure."""
    if not shows_depth(median_angle_deg):
        raise SfmError(
            f"The camera did not move enough: half of the points are seen at angles below "
            f"{median_angle_deg:.1f} degrees, but {MIN_PARALLAX_DEG:g} are needed.",
            hint=_MOVE)
