"""The scores of views and of models, as tables and files hold them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class ViewScore:
    """The scores of one view.

    Attributes:
        name: of the view.
        psnr_db: peak signal-to-noise ratio in dB.
        psnr_8bit_db: of the render rounded to 8 bits.
        ssim: structural similarity by scikit-image.
        ssim_padded: by INRIA's convention.
        lpips: perceptual distance, lower is better; None where it was not measured.
        pixels_scored: share of the pixels that a mask leaves; None without a mask.
    """

    name: str
    psnr_db: float
    psnr_8bit_db: float
    ssim: float
    ssim_padded: float
    lpips: float | None = None
    pixels_scored: float | None = None


@dataclass(frozen=True)
class ModelScore:
    """The scores of one model over all held-out views.

    Attributes:
        label: how tables call it.
        views: per view, by name.
        gaussians: count.
        bytes: size of its file.
        render_ms: median milliseconds a view.
        train_seconds: seconds of training that led to it; None where nobody knows.
    """

    label: str
    views: tuple[ViewScore, ...]
    gaussians: int
    bytes: int
    render_ms: float
    train_seconds: float | None

    @property
    def psnr_db(self) -> float:
        """Mean over the views of the PSNR in dB."""
        return self._mean(lambda view: view.psnr_db)

    @property
    def psnr_8bit_db(self) -> float:
        """Mean over the views of the PSNR of 8-bit pictures in dB."""
        return self._mean(lambda view: view.psnr_8bit_db)

    @property
    def ssim(self) -> float:
        """Mean over the views of the SSIM by scikit-image."""
        return self._mean(lambda view: view.ssim)

    @property
    def ssim_padded(self) -> float:
        """Mean over the views of the SSIM by INRIA's convention."""
        return self._mean(lambda view: view.ssim_padded)

    @property
    def lpips(self) -> float | None:
        """Mean over the views of the perceptual distance; None where it was not measured."""
        values = [view.lpips for view in self.views if view.lpips is not None]
        return float(np.mean(values)) if len(values) == len(self.views) else None

    def _mean(self, of: Callable[[ViewScore], float]) -> float:
        return float(np.mean([of(view) for view in self.views]))
