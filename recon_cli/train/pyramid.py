"""Views at reduced sizes, for the first part of a run."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import cv2
import numpy as np

from recon_cli.scene.train_view import TrainView

_SMALLEST = 16  # pixels a side; a smaller image tells nothing, and SSIM's window is 11


def reduced(view: TrainView, factor: int) -> TrainView:
    """Returns a view reduced by area, its camera with it; the same where it would be too small.

    A reduced pixel counts only where all that it covers counts.
    """
    camera = view.camera
    width, height = round(camera.width / factor), round(camera.height / factor)
    if factor == 1 or min(width, height) < _SMALLEST:
        return view
    image = cv2.resize(view.image, (width, height), interpolation=cv2.INTER_AREA)
    mask = None
    if view.mask is not None:
        hidden = (~view.mask).astype(np.float32)
        mask = np.asarray(cv2.resize(
            hidden, (width, height), interpolation=cv2.INTER_AREA) == 0)
    return TrainView(camera.resized(width, height), np.ascontiguousarray(image), mask)


class Pyramid:
    """The training views at every size that a run asks for, made when it does.

    Args:
        views: at full size.
        page_locked: those that are made lie in memory that a GPU reads by itself.
    """

    def __init__(self, views: Sequence[TrainView], *, page_locked: bool = False) -> None:
        self._views, self._page_locked = views, page_locked
        self._at = cache(self._reduced)

    def _reduced(self, index: int, factor: int) -> TrainView:
        view = reduced(self._views[index], factor)
        return view.page_locked() if self._page_locked else view

    def view(self, index: int, factor: int) -> TrainView:
        """Returns a view reduced by a factor."""
        return self._views[index] if factor == 1 else self._at(index, factor)
