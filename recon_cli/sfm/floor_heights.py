"""How high the cameras of a walk are above the floor, in units of the model, stretch by stretch.

Who walks holds a camera at about the same height. Where the height changes by a third within a few
steps while the model says little about the scale there, it is the scale that has changed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from recon_cli.io.colmap_library import pycolmap
from recon_cli.scene.gravity import find_gravity
from recon_cli.scene.surfaces import find_floor

LOOKED_AT = 20  # images that are looked at together, and half of them further on again
CONE_DEG = 8.0  # between the floor's normal and what is up for all cameras
# Images on either side of a cut whose heights are compared, and how many must know theirs.
COMPARED, LEAST_HEIGHTS = 60, 10
# Steps of the log of that height on good walks, as a standard deviation: .02 to .07 on eight, .05
# by their squares. One larger than the other is to another surface, such as a table.
SPREAD, MAX_LOG_STEP = 0.05, 0.4


def measure_heights(
    model: pycolmap.Reconstruction, order: Sequence[str]
) -> NDArray[np.float64]:  # [F]
    """Returns the height of each image's camera above the floor; NaN where none is seen.

    `order` are names of images with a camera as they were taken.
    """
    images = [model.find_image_with_name(name) for name in order]
    viewmats = np.array([
        np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]) for image in images])
    places = {number: point.xyz for number, point in model.points3D.items()}
    heights = np.full(len(images), np.nan)
    gravity = find_gravity(np.array(list(places.values())).reshape(-1, 3), viewmats)
    if gravity.up is None:
        return heights
    centers = np.array([image.projection_center() for image in images])
    shown = [{spot.point3D_id for spot in image.points2D if spot.has_point3D()}
             for image in images]
    for start in range(0, len(images) - LOOKED_AT // 2, LOOKED_AT // 2):
        rows = slice(start, start + LOOKED_AT)
        seen = set().union(*shown[rows])
        points = np.array([places[number] for number in sorted(seen)]).reshape(-1, 3)
        floor = find_floor(points, centers[rows], gravity.up, cone_deg=CONE_DEG)
        if floor is not None:
            own = centers[rows] @ floor.up - floor.height
            known = heights[rows]
            heights[rows] = np.where(np.isnan(known), own, (known + own) / 2)
    return heights


def compare_heights(heights: NDArray[np.float64], place: int) -> float | None:
    """Returns the log of the cameras' height behind a place in the walk over that before it.

    None where too few of them know their height, or the surfaces are not the same.
    """
    before, behind = (side[~np.isnan(side)] for side in (
        heights[max(0, place - COMPARED):place], heights[place:place + COMPARED]))
    if min(len(before), len(behind)) < LEAST_HEIGHTS:
        return None
    step = float(np.log(np.median(behind) / np.median(before)))
    return step if abs(step) <= MAX_LOG_STEP else None
