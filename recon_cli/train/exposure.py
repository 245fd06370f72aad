"""Exposure and white balance of each training image, as a gain for each channel.

A camera that sets its exposure and white balance by itself shows one wall in many colours. What is
rendered is multiplied by exp(log_gain), three numbers an image, before it is compared with the
photograph, so that the Gaussians need not explain the camera.

Gains and colours of the scene are known only up to a common factor: the mean log-gain over the
training images is held at 0. Novel views, which have no gain, thus lie at the mean (geometric)
exposure of the capture. The plain PSNR of a held-out photograph of another exposure falls with
that; the one after its best gain (`trials.corrected_psnr`) tells what was gained.

There is no offset. A gain acts on linear light and the pixels are gamma-coded, so that a power of
the pixel would be right, and clipping bends it; but measured on two rooms of 100 frames whose gain
drifts by .82 to 1.42, blurred frames differ from the undisturbed ones by 36.3 and 35.6 dB, after
the best gain per channel by 43.0 and 38.3 dB, and with an offset as well by 43.6 and 38.8 dB. That
.5 dB of an error that is a tenth of a trained model's is not worth three more numbers that fog can
take for its own.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon_cli.train.rows import Rows

# Falling to a tenth as in INRIA 3DGS (exposure_lr_init .01, exposure_lr_final .001), but lower: in
# 2,000 steps on two phone videos, from gains that were estimated, held-out views gained .72 and
# .25 dB with .003, but .17 and -.01 dB with .01 (after the best gain of each view).
_RATE, _FINAL_RATE = 0.003, 0.0003
_PREFIX = "exposure"


class Exposure:
    """The log-gains of all training images, and their optimizer.

    An image that is never seen keeps the gain that it started with.

    Args:
        images: F, how many there are.
        start: [F, 3] log-gains to begin with, such as `estimated` gives, whose mean is taken off;
            None for zeros.
    """

    def __init__(self, images: int, *, start: NDArray[np.float64] | None = None) -> None:
        first = np.zeros((images, 3)) if start is None else start
        if first.shape != (images, 3):
            raise ValueError(f"log-gains of shape {first.shape}, needed {(images, 3)}")
        self._rows = Rows(torch.from_numpy(first - first.mean(axis=0)))

    @property
    def log_gains(self) -> NDArray[np.float64]:
        """Natural logarithm of the gains of all images, [F, 3] RGB; a copy."""
        return self._rows.value.numpy().copy()

    def gain(self, image: int) -> NDArray[np.float32]:
        """Returns what the rendered channels of an image are multiplied by, [3]."""
        return np.asarray(np.exp(self._rows.value[image].numpy()), np.float32)

    def step(self, image: int, gradient: NDArray[np.float64], done: float) -> None:
        """Moves the gains of one image, and all that were ever moved back to a mean of 0.

        Args:
            image: its index.
            gradient: [3] of its log-gains.
            done: share of the run, 0 to 1; the rate falls geometrically with it.
        """
        self._rows.step(image, gradient, _RATE * (_FINAL_RATE / _RATE) ** done)
        self._rows.center()

    def tensors(self) -> dict[str, Tensor]:
        """Returns gains, moments and counts by name, for a checkpoint."""
        return self._rows.tensors(_PREFIX)

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Takes back what `tensors` returned."""
        self._rows.restore(_PREFIX, tensors)
