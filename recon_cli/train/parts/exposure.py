"""Exposure: a gain for each channel of each training image.

The scene keeps its own brightness: log-gains have a mean of 0 over the images.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from recon_cli.render.response import Response, ResponseGradient
from recon_cli.train.fit.task import Evidence, Task
from recon_cli.train.parts.part import Part, Sign, TrialScene
from recon_cli.train.parts.photometry import FittedPart
from recon_cli.train.parts.sparse_points import GainEstimate, estimate_gains
from recon_cli.workspace.summaries import PhotometrySummary

# Falling to a tenth as in INRIA 3DGS, but lower: on two phone videos, held-out views gained .72 and
# .25 dB with .003, but .17 and -.01 dB with .01 (after the best gain of each view).
_RATES = (0.003, 0.0003)


class Exposure(FittedPart):
    """The log-gains of all training images and their optimizer; `start` [F, 3] gets a mean of 0."""

    def __init__(self, images: int, *, start: NDArray[np.float64] | None = None) -> None:
        first = np.zeros((images, 3)) if start is None else start
        if first.shape != (images, 3):
            raise ValueError(f"log-gains of shape {first.shape}, needed {(images, 3)}")
        super().__init__("exposure", first - first.mean(axis=0))

    @property
    def log_gains(self) -> NDArray[np.float64]:
        """Natural logarithm of the gains of all images, [F, 3] RGB; a copy."""
        return self._rows.value.numpy().copy()

    def gain(self, image: int) -> NDArray[np.float32]:
        """Returns the factors of the rendered channels of an image, [3]."""
        return np.asarray(np.exp(self._rows.value[image].numpy()), np.float32)

    def respond(self, image: int, response: Response) -> Response:
        """Returns the response of an image with its gain."""
        return replace(response, gain=self.gain(image))

    def step(self, image: int, gradient: ResponseGradient, done: float) -> None:
        """Moves one image's gains; the rate falls as `done` goes from 0 to 1."""
        self._rows.step(image, gradient.log_gain, _RATES[0] * (_RATES[1] / _RATES[0]) ** done)
        self._rows.center()

    def add_to(self, summary: PhotometrySummary) -> PhotometrySummary:
        """Returns the record with how far the gains differ."""
        return replace(summary, gain_spread=round(float(self.log_gains.std(axis=0).max()), 4))


def _estimate(evidence: Evidence) -> GainEstimate:
    return estimate_gains(evidence.views, evidence.points)


def find_drift(scene: TrialScene) -> Sign:
    """Returns whether the brightness of the same points differs from view to view."""
    drift = scene.evidence.once(_estimate)
    differs = f"brightness of the same points differs by {100 * drift.spread:.1f}%"
    if scene.config.brightness == "even":
        return Sign(drift.drifts, f"one exposure for all is asked for, and {differs}")
    if not drift.drifts:
        return Sign(on=False, reason=f"{differs} only")
    if drift.follows_place:
        return Sign(on=False, reason=f"{differs}, but little between views of the same place")
    return Sign()


def _fit(task: Task, points: NDArray[np.float64] | None) -> Exposure:
    start = None if points is None else estimate_gains(task.train, points).log_gains
    return Exposure(len(task.train), start=start)


PART = Part("exposure", find_drift, fit=_fit)
