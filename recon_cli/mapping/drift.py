"""How far the lens of a model has moved from where the mapper began: a sign of a torn walk.

A last adjustment that cannot reconcile two halves bends the lens until it does. Their matches then
agree with the poses, and only the lens tells. It knows no lens that is right, only one that is far
from the middle of the image, or from what was known of it.
"""

from __future__ import annotations

import math
from pathlib import Path

import pycolmap

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
