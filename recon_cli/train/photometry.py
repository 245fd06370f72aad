"""What the training images add to the light of the scene: gains and vignettes.

The scene keeps its own brightness: log-gains have a mean of 0 over the images, and a vignette takes
nothing away at the principal point. None of it is part of the .ply.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon_cli.render.response import LensFalloffs, Response, ResponseGradient, lens
from recon_cli.scene.camera import Camera
from recon_cli.train.exposure import Exposure
from recon_cli.train.optimizer import SparseAdam
from recon_cli.workspace.atomic import write_json
from recon_cli.workspace.summaries import PhotometrySummary, VignetteSummary

_RATE, _FALL = 0.002, 0.1  # of the exponents; it falls to a tenth, as that of exposures does
_DARKEST = 1.5  # of -(a + b): a corner with a fifth of the light, as of a fast lens wide open
_ONES = np.ones(3, np.float32)


def write_photometry(folder: Path, photometry: Photometry | None) -> None:
    """Writes what was fitted beside a model, if anything was."""
    if photometry is not None:
        write_json(folder / PhotometrySummary.FILE, photometry.summarize().to_json())


def read_falloffs(folder: Path) -> LensFalloffs | None:
    """Returns the vignettes that were fitted with the model in a folder; None without any.

    Raises:
        ManifestError: the file is of another version.
        FormatError: it is damaged.
    """
    found = PhotometrySummary.read(folder)
    if found is None or not found.vignettes:
        return None
    return LensFalloffs({each.lens: (each.a, each.b) for each in found.vignettes})


class Photometry:
    """The parts that are fitted with the Gaussians, each None where it is off."""

    def __init__(self, exposure: Exposure | None, vignettes: Vignettes | None) -> None:
        self.exposure, self.vignettes = exposure, vignettes

    @staticmethod
    def from_parts(exposure: Exposure | None, vignettes: Vignettes | None) -> Photometry | None:
        """Returns the photometry of some parts, None where all are off."""
        if exposure is None and vignettes is None:
            return None
        return Photometry(exposure, vignettes)

    def response(self, image: int) -> Response:
        """Returns the response of a training image."""
        return Response(
            _ONES if self.exposure is None else self.exposure.gain(image),
            None if self.vignettes is None else self.vignettes.of_image(image))

    @property
    def falloffs(self) -> LensFalloffs | None:
        """The vignettes by lens, None where they are not fitted."""
        return None if self.vignettes is None else self.vignettes.falloffs

    def step(self, image: int, gradient: ResponseGradient, done: float) -> None:
        """Moves the parameters of one image against their gradients.

        The rates fall as `done` goes from 0 to 1.
        """
        if self.exposure is not None:
            self.exposure.step(image, gradient.log_gain, done)
        if self.vignettes is not None:
            self.vignettes.step(image, gradient.vignette, done)

    def summarize(self) -> PhotometrySummary:
        """Returns what was found, for records."""
        falloffs = {} if self.falloffs is None else self.falloffs.exponents
        return PhotometrySummary(
            gain_spread=None if self.exposure is None else round(
                float(self.exposure.log_gains.std(axis=0).max()), 4),
            vignettes=tuple(
                VignetteSummary(lens=key, a=a, b=b, corner=round(math.exp(a + b), 4))
                for key, (a, b) in falloffs.items()))

    def tensors(self) -> dict[str, Tensor]:
        """Returns all parameters, moments and counts by name, for a checkpoint."""
        return {name: value for part in self._parts for name, value in part.tensors().items()}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restores the state that `tensors` returned."""
        for part in self._parts:
            part.restore(tensors)

    @property
    def _parts(self) -> list[Exposure | Vignettes]:
        return [part for part in (self.exposure, self.vignettes) if part is not None]


class Vignettes:
    """The vignettes of the cameras of a capture."""

    def __init__(
        self, cameras: Sequence[Camera], *, start: NDArray[np.float64] | None = None
    ) -> None:
        self._groups = camera_groups(cameras)
        self._lenses = list(dict.fromkeys(map(lens, cameras)))
        first = np.zeros((max(self._groups) + 1, 2)) if start is None else start
        self._rows = SparseAdam(torch.from_numpy(np.array([falling(*row) for row in first])))

    @property
    def exponents(self) -> NDArray[np.float64]:
        """a and b of all cameras, [G, 2]; a copy."""
        return self._rows.value.numpy().copy()

    @property
    def falloffs(self) -> LensFalloffs:
        """The vignettes by lens, for views that are not trained on."""
        return LensFalloffs({
            key: (a, b) for key, (a, b) in zip(
                self._lenses, self._rows.value.tolist(), strict=True)})

    def of_image(self, image: int) -> tuple[float, float]:
        """Returns a and b of a training image."""
        a, b = self._rows.value[self._groups[image]].tolist()
        return a, b

    def step(self, image: int, gradient: NDArray[np.float64], done: float) -> None:
        """Moves the vignette of one image's camera against its gradient [2]."""
        row = self._groups[image]
        self._rows.step(row, gradient, _RATE * _FALL**done)
        self._rows.value[row] = torch.tensor(
            falling(*self._rows.value[row].tolist()), dtype=torch.float64)

    def tensors(self) -> dict[str, Tensor]:
        """Returns exponents, moments and counts by name, for a checkpoint."""
        return self._rows.tensors("vignette")

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restores the state that `tensors` returned."""
        self._rows.restore("vignette", tensors)


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
