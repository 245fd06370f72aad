"""Vignettes: the falloff of each camera's lens, and what sparse points show of it before training.

A vignette takes nothing away at the principal point.

A point has one colour. The logarithm of its brightness in view f at squared distance s from the
principal point is, by `render.response` to the first order,

    l = p + g_f + a s + b s^2 + t_f (1 - exp p)

with the point's own p. The tone curve t of a view is an unknown like its gain g, as neither may
pass for a vignette. All are solved for together by least squares whose weights fall where a point
contradicts the others: it is hidden there, or gloss.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from recon_cli.render.response import Response, ResponseGradient, lens
from recon_cli.scene.camera import Camera
from recon_cli.scene.statistics import MIN_OBSERVATIONS, REFIT_ROUNDS
from recon_cli.scene.train_view import TrainView
from recon_cli.train.fit.task import Evidence, Task
from recon_cli.train.parts.decisions import Rule
from recon_cli.train.parts.part import Part, Sign, TrialScene
from recon_cli.train.parts.photometry import FittedPart
from recon_cli.train.parts.sparse_points import choose_points, log_colors
from recon_cli.workspace.summaries import PhotometrySummary, VignetteSummary

_RATE, _FALL = 0.002, 0.1  # of the exponents; it falls to a tenth, as that of exposures does
_DARKEST = 1.5  # of -(a + b): a corner with a fifth of the light, as of a fast lens wide open
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
    kept = np.isfinite(logs).sum(axis=0) >= MIN_OBSERVATIONS
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
    rows, column, line, _ = camera.find_visible(points)
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
    for _ in range(REFIT_ROUNDS):
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


class Vignettes(FittedPart):
    """The vignettes of the cameras of a capture."""

    def __init__(
        self, cameras: Sequence[Camera], *, start: NDArray[np.float64] | None = None
    ) -> None:
        self._groups = camera_groups(cameras)
        self._lenses = list(dict.fromkeys(map(lens, cameras)))
        first = np.zeros((max(self._groups) + 1, 2)) if start is None else start
        super().__init__("vignette", np.array([falling(*row) for row in first]))

    @property
    def exponents(self) -> NDArray[np.float64]:
        """a and b of all cameras, [G, 2]; a copy."""
        return self._rows.value.numpy().copy()

    def of_image(self, image: int) -> tuple[float, float]:
        """Returns a and b of a training image."""
        a, b = self._rows.value[self._groups[image]].tolist()
        return a, b

    def respond(self, image: int, response: Response) -> Response:
        """Returns the response of an image with the vignette of its camera."""
        return replace(response, vignette=self.of_image(image))

    def step(self, image: int, gradient: ResponseGradient, done: float) -> None:
        """Moves the vignette of one image's camera; the rate falls as `done` goes from 0 to 1."""
        row = self._groups[image]
        self._rows.step(row, gradient.vignette, _RATE * _FALL**done)
        self._rows.value[row] = torch.tensor(
            falling(*self._rows.value[row].tolist()), dtype=torch.float64)

    def add_to(self, summary: PhotometrySummary) -> PhotometrySummary:
        """Returns the record with the vignettes by lens."""
        return replace(summary, vignettes=tuple(
            VignetteSummary(lens=key, a=a, b=b, corner=round(math.exp(a + b), 4))
            for key, (a, b) in zip(self._lenses, self._rows.value.tolist(), strict=True)))


def camera_groups(cameras: Sequence[Camera]) -> list[int]:
    """Returns the number of the camera of each view, in order of their first views."""
    numbers: dict[tuple[float, ...], int] = {}
    return [numbers.setdefault(lens(camera), len(numbers)) for camera in cameras]


def falling(a: float, b: float) -> tuple[float, float]:
    """Returns exponents of a vignette that nowhere rises, the nearest in a and then in b.

    a s + b s^2 falls for all s from 0 to 1 where its slope a + 2 b s is not positive at both ends.
    """
    a = min(a, 0.0)
    b = min(b, -a / 2)
    scale = min(1.0, _DARKEST / max(-(a + b), 1e-12))
    return a * scale, b * scale


def _find(evidence: Evidence) -> VignetteEvidence:
    return find_vignettes(evidence.views, evidence.points)


def find_dark_corners(scene: TrialScene) -> Sign:
    """Returns whether corners of the views lack light."""
    if scene.config.densify == "reference":
        return Sign(on=False)  # sees what tables of the literature saw
    found = scene.evidence.once(_find)
    return Sign() if found.shades else Sign(
        on=False,
        reason=f"the corners of the views lack {100 * found.corner_loss:.1f}% of the light only")


def _fit(task: Task, points: NDArray[np.float64] | None) -> Vignettes:
    start = None if points is None else find_vignettes(task.train, points).exponents
    return Vignettes([view.camera for view in task.train], start=start)


PART = Part("vignette", find_dark_corners, rule=lambda _: Rule(as_filmed=True), fit=_fit)
