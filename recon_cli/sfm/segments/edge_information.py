"""What a model knows of each frame of a walk against the next: where it may have drifted.

Scale passes from one stretch of a walk to the next by points that both have triangulated by
themselves. Where a camera turns on the spot or in a narrow place there are few, or their rays
hardly open, and the model may continue in another scale without a visible error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon_cli.io.colmap_library import pycolmap
from recon_cli.sfm.model_arrays import ModelArrays

# Frames; whatever shows a point again after more than so many has come back to it.
RUN = 20
# Errors of points in a model are not independent: times what they would be then.
INFLATION = 3.0
# Most and least of the deviations: of the logarithm of a scale, of a rotation in radians.
SCALES, TURNS = (0.002, 1.0), (0.0005, 0.5)
LEAST_ERROR = 0.1  # pixels that the best of models is off
TURN_PIXELS = 3.0  # by which the place of a point is off from one frame to the next


@dataclass(frozen=True, eq=False)
class EdgeInformation:
    """Standard deviations of what each of F frames in a row has against the next, [F - 1]."""

    scale: NDArray[np.float64]  # of the logarithm of their relative scale
    turn: NDArray[np.float64]  # of their relative rotation, radians
    shift: NDArray[np.float64]  # of their distance, units of the model
    loops: NDArray[np.int64]  # [L, 2], rows of frames that show one point, more than RUN apart
    points: NDArray[np.float64]  # [L, 3], that point


@dataclass(frozen=True, eq=False)
class _Observations:
    """O observations of points, sorted by point, then by frame."""

    frame: NDArray[np.int64]  # [O]
    point: NDArray[np.float64]  # [O, 3]
    rays: NDArray[np.float64]  # [O, 3], unit vectors to the camera
    depth: NDArray[np.float64]  # [O]
    starts: NDArray[np.bool_]  # [O], whether it is the first of a run of observations
    returns: NDArray[np.bool_]  # [O], whether it is the first after a gap of more than RUN frames


def measure_information(model: pycolmap.Reconstruction, names: Sequence[str]) -> EdgeInformation:
    """Returns what a model knows of its frames, whose names are given in order."""
    arrays = ModelArrays.from_model(model, names)
    images, seen = arrays.images, _observe(arrays)
    error = max(model.compute_mean_reprojection_error(), LEAST_ERROR)
    noise = error / images[0].camera.mean_focal_length()
    run = np.cumsum(seen.starts) - 1
    first = np.flatnonzero(seen.starts)
    last = np.append(first[1:], len(run)) - 1
    before = _opening(seen.rays, seen.rays[first[run]], run)
    after = _opening(seen.rays[::-1], seen.rays[last[run]][::-1], -run[::-1])[::-1]
    split = np.flatnonzero(~seen.starts[1:])  # between an observation and the next of its run
    with np.errstate(divide="ignore"):
        known = 1 / ((noise / before[split]) ** 2 + (noise / after[split + 1]) ** 2)
    scale, count = (
        np.maximum(_sum_between(seen.frame[split], seen.frame[split + 1], value, len(images)), 1e-9)
        for value in (known, np.ones(len(split))))
    turn = np.clip(INFLATION * TURN_PIXELS * noise / np.sqrt(count), *TURNS)
    usual = _usual_depths(seen, len(images))
    loops = np.flatnonzero(seen.returns)
    return EdgeInformation(
        np.clip(INFLATION / np.sqrt(scale), *SCALES), turn,
        turn * np.minimum(usual[1:], usual[:-1]),
        np.column_stack([seen.frame[loops - 1], seen.frame[loops]]), seen.point[loops])


def _observe(arrays: ModelArrays) -> _Observations:
    point, frame = np.unique(np.column_stack([arrays.point, arrays.image]), axis=0).T
    rays = arrays.centers[frame] - arrays.points[point]
    depth = np.linalg.norm(rays, axis=1)
    new = np.append(True, point[1:] != point[:-1])[:len(point)]
    returns = ~new & (np.diff(frame, prepend=0) > RUN)
    return _Observations(
        frame, arrays.points[point], rays / depth[:, None], depth, new | returns, returns)


def _opening(
    rays: NDArray[np.float64], origins: NDArray[np.float64], run: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Returns the widest angle of the rays of a run, up to each, with its origin, [O] radians."""
    angles = np.arccos(np.clip((rays * origins).sum(axis=1), -1, 1))
    apart = 4.0 * (run - run[:1])  # by more than any angle
    return np.asarray(np.maximum.accumulate(angles + apart) - apart)


def _sum_between(
    first: NDArray[np.int64], second: NDArray[np.int64], values: NDArray[np.float64], count: int
) -> NDArray[np.float64]:
    """Returns the sum of values for each two frames in a row that lie between two, [count - 1]."""
    total = np.zeros(count)
    np.add.at(total, first, values)
    np.add.at(total, second, -values)
    return np.asarray(np.cumsum(total)[:-1])


def _usual_depths(seen: _Observations, count: int) -> NDArray[np.float64]:
    """Returns the median depth of the points of each frame, that of all for frames without any."""
    every = float(np.median(seen.depth)) if len(seen.depth) else 1.0
    order = np.argsort(seen.frame, kind="stable")
    parts = np.split(seen.depth[order], np.searchsorted(seen.frame[order], np.arange(1, count)))
    return np.array([float(np.median(part)) if len(part) else every for part in parts])
