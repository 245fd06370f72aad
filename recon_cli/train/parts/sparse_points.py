"""Sparse points in the views: where they fall, their colours, and the gains that these show.

A point shows the same surface to all views: the ratio of its colours in two views is that of their
gains. Occlusion makes some ratios wrong, which the median over all shared points ignores.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.scene.statistics import COARSE_SAMPLE, LEAST_SHARED, UNCLIPPED
from recon_cli.scene.train_view import TrainView

_SIDE = 100  # pixels of the longer side; a small view is denoised and does not mind blur
# Spread from which a capture drifts. Measured: up to .0194 in clean room videos (from gloss), .0326
# to .0519 in rooms whose gain drifts by .82 to 1.42, .06 and more in photos.
_DRIFTS = 0.025
_FLOOR = 0.02  # added to the spread of a pair in log units: no pair is known better
# How far views of the same place differ, from which the exposure is a view's own. Measured (the
# variance, of any two views 1): .01 to .23 in 15 captures by phone, drone and camera and two
# renderings with a drift; .62 to .83 where most of it changes from view to view.
_OWN = 1 / 3


@dataclass(frozen=True, eq=False)
class GainEstimate:
    """Log-gains of views as their sparse points show them."""

    # [F, 3] RGB, natural logarithm, of mean 0; zeros for a view without evidence
    log_gains: NDArray[np.float64]
    # largest standard deviation of a channel over the views with evidence; 0 without comparisons
    spread: float
    # mean square of the difference to the view that shares most, over that of any two views
    local: float
    compared: int  # pairs of views that share enough points

    @property
    def drifts(self) -> bool:
        """Whether the views differ by more than gloss and occlusion make them differ."""
        return self.spread > _DRIFTS

    @property
    def follows_place(self) -> bool:
        """Whether views of the same place are alike, so that Gaussians can take its exposure."""
        return self.local < _OWN


def estimate_gains(
    views: Sequence[TrainView],
    points: NDArray[np.float64],  # [P, 3]
    *,
    seed: int = 0,
) -> GainEstimate:
    """Returns the log-gain of each view from the colours that points have in several views.

    Weighted least squares over pairs: the median log-ratio of the points that two views share
    should be the difference of their log-gains. Of more than 4,000 points a seeded draw is taken.
    """
    points = choose_points(points, seed)
    logs = np.stack([log_colors(view, points) for view in views])
    pairs, medians, weights = _pairs(logs)
    known = np.unique(pairs)
    if len(known) == 0:
        return GainEstimate(np.zeros((len(views), 3)), 0.0, 0.0, 0)
    gains = _solve(pairs, medians, weights, len(views))
    variance = gains[known].var(axis=0).sum()
    apart = ((gains[known] - gains[_nearest(logs)[known]]) ** 2).mean(axis=0).sum()
    return GainEstimate(gains, float(gains[known].std(axis=0).max()),
                        float(apart / max(2 * variance, 1e-12)), len(pairs))


def choose_points(points: NDArray[np.float64], seed: int = 0) -> NDArray[np.float64]:
    """Returns the points [P, 3], of more than 4,000 a seeded draw."""
    if len(points) <= COARSE_SAMPLE:
        return points
    return points[np.sort(np.random.default_rng(seed).permutation(len(points))[:COARSE_SAMPLE])]


def log_colors(view: TrainView, points: NDArray[np.float64]) -> NDArray[np.float64]:  # [P, 3]
    """Returns the logarithm of each point's colour; NaN where it is not seen or may be clipped."""
    image, block = _reduce(view)
    rows, column, line, _ = view.camera.find_visible(points)
    column, line = column // block, line // block
    inside = (line < image.shape[0]) & (column < image.shape[1])
    colors = np.full((len(points), 3), np.nan)
    colors[rows[inside]] = image[line[inside], column[inside]]
    dark, bright = (level / 255 for level in UNCLIPPED)
    fair = ((colors > dark) & (colors < bright)).all(axis=1, keepdims=True)
    return np.log(np.where(fair, colors, np.nan))


def _reduce(view: TrainView) -> tuple[NDArray[np.float64], int]:
    """Returns the means of square blocks of a view, NaN where the mask ignores a pixel."""
    block = max(1, round(max(view.image.shape) / _SIDE))
    height, width = (side // block * block for side in view.image.shape[:2])
    image = view.image[:height, :width].astype(np.float32)
    if view.mask is not None:
        image[~view.mask[:height, :width]] = np.nan
    small = cv2.resize(image, (width // block, height // block), interpolation=cv2.INTER_AREA)
    return np.asarray(small / 255.0, np.float64), block


_Pairs = tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64]]


def _pairs(logs: NDArray[np.float64]) -> _Pairs:
    """Returns pairs [E, 2], their median log-ratios [E, 3] and weights [E, 3] from [F, P, 3]."""
    visible = np.isfinite(logs[..., 0])
    pairs, medians, weights = [], [], []
    for first in range(len(logs)):
        for second in range(first + 1, len(logs)):
            both = visible[first] & visible[second]
            if (count := int(both.sum())) < LEAST_SHARED:
                continue
            ratios = logs[second, both] - logs[first, both]
            middle = np.median(ratios, axis=0)
            spread = np.median(np.abs(ratios - middle), axis=0) + _FLOOR
            pairs.append((first, second))
            medians.append(middle)
            weights.append(count / spread**2)
    return (np.array(pairs, np.intp).reshape(-1, 2), np.array(medians).reshape(-1, 3),
            np.array(weights).reshape(-1, 3))


def _nearest(logs: NDArray[np.float64]) -> NDArray[np.intp]:
    """Returns for each of F views [F, P, 3] the one that sees the most alike set of points."""
    visible = np.isfinite(logs[..., 0]).astype(np.float64)
    shared, counts = visible @ visible.T, visible.sum(axis=1)
    alike = shared / np.maximum(counts[:, None] + counts - shared, 1)
    np.fill_diagonal(alike, -1)
    return np.asarray(alike.argmax(axis=1))


def _solve(
    pairs: NDArray[np.intp], medians: NDArray[np.float64], weights: NDArray[np.float64], views: int
) -> NDArray[np.float64]:
    """Returns the log-gains g [F, 3] that minimise sum w (g_second - g_first - median)^2."""
    gains = np.zeros((views, 3))
    first, second = pairs.T
    for channel in range(3):
        weight, pull = weights[:, channel], weights[:, channel] * medians[:, channel]
        normal, right = np.zeros((views, views)), np.zeros(views)
        np.add.at(normal, (first, first), weight)
        np.add.at(normal, (second, second), weight)
        np.add.at(normal, (first, second), -weight)
        np.add.at(normal, (second, first), -weight)
        np.add.at(right, second, pull)
        np.add.at(right, first, -pull)
        # of the least norm: of mean 0 in each part that hangs together
        gains[:, channel] = np.linalg.lstsq(normal, right, rcond=1e-10)[0]
    return gains
