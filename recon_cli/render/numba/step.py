"""One training view without autograd: its loss and the gradients.

All intermediate values lie in buffers that are reused: a step allocates next to nothing.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from recon_cli.render.contract import Statistics, StepOptions, TargetDepth, TargetImage
from recon_cli.render.depth_loss import depth_loss_gradient
from recon_cli.render.response import ResponseGradient, ResponsePass
from recon_cli.render.numba.loss import CHANNELS, MAPS, photometric
from recon_cli.render.numba.view_pass import (
    ImageBuffers, PackedSplats, RenderSettings, ViewPass, flat)
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats

_FROM_BYTE = np.float32(1 / 255)  # the very factor that loss.py takes


class PhotometricStep:
    """Renders a view over black, compares it with its photograph and runs the backward pass."""

    def __init__(self) -> None:
        self._pass = ViewPass()
        self.statistics = Statistics.zeros(torch.zeros(0, 3))  # of the last view; overwritten
        self.response_gradient = ResponseGradient.zeros()  # of the last view that had a response

    @property
    def instances(self) -> int:
        """Gaussian-tile pairs of the last view; 0 where nothing was seen."""
        return len(self._pass.members)

    @property
    def bytes(self) -> int:
        """Memory of the buffers."""
        return self._pass.bytes

    def __call__(
        self, splats: Splats, gradients: Splats, camera: Camera, target: TargetImage,
        options: StepOptions,
    ) -> float:
        """Returns the loss (1 - w) L1 + w (1 - SSIM), and that of depth; overwrites `gradients`.

        Splats are float32 on the CPU, the photograph's pixels contiguous; sh_rest of `gradients` is
        left alone at degree 0 and without `options.harmonics`. A masked pixel counts as one without
        error, and gets no gradient.
        """
        height, width, truth = camera.height, camera.width, target.pixels
        if truth.shape != (height, width, CHANNELS) or not truth.flags.c_contiguous:
            raise ValueError(f"truth has shape {truth.shape}, needed {(height, width, 3)}")
        if len(self.statistics.radii) != len(splats):
            self.statistics = Statistics.zeros(splats.means.detach())
        view, pixels = self._pass, height * width
        rgb = view.take("rgb", CHANNELS * pixels)
        packed = PackedSplats.from_tensors(splats.parameters().values())
        settings = RenderSettings(
            flat(splats.background).copy(), options.sh_degree, options.scores,
            counting=target.mask if options.scores or options.loo else None)
        depth = view.take("nothing", 0) if target.depth is None else view.take("depth", pixels)
        image = ImageBuffers(rgb, view.take("alpha", pixels), depth)
        view.forward(packed, camera, settings, image, self.statistics)
        response = None if target.response is None else ResponsePass(target.response, camera)
        if response is not None:
            response.forward(rgb.reshape(height, -1))
        grad_rgb = view.take("grad_rgb", CHANNELS * pixels)
        if not truth.flags.writeable:  # would be another type, and kernels compiled once more
            truth = truth.copy()
        # numbers and not pixels: a flat mask is twice as fast as one of rows
        ignored = None if target.mask is None else np.repeat(~target.mask.reshape(-1), CHANNELS)
        if ignored is not None:  # the loss's own product, so that no error is left
            rgb[ignored] = truth.reshape(-1)[ignored] * _FROM_BYTE
        loss = photometric(
            rgb, truth.reshape(-1), width, height, options.ssim_weight,
            maps=view.take("maps", MAPS * len(rgb)), gradient=grad_rgb)
        if ignored is not None:
            grad_rgb[ignored] = 0
        if response is not None:
            self.response_gradient = response.backward(
                rgb.reshape(height, -1), grad_rgb.reshape(height, -1))
        grad_alpha = grad_depth = view.take("nothing", 0)
        if target.depth is not None:
            grad_alpha, grad_depth = (
                view.take(name, pixels) for name in ("grad_alpha", "grad_depth"))
            loss += self._compare_depth(image, target.depth, grad_alpha, grad_depth)
        view.backward(
            packed, PackedSplats.from_tensors(gradients.parameters().values()),
            ImageBuffers(grad_rgb, grad_alpha, grad_depth), self.statistics,
            loo=options.loo, harmonics=options.harmonics)
        return loss

    def _compare_depth(
        self, image: ImageBuffers, target: TargetDepth, grad_alpha: NDArray[np.float32],
        grad_depth: NDArray[np.float32],
    ) -> float:
        """Returns the loss of the depth and writes its gradients [H * W]."""
        truth = target.depths.reshape(-1)
        known = np.flatnonzero(truth)
        depth, alpha, sensor = (
            torch.from_numpy(values[known]) for values in (image.depth, image.alpha, truth))
        loss, by_depth, by_alpha = depth_loss_gradient(
            depth, alpha, sensor, target.noise, target.factor)
        grad_alpha[:], grad_depth[:] = 0, 0
        grad_alpha[known], grad_depth[known] = by_alpha.numpy(), by_depth.numpy()
        return float(loss)
