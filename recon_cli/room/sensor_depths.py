"""Depth of a sensor in the depth maps of a mesh: it goes before stereo and the Gaussians.

Where the images are blank, as on bare walls, neither of those knows where the surface is.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.io.images import reduce_view
from recon_cli.room.depth_maps import DepthMaps, weigh
from recon_cli.scene.train_view import SensorDepth, TrainView
from recon_cli.stereo.depths import TOLERANCE

_WINDOW = 5  # samples a side, whose mean has less noise; beside edges there are none
_LEAST_SIDE = 32  # pixels; smaller maps show no surface
# Of a depth, or standard deviations of the sensor's noise, beyond which it says otherwise.
_DEVIATIONS = 2.0


def with_sensor(maps: DepthMaps) -> DepthMaps:
    """Returns the depth maps and, after them, those of the views that have sensor depth.

    What any other map of such a view says differently counts for nothing there.
    """
    added = [(row, *_sensor_map(view)) for row, view in enumerate(maps.views)
             if view.depth is not None and _side(view.depth, view) >= _LEAST_SIDE]
    if not added:
        return maps
    depths, gains = list(maps.depths), list(maps.gains)
    for row, _, depth in added:
        sensor = maps.views[row].depth
        assert sensor is not None
        allowed = max(TOLERANCE, _DEVIATIONS * sensor.noise)
        for other, camera in enumerate(maps.cameras):
            if not np.array_equal(camera.viewmat, maps.cameras[row].viewmat):
                continue
            own = depths[other]
            known = cv2.resize(depth, own.shape[::-1], interpolation=cv2.INTER_NEAREST)
            differs = (known > 0) & (np.abs(own - known) > allowed * known)
            depths[other] = np.where(differs, 0, own).astype(np.float32)
            gains[other] = np.where(differs, 0, gains[other]).astype(np.float32)
    views = [view for _, view, _ in added]
    measured = weigh(
        views, [view.camera for view in views], [depth for _, _, depth in added],
        [(depth > 0).astype(np.float32) for _, _, depth in added])
    return DepthMaps(
        [*maps.views, *views], [*maps.cameras, *measured.cameras], [*depths, *measured.depths],
        [*gains, *measured.gains], maps.median)


def _side(depth: SensorDepth, view: TrainView) -> float:
    """Returns the shorter side of a view in pixels of as many as there are samples."""
    camera = view.camera
    return min(camera.width, camera.height) * math.sqrt(
        depth.cells / (camera.width * camera.height))


def _sensor_map(view: TrainView) -> tuple[TrainView, NDArray[np.float32]]:
    """Returns a view of as many pixels as its sensor has samples, and the depth [H, W] in it."""
    assert view.depth is not None
    camera = view.camera
    small = reduce_view(view, max(1.0, math.sqrt(
        camera.width * camera.height / view.depth.cells)))
    depth = view.depth.image(small.camera, small.mask)
    known = (depth > 0).astype(np.float32)
    # inverse depth, as that of a plane is linear in the image
    inverse = known / np.where(depth > 0, depth, 1)
    total, count = (cv2.boxFilter(one, -1, (_WINDOW, _WINDOW), normalize=False,
                                  borderType=cv2.BORDER_CONSTANT) for one in (inverse, known))
    mean = np.where(known > 0, count / np.maximum(total, 1e-12), 0)
    return small, mean.astype(np.float32)
