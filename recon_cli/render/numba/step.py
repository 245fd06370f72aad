"""Loss and gradients of one training view without autograd: the inner half of a training step.

Everything between the parameters and their gradients lies in buffers that are used again, so a
step allocates next to nothing.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon_cli.render.contract import Statistics
from recon_cli.render.numba.loss import CHANNELS, MAPS, photometric
from recon_cli.render.numba.view_pass import Frame, Parameters, flat
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats

_FROM_BYTE = np.float32(1 / 255)  # the very factor that loss.py takes


class PhotometricStep:
    """Renders a view, compares it with the truth and carries the gradient back.

    Attributes:
        statistics: of the last view; its tensors are written anew by each call.
        log_gain_gradient: [3] float64 of the last view that was given a gain.
    """

    def __init__(self) -> None:
        self._frame = Frame()
        self.statistics = Statistics.zeros(torch.zeros(0, 3))
        self.log_gain_gradient = np.zeros(CHANNELS)

    @property
    def instances(self) -> int:
        """Gaussian-tile pairs of the last view; 0 where nothing was seen."""
        return len(self._frame.members)

    @property
    def bytes(self) -> int:
        """Memory of the buffers."""
        return self._frame.bytes

    def __call__(
        self, splats: Splats, gradients: Splats, camera: Camera, truth: NDArray[np.uint8],
        background: Tensor, sh_degree: int, ssim_weight: float, *,
        mask: NDArray[np.bool_] | None = None, gain: NDArray[np.float32] | None = None,
        details: bool = False, scores: bool = False, loo: bool = False,
    ) -> float:
        """Returns the loss (1 - w) L1 + w (1 - SSIM) and overwrites `gradients`.

        A pixel that the mask ignores counts as one without error, and gets no gradient.

        Args:
            splats: N Gaussians, float32 on the CPU.
            gradients: tensors of the same shapes; sh_rest is left alone at degree 0.
            camera: of the view.
            truth: [H, W, 3], contiguous.
            background: [3].
            sh_degree: highest in use, as in `recon_cli.render.registry.render`.
            ssim_weight: w in [0, 1].
            mask: [H, W], True where a pixel counts; None where all do.
            details: the statistics absolute_grad and variance are wanted too.
            scores: hits and blend weights too, over the pixels that count; without it they mean
                nothing.
            loo: loo too, likewise.
            gain: [3], what the rendered channels are multiplied by before they are compared; its
                gradient is left in `log_gain_gradient`. None for ones.
        """
        height, width, n = camera.height, camera.width, len(splats)
        if truth.shape != (height, width, CHANNELS) or not truth.flags.c_contiguous:
            raise ValueError(f"truth has shape {truth.shape}, needed {(height, width, 3)}")
        if len(self.statistics.radii) != n:
            self.statistics = Statistics.zeros(splats.means.detach())
        statistics, frame, pixels = self.statistics, self._frame, height * width
        statistics.radii.zero_()
        rgb = frame.take("rgb", CHANNELS * pixels)
        ours = Parameters.of(splats.parameters().values())
        frame.forward(
            ours, camera, flat(background), sh_degree, rgb=rgb, alpha=frame.take("alpha", pixels),
            depth=frame.take("depth", pixels), radii=flat(statistics.radii), scores=scores,
            counting=mask if scores or loo else None)
        statistics.broken = frame.broken
        if scores:
            frame.tally(statistics)
        if gain is not None:
            rgb.reshape(height, -1)[:] *= np.tile(gain, width)  # whole rows: ten times faster
        grad_rgb = frame.take("grad_rgb", CHANNELS * pixels)
        if not truth.flags.writeable:  # would be another type, and kernels compiled once more
            truth = truth.copy()
        # numbers and not pixels: a flat mask is twice as fast as one of rows
        ignored = None if mask is None else np.repeat(~mask.reshape(-1), CHANNELS)
        if ignored is not None:  # the loss's own product, so that no error is left
            rgb[ignored] = truth.reshape(-1)[ignored] * _FROM_BYTE
        loss = photometric(
            rgb, truth.reshape(-1), width, height, ssim_weight,
            maps=frame.take("maps", MAPS * len(rgb)), gradient=grad_rgb)
        if ignored is not None:
            grad_rgb[ignored] = 0
        if gain is not None:
            self._through_gain(
                rgb.reshape(height, -1), grad_rgb.reshape(height, -1), np.tile(gain, width))
        nothing = frame.take("nothing", 0)
        frame.backward(
            ours, Parameters.of(gradients.parameters().values()), grad_rgb=grad_rgb,
            grad_alpha=nothing, grad_depth=nothing, details=details, scores=loo,
            means2d_grad=flat(statistics.means2d_grad),
            absolute_grad=flat(statistics.absolute_grad), variance=flat(statistics.variance),
            loo=flat(statistics.loo))
        return loss

    def _through_gain(
        self, image: NDArray[np.float32], gradient: NDArray[np.float32],
        gain: NDArray[np.float32],
    ) -> None:
        """Carries the gradient of y = g x back to x in place, and keeps that of log g.

        dL/dlog g = g dL/dg = sum over pixels of y dL/dy. Under a mask y is the truth, but dL/dy 0.
        `image` and `gradient` are [H, W * 3], `gain` is [W * 3].
        """
        columns = np.multiply(image, gradient).sum(axis=0, dtype=np.float64)
        self.log_gain_gradient = columns.reshape(-1, CHANNELS).sum(axis=0)
        gradient *= gain
