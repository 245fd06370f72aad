"""How high cameras are above the floor, in units of the model, stretch by stretch or room by room.

Who walks holds a camera at about the same height, and a tripod stays as it is. Where the height
changes by a third within a few steps while the model says little about the scale there, it is the
scale that has changed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from recon_cli.io.colmap_library import pycolmap
from recon_cli.scene.gravity import find_gravity
from recon_cli.scene.surfaces import find_floor
from recon_cli.sfm.features.sphere import is_panorama
from recon_cli.sfm.limits import MIN_STRETCH
from recon_cli.sfm.model_arrays import ModelArrays

LOOKED_AT = 20  # images that are looked at together, and half of them further on again
CONE_DEG = 8.0  # between the floor's normal and what is up for all cameras
# Between the down axis of a panorama and the mean of all, in the median: those of a tripod or of a
# camera that levels them agree by .55 degrees in an empty flat.
LEVEL_DEG = 2.0
COMPARED = 60  # images on either side of a cut in a walk whose heights are compared
# Steps of the log of that height on good walks, as a standard deviation: .02 to .07 on eight, .05
# by their squares. One larger than the other is to another surface, such as a table.
SPREAD, MAX_LOG_STEP = 0.05, 0.4


def measure_heights(
    model: pycolmap.Reconstruction, order: Sequence[str]
) -> NDArray[np.float64]:  # [F, 2]
    """Returns the height of each image's camera above the floor, and that of the ceiling above it.

    NaN where none is seen; ceilings are looked for by level panoramas alone. `order` are names of
    images with a camera as they were taken.
    """
    arrays = ModelArrays.from_model(model, order)
    count, centers = len(arrays.images), arrays.centers
    heights = np.full((count, 2), np.nan)
    level = _find_level(arrays.viewmats) if (
        all(is_panorama(image.camera) for image in arrays.images)) else None
    up = level if level is not None else find_gravity(arrays.points, arrays.viewmats).up
    if up is None:
        return heights
    # Each panorama looks all around; a walk shows the floor in a stretch.
    together, step = (LOOKED_AT, LOOKED_AT // 2) if level is None else (1, 1)
    for start in range(0, count - (together - step), step):
        rows = slice(start, start + together)
        shown = (arrays.image >= start) & (arrays.image < start + together)
        points = arrays.points[np.unique(arrays.point[shown])]
        for side, upward in enumerate((up,) if level is None else (up, -up)):
            floor = find_floor(points, centers[rows], upward, cone_deg=CONE_DEG)
            if floor is not None:
                own = centers[rows] @ floor.up - floor.height
                known = heights[rows, side]
                heights[rows, side] = np.where(np.isnan(known), own, (known + own) / 2)
    return heights


def _find_level(viewmats: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Returns up [3], by panoramas [F, 4, 4] whose down axes agree; None where they do not."""
    down = viewmats[:, 1, :3]
    mean = down.mean(axis=0)
    mean /= max(float(np.linalg.norm(mean)), 1e-9)
    off = np.degrees(np.arccos(np.clip(down @ mean, -1, 1)))
    return -mean if np.median(off) <= LEVEL_DEG else None


def compare_heights(heights: NDArray[np.float64], place: int) -> float | None:
    """Returns the log of the cameras' height behind a place in the walk over that before it.

    None where too few of them know their height, or the surfaces are not the same.
    """
    return compare_sides(heights[max(0, place - COMPARED):place], heights[place:place + COMPARED],
                         MIN_STRETCH)


def compare_sides(
    before: NDArray[np.float64], behind: NDArray[np.float64],  # [B, 2], [C, 2]
    least: int = 1,
) -> float | None:
    """Returns the log of the heights of some cameras over those of others; None as above.

    Where floor and ceiling are both known on both sides, it is the mean of both.
    """
    steps = []
    for first, second in zip(before.T, behind.T, strict=True):
        ours, theirs = (side[~np.isnan(side)] for side in (first, second))
        if min(len(ours), len(theirs)) >= least:
            step = float(np.log(np.median(theirs) / np.median(ours)))
            if abs(step) <= MAX_LOG_STEP:
                steps.append(step)
    return float(np.mean(steps)) if steps else None


def weigh_step(error: float, step: float) -> tuple[float, float]:
    """Returns the error of a relative scale once a step of the heights is known, and its offset.

    Both are taken for normal: what is most likely wrong then, or its deviation if that is more.
    """
    share = error**2 / (error**2 + SPREAD**2)
    off = share * abs(step)
    return max(off, float(np.sqrt(1 - share)) * error), off
