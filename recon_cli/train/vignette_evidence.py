"""What sparse points show of vignettes, before any training.

A point has one colour. The logarithm of its brightness in view f at squared distance s from the
principal point is, by `render.response` to the first order,

    l = p + g_f + a s + b s^2 + t_f (1 - exp p)

with the point's own p. The tone curve t of a view is an unknown like its gain g, as neither may
pass for a vignette. All are solved for together by least squares whose weights fall where a point
contradicts the others: it is hidden there, or gloss.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon_cli.scene.train_view import TrainView
from recon_cli.train.background import project_points
from recon_cli.train.exposure import choose_points, log_colors
from recon_cli.train.photometry import camera_groups, falling

_LEAST_VIEWS = 3  # that a point needs to say anything
_ROUNDS = 4  # of weights
_DOUBT = 1.5  # times the median residual, from which weights fall
_BEND_PRIOR = 0.2  # standard deviation of a bend before the points are asked
# Loss from which a vignette is worth a trial. Measured: .1 and 1% in two rendered rooms, 3 to 10%
# in four real walks, where a vignette is worth -.08 to .16 dB, and 25 to 65% in three others.
_FALLS = 0.15


@dataclass(frozen=True, eq=False)
class VignetteEvidence:
    """Vignettes as sparse points show them."""

    exponents: NDArray[np.float64]  # [G, 2] a and b by camera, falling; zeros: none
    corner_loss: float  # share of the light that corners lose, by all views and either half alone

    @staticmethod
    def nothing(views: Sequence[TrainView]) -> VignetteEvidence:
        """Returns that no view shows anything."""
        groups = camera_groups([view.camera for view in views])
        return VignetteEvidence(np.zeros((max(groups) + 1, 2)), 0.0)

    @property
    def shades(self) -> bool:
        """Whether corners are darker than gloss and occlusion make them."""
        return self.corner_loss > _FALLS


def find_vignettes(
    views: Sequence[TrainView], points: NDArray[np.float64], *, seed: int = 0
) -> VignetteEvidence:
    """Returns the vignette of each camera from the colours of points [P, 3]."""
    points = choose_points(points, seed)
    logs = np.log(np.exp(np.stack([log_colors(view, points) for view in views])).mean(axis=2))
    kept = np.isfinite(logs).sum(axis=0) >= _LEAST_VIEWS
    if not kept.any():
        return VignetteEvidence.nothing(views)
    squares = np.stack([_squares(view, points[kept]) for view in views])
    groups = np.array(camera_groups([view.camera for view in views]))
    logs = logs[:, kept]
    exponents = _solve(logs, squares, groups)
    losses = [_corner_loss(exponents)] + [
        _corner_loss(_solve(logs[half], squares[half], groups[half]))
        for half in (slice(0, None, 2), slice(1, None, 2))]
    return VignetteEvidence(exponents, min(losses))


def _corner_loss(exponents: NDArray[np.float64]) -> float:
    """Returns the share of the light that is lost in the corners, the mean over the cameras."""
    return float((1 - np.exp(exponents.sum(axis=1))).mean())


def _squares(view: TrainView, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the squared distance of each point's pixel as in `response.squared_distances`."""
    camera, squares = view.camera, np.zeros(len(points))
    rows, column, line = project_points(camera, points)
    corner = (max(camera.cx, camera.width - camera.cx) ** 2
              + max(camera.cy, camera.height - camera.cy) ** 2)
    squares[rows] = ((column + 0.5 - camera.cx) ** 2 + (line + 0.5 - camera.cy) ** 2) / corner
    return squares


def _solve(
    logs: NDArray[np.float64], squares: NDArray[np.float64], groups: NDArray[np.intp]
) -> NDArray[np.float64]:
    """Returns falling exponents [G, 2] from logs [F, P], NaN where not seen."""
    seen = np.isfinite(logs)
    logs = np.where(seen, logs, 0.0)
    # of the point, without the noise of this view
    slope = 1 - np.exp(logs.sum(axis=0) / np.maximum(seen.sum(axis=0), 1))
    views, cameras = len(logs), int(groups.max()) + 1
    columns = [np.where(seen & (groups == group)[:, None], squares**power, 0.0)
               for group in range(cameras) for power in (1, 2)]
    weights = seen.astype(np.float64)
    for _ in range(_ROUNDS):
        normal, right = _normal_equations(logs, weights, slope, columns)
        solved = np.linalg.lstsq(normal, right, rcond=1e-10)[0]
        gains, bends, exponents = solved[:views], solved[views:2 * views], solved[2 * views:]
        rest = logs - gains[:, None] - bends[:, None] * slope - sum(
            factor * column for factor, column in zip(exponents, columns, strict=True))
        rest -= (weights * rest).sum(axis=0) / np.maximum(weights.sum(axis=0), 1e-12)
        size = np.abs(rest)
        usual = _DOUBT * float(np.median(size[seen])) + 1e-9
        weights = np.where(seen, np.maximum(1, size / usual) ** -2.0, 0.0)
    return np.array([falling(a, b) for a, b in exponents.reshape(-1, 2)])


def _normal_equations(
    logs: NDArray[np.float64], weights: NDArray[np.float64], slope: NDArray[np.float64],
    columns: Sequence[NDArray[np.float64]],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the normal equations of gains, bends and exponents, the points' own p eliminated."""
    views = len(logs)
    total = np.maximum(weights.sum(axis=0), 1e-12)
    bent = weights * slope
    size = 2 * views + len(columns)
    normal, right = np.zeros((size, size)), np.zeros(size)
    own = slice(0, views), slice(views, 2 * views)
    normal[own[0], own[0]] = np.diag(weights.sum(axis=1)) - weights / total @ weights.T
    normal[own[0], own[1]] = np.diag(bent.sum(axis=1)) - weights / total @ bent.T
    normal[own[1], own[1]] = np.diag((bent * slope).sum(axis=1)) - bent / total @ bent.T
    rest = logs - (weights * logs).sum(axis=0) / total
    right[own[0]], right[own[1]] = (weights * rest).sum(axis=1), (bent * rest).sum(axis=1)
    for place, column in enumerate(columns, 2 * views):
        freed = column - (weights * column).sum(axis=0) / total
        normal[own[0], place] = (weights * freed).sum(axis=1)
        normal[own[1], place] = (bent * freed).sum(axis=1)
        for other, earlier in enumerate(columns[: place - 2 * views + 1], 2 * views):
            normal[other, place] = (weights * freed * earlier).sum()
        right[place] = (weights * column * rest).sum()
    normal = np.triu(normal) + np.triu(normal, 1).T
    noise = max(float((weights * rest**2).sum() / max(weights.sum(), 1e-12)), 1e-8)
    normal[own[1], own[1]] += np.eye(views) * noise / _BEND_PRIOR**2
    return normal, right
