"""One training view without autograd: its loss, the gradients, and the camera's gradient.

All intermediate values lie in buffers that are reused: a step allocates next to nothing.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray

from recon_cli.render.contract import Statistics, StepOptions, TargetDepth, TargetImage
from recon_cli.render.depth_loss import depth_loss_gradient
from recon_cli.render.response import ResponseGradient, ResponsePass
from recon_cli.kernels.kernel import kernel
from recon_cli.render.numba.loss import CHANNELS, MAPS, photometric
from recon_cli.kernels.simd_functions import fetch_add
from recon_cli.kernels.thread_pool import pool
from recon_cli.render.numba.view_pass import (
    ImageBuffers, PackedSplats, RenderSettings, ViewPass, flat)
from recon_cli.scene.camera import Camera
from recon_cli.scene.harmonics import generators
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
            details=options.details, loo=options.loo, harmonics=options.harmonics)
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


_SUM_BLOCK = 1 << 11  # Gaussians that are summed together, whichever thread takes them


def camera_gradient(
    splats: Splats, gradients: Splats, camera: Camera, sh_degree: int
) -> NDArray[np.float64]:
    """Returns the gradient [6] of a turn and a move of the camera, from those of the Gaussians.

    The derivation stands in recon_cli.render.camera_gradient. Here the torque of the colours is
    sum (G_i sh_rest) . dL/dsh_rest with the generators G_i, without direction or derivative of the
    basis. Each block of Gaussians has sums of its own: the same bits for any number of threads.
    Splats are float32 on the CPU; sh_rest is not read at degree 0.
    """
    sums = np.zeros((-(-len(splats) // _SUM_BLOCK), 6))
    sh_degree = min(sh_degree, splats.sh_degree)
    axes, rows, columns, factors = _generator_entries((sh_degree + 1) ** 2 - 1)
    values, slopes = (
        [flat(getattr(parameters, name)) for name in ("means", "quats", "sh_rest")]
        for parameters in (splats, gradients))
    pool.run(torque_and_force, np.ascontiguousarray(camera.center, np.float64), axes, rows,
             columns, factors, *values, *slopes, flat(gradients.sh_dc),
             3 * splats.sh_rest.shape[1], sums, scratch=False)
    return np.asarray(-sums.sum(axis=0))


@cache
def _generator_entries(terms: int) -> tuple[NDArray[np.int64], ...]:
    """Returns axis, row, column and value of the generators above the diagonal, of some terms."""
    matrices = torch.triu(generators()[:, :terms, :terms]).numpy()
    axes, rows, columns = np.nonzero(matrices)
    return axes, 3 * rows, 3 * columns, matrices[axes, rows, columns]


@kernel
def torque_and_force(counter, center, axes, rows, columns, factors, means, quats, sh_rest, g_means,
                     g_quats, g_sh_rest, g_sh_dc, stride, sums):
    """Adds up torque and force on the scene of each block of Gaussians: [blocks, 6] float64.

    `axes`, `rows`, `columns` and `factors` [E] are the generators' entries above the diagonal, by
    the numbers of the coefficients in sh_rest; those below are the negatives. E = 0 at degree 0.
    """
    n = len(means) // 3
    torque = np.empty(3)
    while True:
        block = fetch_add(counter, 0, 1)
        if block >= len(sums):
            break
        for i in range(block * _SUM_BLOCK, min((block + 1) * _SUM_BLOCK, n)):
            a, b, c = 3 * i, 3 * i + 1, 3 * i + 2
            gx, gy, gz = (np.float64(g_means[a]), np.float64(g_means[b]), np.float64(g_means[c]))
            dark = g_sh_dc[a] == 0 and g_sh_dc[b] == 0 and g_sh_dc[c] == 0
            if dark and gx == 0 and gy == 0 and gz == 0:
                continue
            x, y, z = means[a] - center[0], means[b] - center[1], means[c] - center[2]
            q = 4 * i
            s, u, v, w = (np.float64(quats[q]), np.float64(quats[q + 1]),
                          np.float64(quats[q + 2]), np.float64(quats[q + 3]))
            gs, gu, gv, gw = g_quats[q], g_quats[q + 1], g_quats[q + 2], g_quats[q + 3]
            torque[0] = y * gz - z * gy + 0.5 * (s * gu - gs * u + v * gw - w * gv)
            torque[1] = z * gx - x * gz + 0.5 * (s * gv - gs * v + w * gu - u * gw)
            torque[2] = x * gy - y * gx + 0.5 * (s * gw - gs * w + u * gv - v * gu)
            if not dark and stride * (i + 1) <= len(sh_rest):
                for e in range(len(axes)):
                    row, column = stride * i + rows[e], stride * i + columns[e]
                    turned = np.float64(0)
                    for channel in range(3):
                        turned += (
                            np.float64(g_sh_rest[row + channel]) * sh_rest[column + channel]
                            - np.float64(g_sh_rest[column + channel]) * sh_rest[row + channel])
                    torque[axes[e]] += factors[e] * turned
            for axis in range(3):
                sums[block, axis] += torque[axis]
            sums[block, 3] += gx
            sums[block, 4] += gy
            sums[block, 5] += gz
