"""Which way is up by a phone's accelerometer, to check the world of its poses.

CoreMotion's raw acceleration is that of gravity and of the hand, in the axes of the device: x right
and y up of the upright screen, z out of it. The camera's x axis goes along the device from top to
bottom (ARKit's ARCamera.transform), so that x, y, z of OpenCV's camera are -y, -x, -z of the
device. Its unit is g, or m/s^2 by the version of the app; only its direction is used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.datasets.frame_files import numbers, read_csv
from recon_cli.scene.gravity import MAX_UP_SPREAD_DEG

_COLUMNS = ("timestamp", "a_x", "a_y", "a_z")
_FROM_DEVICE = np.array([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]])
_UNITS = (1.0, 9.81)  # lengths of gravity
_OFF_UNIT = 0.15  # share by which the median length may miss them
_WINDOW = 0.5  # seconds around a frame, over which steps of a walk average out
_FEWEST = 10  # frames
_LEAST_TURN_DEG = 30.0  # between frames; with less, any axes would agree


@dataclass(frozen=True, eq=False)
class MeasuredUp:
    """Up by an accelerometer."""

    up: NDArray[np.float64]  # [3] unit vector in the world of the poses
    spread_deg: float  # median angle of single frames to it
    turn_deg: float  # by which the cameras turn about any axis

    @property
    def is_sure(self) -> bool:
        """Whether frames that look different ways agree, so that axes and times must be right."""
        return self.spread_deg <= MAX_UP_SPREAD_DEG and self.turn_deg >= _LEAST_TURN_DEG


def read_gravity(
    path: Path, times: Sequence[float],
    viewmats: NDArray[np.float64],  # [F, 4, 4] world to camera, at those times
) -> MeasuredUp | None:
    """Returns up by a file of accelerations; None if too few frames have any, or its unit is none.

    FormatError if columns are missing.
    """
    rows = []
    for row in read_csv(path, _COLUMNS):
        try:
            rows.append(numbers(row, _COLUMNS))
        except (KeyError, ValueError):
            continue  # cut short
    values = np.array(rows).reshape(-1, 4)
    values = values[np.isfinite(values).all(axis=1)]
    values = values[np.argsort(values[:, 0], kind="stable")]
    if not len(values):
        return None
    usual = float(np.median(np.linalg.norm(values[:, 1:], axis=1)))
    if min(abs(usual / unit - 1) for unit in _UNITS) > _OFF_UNIT:
        return None
    ends = [np.searchsorted(values[:, 0], np.asarray(times) + side * _WINDOW / 2)
            for side in (-1, 1)]
    directions, used = [], []
    for frame, (first, last) in enumerate(zip(*ends, strict=True)):
        if last > first:
            mean = _FROM_DEVICE @ values[first:last, 1:].mean(axis=0)
            directions.append(viewmats[frame, :3, :3].T @ mean)
            used.append(frame)
    if len(used) < _FEWEST:
        return None
    return _average(np.array(directions), viewmats[used, :3, :3])


def _average(
    down: NDArray[np.float64],  # [F, 3] accelerations in the world
    rotations: NDArray[np.float64],  # [F, 3, 3]
) -> MeasuredUp | None:
    down = down / np.maximum(np.linalg.norm(down, axis=1, keepdims=True), 1e-12)
    mean = np.median(down, axis=0)
    length = float(np.linalg.norm(mean))
    if length < 1e-6:
        return None
    angles = np.degrees(np.arccos(np.clip(down @ mean / length, -1, 1)))
    cosines = (np.einsum("nij,ij->n", rotations, rotations[0]) - 1) / 2
    return MeasuredUp(-mean / length, float(np.median(angles)),
                   float(np.degrees(np.arccos(np.clip(cosines.min(), -1, 1)))))
