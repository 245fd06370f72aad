"""Points that stay where they are in the image while the camera moves: text, a logo, a dirty lens.

They hold a model together that means nothing: 235 of 465 points of a walk past a bare wall were the
text that its recorder had written into every frame.
"""

from __future__ import annotations

import numpy as np
import pycolmap

# A point says something from three images on; two that follow each other may be alike.
MIN_IMAGES = 3
# Of the image's longer side: the box around all places where a point was found in the images.
MAX_SPREAD = 0.005
MAX_STILL = 0.1


def find_still_share(model: pycolmap.Reconstruction) -> float:
    """Returns the share of the points in three or more images that do not move in them."""
    images = {i: model.image(i) for i in model.reg_image_ids()}
    places = {i: np.array([point.xy for point in image.points2D]) for i, image in images.items()}
    sizes = {i: max(image.camera.width, image.camera.height) for i, image in images.items()}
    still = total = 0
    for point in model.points3D.values():
        elements = point.track.elements
        if len({element.image_id for element in elements}) < MIN_IMAGES:
            continue
        found = np.array([places[element.image_id][element.point2D_idx] for element in elements])
        spread = float(np.linalg.norm(np.ptp(found, axis=0))) / sizes[elements[0].image_id]
        total += 1
        still += spread < MAX_SPREAD
    return still / max(total, 1)
