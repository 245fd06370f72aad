"""Points that stay where they are in the image while the camera moves: text, a logo, a dirty lens.

They hold a model together that means nothing: 235 of 465 points of a walk past a bare wall were the
text that its recorder had written into every frame.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recon_cli.io.colmap_library import pycolmap
from recon_cli.sfm.limits import MIN_TRACK_LENGTH

# Of the image's longer side: the diagonal of the box around all spots where a point was found.
MAX_SPREAD = 0.005
MAX_STILL = 0.1


def find_still_share(model: pycolmap.Reconstruction) -> float:
    """Returns the share of the points in three or more images that do not move in them."""
    points: list[int] = []
    spots: list[NDArray[np.float64]] = []
    for index in model.reg_image_ids():
        image = model.image(index)
        size = max(image.camera.width, image.camera.height)
        for spot in image.points2D:
            if spot.has_point3D():
                points.append(spot.point3D_id)
                spots.append(spot.xy / size)
    if not points:
        return 0.0
    numbers = np.array(points)
    order = np.argsort(numbers, kind="stable")
    sorted_spots = np.array(spots)[order]
    _, starts, counts = np.unique(numbers[order], return_index=True, return_counts=True)
    spread = np.linalg.norm(
        np.maximum.reduceat(sorted_spots, starts) - np.minimum.reduceat(sorted_spots, starts),
        axis=1)
    still = spread[counts >= MIN_TRACK_LENGTH] < MAX_SPREAD
    return float(still.mean()) if len(still) else 0.0
