"""How long the shutter was open, from how much less sharp fast views are along their motion.

A camera that moves while its shutter is open blurs an image along the flow, and not across it. Both
are seen around the sparse points: the energies of the gradients along the flow and across it, whose
ratio no light, focus or resolution changes. What the edges of the scene do to that ratio is told
apart by the speed: fast views against slow ones whose flow has the same direction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.io.images import reduce_view
from recon_cli.scene.camera import Camera
from recon_cli.scene.motion import Motion
from recon_cli.scene.train_view import TrainView
from recon_cli.train.background import project_points

_POINTS = 4000  # of the sparse ones, evenly spread over their list
_SIDE = 300  # pixels of the longer side; in larger views strong blur leaves no gradients to compare
_PATCH = 9  # pixels of a side
_NOISE = 2.0  # squared grey levels a pixel, of noise and codec
_CONTRAST = 8.0  # times the noise that a view needs
_LEAST_POINTS = 10  # that a view needs
_LEAST_VIEWS = 20  # of a capture
# Pixels of blur that halve the squared energy of the gradients. Where edges are softer the time is
# as many times longer: the ratios tell the time in units of this width alone.
_WIDTH = 2.0
_DIRECTIONS = 8  # bins of the direction of the flow, of half a turn
_TIMES = np.geomspace(0.001, 0.15, 70)  # seconds
# Measured, as explained and rank correlation: .27 to .33 and -.68 to -.85 on two real walks and a
# room that were blurred, at most .007 and at least -.16 on six captures that were not.
_EXPLAINED, _CORRELATION = 0.1, -0.4


@dataclass(frozen=True)
class BlurEvidence:
    """How well the motion of the camera explains which views are blurred."""

    seconds: float  # the shutter time that explains most, of edges 2 pixels wide
    explained: float  # share of the spread of the ratios between views that it takes away
    correlation: float  # of the ranks of speed and ratio

    @staticmethod
    def nothing() -> BlurEvidence:
        """Returns no evidence."""
        return BlurEvidence(0.0, 0.0, 0.0)

    @property
    def speaks(self) -> bool:
        """Whether views are blurred by the motion of the camera."""
        return self.explained > _EXPLAINED and self.correlation < _CORRELATION


@dataclass(frozen=True, eq=False)
class ViewMotions:
    """The velocities of the cameras of a task; None for a view without a neighbour in time."""

    train: tuple[Motion | None, ...]
    validation: tuple[Motion | None, ...]
    points: NDArray[np.float64]  # [P, 3] sparse points in world units

    def select(self, rows: Sequence[int]) -> ViewMotions:
        """Returns those of some training views alone."""
        return ViewMotions(tuple(self.train[i] for i in rows), (), self.points)

    def find_blur(self, views: Sequence[TrainView]) -> BlurEvidence:
        """Returns the evidence for blur in the training views."""
        return find_blur(views, self.train, self.points)


def find_blur(
    views: Sequence[TrainView], motions: Sequence[Motion | None],
    points: NDArray[np.float64],  # [P, 3]
) -> BlurEvidence:
    """Returns the evidence for blur by the motion of the camera, and the shutter time behind it."""
    points = points[:: max(1, len(points) // _POINTS)]
    found = [ratio for view, motion in zip(views, motions, strict=True)
             if motion is not None and (ratio := _compare(view, motion, points)) is not None]
    if len(found) < _LEAST_VIEWS:
        return BlurEvidence.nothing()
    ratios, speeds, directions = np.array(found).T
    bins = (directions * _DIRECTIONS).astype(np.intp) % _DIRECTIONS
    spreads = [_spread(ratios + np.log1p((time * speeds / _WIDTH) ** 2) / 2, bins)
               for time in _TIMES]
    best = int(np.argmin(spreads))
    explained = 1 - spreads[best] / max(_spread(ratios, bins), 1e-12)
    ranks = [np.argsort(np.argsort(row)) for row in (speeds, ratios)]
    # scipy.stats takes a second to import
    correlation = float(np.asarray(np.corrcoef(ranks))[0, 1])
    return BlurEvidence(float(_TIMES[best]), explained, correlation)


def median_speed(camera: Camera, motion: Motion, points: NDArray[np.float64]) -> float:
    """Returns the median speed in pixels/s of the points [P, 3] that a view shows."""
    points = points[:: max(1, len(points) // _POINTS)]
    rows, _, _ = project_points(camera, points)
    if len(rows) == 0:
        return 0.0
    return float(np.median(np.linalg.norm(motion.flow(camera, points[rows]), axis=1)))


def _compare(
    view: TrainView, motion: Motion, points: NDArray[np.float64]
) -> tuple[float, float, float] | None:
    """Returns a view's log ratio of the energies, its speed in pixels/s and its flow's direction.

    The direction is a share of half a turn; None where the view shows too little.
    """
    view = reduce_view(view, max(1.0, max(view.camera.width, view.camera.height) / _SIDE))
    rows, column, line = project_points(view.camera, points)
    if view.mask is not None:
        seen = view.mask[line, column]
        rows, column, line = rows[seen], column[seen], line[seen]
    if len(rows) < _LEAST_POINTS:
        return None
    flow = motion.flow(view.camera, points[rows])
    speed = np.linalg.norm(flow, axis=1)
    x, y = (flow / np.maximum(speed, 1e-9)[:, None]).T
    xx, yy, xy = (energy[line, column] for energy in _energies(view))
    energy, along = xx + yy, x * x * xx + y * y * yy + 2 * x * y * xy
    if energy.mean() < _CONTRAST * _NOISE:
        return None
    ratio = np.log((along.mean() + _NOISE) / ((energy - along).mean() + _NOISE))
    order = np.argsort(speed)  # half of the energy is faster
    half = np.searchsorted(np.cumsum(energy[order]), energy.sum() / 2)
    # axes have no sign: directions are averaged at twice their angle
    turned = np.arctan2((2 * x * y * energy).sum(), ((x * x - y * y) * energy).sum())
    return float(ratio), float(speed[order][min(half, len(speed) - 1)]), turned / (2 * np.pi) % 1


def _energies(view: TrainView) -> tuple[NDArray[np.float32], ...]:
    """Returns the means around each pixel of the products of its slopes: xx, yy and xy, [H, W]."""
    grey = cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    across, down = (cv2.Sobel(grey, cv2.CV_32F, *order, scale=1 / 8) for order in ((1, 0), (0, 1)))
    return tuple(np.asarray(cv2.blur(product, (_PATCH, _PATCH)), np.float32)
                 for product in (across * across, down * down, across * down))


def _spread(values: NDArray[np.float64], bins: NDArray[np.intp]) -> float:
    """Returns the mean distance of values from the median of their bin."""
    apart = 0.0
    for each in np.unique(bins):
        own = values[bins == each]
        apart += float(np.abs(own - np.median(own)).sum())
    return apart / len(values)
