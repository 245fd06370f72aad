"""Sensor depth of the views of a scene, in the units of its model, with the noise that it shows.

Scale and noise are measured at the points of the model: a sensor whose depth does not fit them, as
one with swapped rows or of another capture, is not used.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.io.colmap import read_visibility
from recon_cli.io.depth_maps import (
    LEAST_POINTS,
    MEDIAN,
    MOST_NOISE,
    DepthMap,
    find_edges,
    find_visible,
    lens_camera,
    read_depth_list,
    read_sure_depth,
)
from recon_cli.scene.camera import Camera, Lens
from recon_cli.scene.covisibility import observe_points
from recon_cli.scene.scene import Scene, View
from recon_cli.scene.statistics import COARSE_SAMPLE, OUTLIER_SIGMAS, robust_sigma
from recon_cli.scene.train_view import SensorDepth

MOST_SAMPLES = 16_000  # of a map, for training: one for 4 to 13 pixels of an image
SAMPLE_BYTES = 3 * np.dtype(np.float32).itemsize  # ray and depth
ALL_SAMPLES = 400_000  # for meshes: every pixel of the sensors of phones and cheap cameras
FEWEST_POINTS = 200  # of all views
LEAST_NOISE = 0.002  # relative; what depth of 16 bits and the nearest pixel leave
# A view whose depths are off in the median by this share, or beyond the noise, shows something else
# than its image, as with timestamps that do not match.
MOST_OFF = 0.05
_AROUND = np.ones((3, 3), np.uint8)


@dataclass(frozen=True, eq=False)
class SensorViews:
    """The depth of some views of a scene, and how well it fits the model."""

    depths: dict[str, SensorDepth] = field(default_factory=dict)  # by name of the view
    refused: str = ""  # why none is used although there is some, as part of a sentence
    metres: float = 1.0  # of a unit of the model, if the sensor's unit is the metre
    left_out: tuple[str, ...] = ()  # names of the views whose depth contradicts the others


def read_sensor_depth(scene: Scene, *, most_samples: int = MOST_SAMPLES) -> SensorViews:
    """Returns the depth of the training views that a sensor measured, where it is sure.

    Beside edges, with less than the highest confidence, or beyond the sensor's reach depth is left
    out, and of a larger map some of the pixels, evenly spread. FormatError if a file is damaged.
    """
    maps = {} if scene.depth is None else read_depth_list(scene.depth)
    views = [view for view in scene.train if view.name in maps and view.face_of is None]
    if not views:
        return SensorViews()
    assert scene.depth is not None
    seen = _visible_points(scene, views)
    found, ratios = {}, {}
    for view in views:
        depth = _read(scene.depth, view.name, maps[view.name])
        ratios[view.name] = _compare(depth, maps[view.name].lens, view.camera,
                                     scene.points[seen[view.name]])
        found[view.name] = _sample(depth, maps[view.name].lens, view.camera, most_samples)
    return _fit(found, ratios)


def _read(folder: Path, name: str, one: DepthMap) -> NDArray[np.float32]:
    """Returns the sure depth [h, w] of a map in its own unit, 0 elsewhere and beside edges."""
    depth = read_sure_depth(folder, name, one)
    # of a median, as noise of 2% would be edges everywhere
    depth[find_edges(cv2.medianBlur(depth, MEDIAN)) | (cv2.erode(depth, _AROUND) == 0)] = 0
    return depth


def _visible_points(scene: Scene, views: Sequence[View]) -> dict[str, NDArray[np.int64]]:
    """Returns the rows of the points that each view sees; without tracks those in its image."""
    tracks = {} if scene.sparse is None else read_visibility(scene.sparse)
    if any(map(len, tracks.values())):
        nothing = np.empty(0, np.int64)
        return {view.name: tracks.get(view.name, nothing) for view in views}
    some = np.arange(0, len(scene.points), max(1, len(scene.points) // COARSE_SAMPLE))
    shown = observe_points(scene.points[some], [view.camera for view in views]).matrix.toarray() > 0
    return {view.name: some[row] for view, row in zip(views, shown, strict=True)}


def _compare(
    depth: NDArray[np.float32], lens: Lens, camera: Camera, points: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns the sensor's depth over the model's at points [P, 3], where both are known."""
    local = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    rows, column, line = find_visible(lens_camera(lens), local)
    theirs, ours = depth[line, column].astype(np.float64), local[rows, 2]
    return np.asarray(theirs[theirs > 0] / ours[theirs > 0])


@cache
def _rays(lens: Lens, step: int) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Returns rows and columns [2, K] of every step-th pixel of a lens, and their rays [K, 2]."""
    grid = np.mgrid[step // 2:lens.height:step, step // 2:lens.width:step].reshape(2, -1)
    rays = np.asarray(lens_camera(lens).cam_from_img(grid[::-1].T + 0.5)).reshape(-1, 2)
    return grid, rays.astype(np.float32)


def _sample(
    depth: NDArray[np.float32], lens: Lens, camera: Camera, most: int
) -> SensorDepth:
    """Returns up to `most` samples of a map that lie in the image of its view; no noise yet."""
    grid, rays = _rays(lens, max(1, math.ceil(math.sqrt(depth.size / most))))
    at = rays * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    inside = ((at >= 0) & (at < (camera.width, camera.height))).all(axis=1)  # not what is NaN
    values = depth[grid[0], grid[1]]
    used = inside & (values > 0)
    return SensorDepth(rays[used], values[used], 0.0, max(1, int(inside.sum())))


def _fit(
    found: dict[str, SensorDepth], ratios: dict[str, NDArray[np.float64]]
) -> SensorViews:
    """Returns the depths in units of the model, by the sensor's depth over that of the model."""
    every = np.concatenate([*ratios.values()])
    if len(every) < FEWEST_POINTS:
        return SensorViews(refused=f"only {len(every)} points of the model show how it fits")
    medians = {name: float(np.median(values)) for name, values in ratios.items()
               if len(values) >= LEAST_POINTS}
    scale = float(np.median([*medians.values()] or [np.median(every)]))
    noise = robust_sigma(every / scale - 1)
    if noise > MOST_NOISE:
        return SensorViews(refused=f"it differs from the points of the model by {noise:.0%}")
    noise = max(noise, LEAST_NOISE)
    off = max(MOST_OFF, OUTLIER_SIGMAS * noise)
    left_out = tuple(name for name, value in medians.items() if abs(value / scale - 1) > off)
    return SensorViews({
        name: replace(one, depths=(one.depths / scale).astype(np.float32), noise=noise)
        for name, one in found.items() if name not in left_out and len(one.depths)},
        metres=scale, left_out=left_out)
