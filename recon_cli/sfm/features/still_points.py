"""Points that stay where they are in the image while the camera moves: text, a logo, a dirty lens.

They hold a model together that means nothing: 235 of 465 points of a walk past a bare wall were the
text that its recorder had written into every frame.
"""

from __future__ import annotations

import numpy as np

from recon_cli.io.colmap_library import pycolmap
from recon_cli.scene.statistics import MIN_OBSERVATIONS
from recon_cli.sfm.model_arrays import ModelArrays

# Of the image's longer side: the diagonal of the box around all spots where a point was found.
MAX_SPREAD = 0.005
MAX_STILL = 0.1


def find_still_share(model: pycolmap.Reconstruction) -> float:
    """Returns the share of the points in three or more images that do not move in them."""
    arrays = ModelArrays.from_model(model)
    if not len(arrays.point):
        return 0.0
    sizes = np.array([max(image.camera.width, image.camera.height) for image in arrays.images])
    order = np.argsort(arrays.point, kind="stable")
    sorted_spots = (arrays.xy / sizes[arrays.image, None])[order]
    _, starts, counts = np.unique(arrays.point[order], return_index=True, return_counts=True)
    spread = np.linalg.norm(
        np.maximum.reduceat(sorted_spots, starts) - np.minimum.reduceat(sorted_spots, starts),
        axis=1)
    still = spread[counts >= MIN_OBSERVATIONS] < MAX_SPREAD
    return float(still.mean()) if len(still) else 0.0
