"""What the training images add to the light of the scene, as parts of the model fit it.

None of it is part of the .ply.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon_cli.render.response import LensFalloffs, Response, ResponseGradient
from recon_cli.train.fit.optimizer import SparseAdam
from recon_cli.workspace.atomic import write_json
from recon_cli.workspace.summaries import PhotometrySummary


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
    return None if found is None else falloffs_of(found)


def falloffs_of(summary: PhotometrySummary) -> LensFalloffs | None:
    """Returns the vignettes of a record, by lens; None without any."""
    if not summary.vignettes:
        return None
    return LensFalloffs({each.lens: (each.a, each.b) for each in summary.vignettes})


class FittedPart(ABC):
    """A part of the model that is fitted beside the Gaussians: a table with rows to be moved."""

    def __init__(self, name: str, start: NDArray[np.float64]) -> None:
        self._name, self._rows = name, SparseAdam(torch.from_numpy(start))

    @abstractmethod
    def respond(self, image: int, response: Response) -> Response:
        """Returns the response of a training image with this part."""

    @abstractmethod
    def step(self, image: int, gradient: ResponseGradient, done: float) -> None:
        """Moves the parameters of one image; the rate falls as `done` goes from 0 to 1."""

    @abstractmethod
    def add_to(self, summary: PhotometrySummary) -> PhotometrySummary:
        """Returns a record with what was found."""

    def tensors(self) -> dict[str, Tensor]:
        """Returns all parameters, moments and counts by name, for a checkpoint."""
        return self._rows.tensors(self._name)

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restores the state that `tensors` returned."""
        self._rows.restore(self._name, tensors)


class Photometry:
    """The parts that are fitted with the Gaussians."""

    def __init__(self, parts: Sequence[FittedPart]) -> None:
        self._parts = parts

    def response(self, image: int) -> Response:
        """Returns the response of a training image."""
        response = Response(np.ones(3, np.float32))
        for part in self._parts:
            response = part.respond(image, response)
        return response

    @property
    def falloffs(self) -> LensFalloffs | None:
        """The vignettes by lens, for views that are not trained on; None where not fitted."""
        return falloffs_of(self.summarize())

    def step(self, image: int, gradient: ResponseGradient, done: float) -> None:
        """Moves all parameters of one image; the rates fall as `done` goes from 0 to 1."""
        for part in self._parts:
            part.step(image, gradient, done)

    def summarize(self) -> PhotometrySummary:
        """Returns what was found, for records."""
        summary = PhotometrySummary()
        for part in self._parts:
            summary = part.add_to(summary)
        return summary

    def tensors(self) -> dict[str, Tensor]:
        """Returns all parameters, moments and counts by name, for a checkpoint."""
        return {name: value for part in self._parts for name, value in part.tensors().items()}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restores the state that `tensors` returned."""
        for part in self._parts:
            part.restore(tensors)
