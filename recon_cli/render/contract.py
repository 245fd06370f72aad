"""The contract of every rasterizer; its equations are in docs/rasterization.

A backend is a function of the type `Renderer`. It culls tightly (a Gaussian meets a pixel where
q <= 2 ln(255 o)), clamps alpha at .99, composites front to back in order of depth (ties in order
of index) and stops a pixel before the fragment that would leave T < 1e-4. It is differentiable by
autograd in every raw parameter and bit-deterministic on one machine.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from recon_cli.scene.camera import Camera

if TYPE_CHECKING:  # kernels read the constants, and draw, without torch
    from torch import Tensor

    from recon_cli.render.response import Response
    from recon_cli.scene.splats import Splats

TILE = 16  # pixels; the tile of the paper and of INRIA's rasterizer
ALPHA_MIN = 1.0 / 255.0  # a fragment below one 8-bit step is ignored
ALPHA_MAX = 0.99  # keeps 1 / (1 - alpha) bounded in the backward pass
# A pixel stops before it would fall below this: 1e-4 less a margin for rounding, so that two
# fragments of alpha .99, which leave 1e-4, are both drawn whatever the precision.
TRANSMITTANCE_MIN = 0.9999e-4
SHOWN_WEIGHT = 0.01  # alpha T of some pixel, from which on a view shows a Gaussian (RadSplat)
CULL_SLACK = 1e-3  # in q: culling keeps what rounding leaves in doubt
DILATION = 0.3  # pixels^2 added to the projected covariance: the low-pass filter of EWA splatting
NEAR = 0.05  # world units; COLMAP's scenes measure about ten units across


@dataclass(frozen=True, eq=False)
class EllipseGradients:
    """Gradients of a loss by what M Gaussians are projected to; see `render.view_gradient`."""

    ids: Tensor  # [M] int64, row of each in the splats
    # [M, 5] sums over the pixels of s (u, v, u^2, uv, v^2), s = alpha dL/dalpha and (u, v) the
    # whitened offset of a pixel from the mean, so that q = u^2 + v^2
    moments: Tensor
    colors: Tensor  # [M, 3], also where a colour was clamped at 0
    depths: Tensor  # [M]


_ALIGNED = 64  # numbers: kernels are compiled anew for addresses that are aligned otherwise


@dataclass(eq=False)
class Statistics:
    """Statistics for densification and pruning, gathered by the same passes that render.

    Pixels that a mask ignores are drawn, but do not count in hits, blend_sum, blend_max and loo.
    The gradients, variance and loo are zeros until backward() has run.
    """

    radii: Tensor  # [N] 3 standard deviations along the longer axis, in pixels; 0 where culled
    hits: Tensor  # [N] int64, pixels with alpha >= 1/255 and T (1 - alpha) >= 1e-4 after it
    blend_sum: Tensor  # [N] sum of alpha T over the pixels
    blend_max: Tensor  # [N] greatest alpha T
    means2d_grad: Tensor  # [N, 2] gradient of the loss by the projected mean, per pixel
    variance: Tensor  # [N] sum s^2 - (sum s)^2 / n over its n pixels, s = o dL/do = alpha dL/dalpha
    # [N] sum of ||alpha T (c - B)||^2, B the colour composited behind: the squared error that
    # removing this one Gaussian causes.
    loo: Tensor
    # Gaussians culled because a value in use, or what it is projected to, is not finite. At degree
    # d the first (d+1)^2 - 1 coefficients of sh_rest are in use. Gaussians behind the camera or
    # beside the image need not be counted.
    broken: int = 0
    keep_ellipses: bool = False  # set it after the forward pass, and backward() writes `ellipses`
    ellipses: EllipseGradients | None = None

    @staticmethod
    def zeros(like: Tensor) -> Statistics:
        """Returns empty statistics for the N Gaussians whose means are `like`, [N, 3]."""
        import torch

        n = like.shape[0]
        step = -(-n // _ALIGNED) * _ALIGNED
        zeros = like.new_zeros(7 * step)  # at once: on a GPU each of them would be a launch
        rows = [zeros[k * step:k * step + n] for k in range(7)]
        return Statistics(
            radii=rows[0], hits=like.new_zeros(n, dtype=torch.int64), blend_sum=rows[1],
            blend_max=rows[2], variance=rows[3], loo=rows[4],
            means2d_grad=zeros[5 * step:5 * step + 2 * n].view(n, 2))


@dataclass(frozen=True, eq=False)
class RenderOutput:
    """The images of a view and their statistics."""

    rgb: Tensor  # [H, W, 3] over the background, not clamped
    alpha: Tensor  # [H, W] coverage, 1 minus the final transmittance
    depth: Tensor  # [H, W] sum of alpha T z, world units; over alpha it is the expected depth
    # Without `scores=True` hits, blend weights and loo stay zero, and but with numba variance too.
    statistics: Statistics


@dataclass(frozen=True, eq=False)
class TargetDepth:
    """The depth that a training step compares the rendered one with; see `render.depth_loss`."""

    depths: NDArray[np.float32]  # [H, W] world units, 0 where it is not known
    noise: float  # relative standard deviation
    factor: float  # of the loss of each pixel


@dataclass(frozen=True, eq=False)
class TargetImage:
    """The image that a training step compares a rendered view with."""

    pixels: NDArray[np.uint8]  # [H, W, 3]
    mask: NDArray[np.bool_] | None = None  # [H, W] True where a pixel counts; None: everywhere
    response: Response | None = None  # of the camera; None: the photograph is the render
    depth: TargetDepth | None = None  # None where depth is not part of the loss


@dataclass(frozen=True)
class StepOptions:
    """The outputs of a training step without autograd."""

    sh_degree: int  # highest in use, as in `recon_cli.render.registry.render`
    ssim_weight: float  # w in [0, 1] of the loss (1 - w) L1 + w (1 - SSIM)
    details: bool = False  # variance too
    scores: bool = False  # hits and blend weights too, over the mask; else they mean nothing
    loo: bool = False  # likewise
    harmonics: bool = True  # without, the gradient of sh_rest may be left as it is
    depth_weight: float = 0.0  # of the mean over what a sensor measured, in the loss


class Renderer(Protocol):
    """The function that every backend is. See `recon_cli.render.registry.render`."""

    def __call__(
        self, splats: Splats, camera: Camera, background: Tensor, sh_degree: int, scores: bool,
        mask: Tensor | None = None,
    ) -> RenderOutput:
        """Renders; `mask` [H, W] bool says which pixels the scores are taken over."""


def check_inputs(
    splats: Splats, camera: Camera, background: Tensor, sh_degree: int, mask: Tensor | None
) -> None:
    """Raises ValueError where a shape, dtype, device or degree breaks the contract."""
    import torch

    if tuple(background.shape) != (3,):
        raise ValueError(f"background has shape {tuple(background.shape)}, needed (3,)")
    if background.dtype != splats.means.dtype or background.device != splats.means.device:
        raise ValueError("background and splats differ in dtype or device")
    if splats.means.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"dtype {splats.means.dtype}, needed float32 or float64")
    if not 0 <= sh_degree <= 3:
        raise ValueError(f"sh_degree is {sh_degree}, needed 0 to 3")
    if mask is not None and (
            tuple(mask.shape) != (camera.height, camera.width) or mask.dtype != torch.bool):
        raise ValueError(
            f"the mask is {tuple(mask.shape)} of {mask.dtype}, needed "
            f"{(camera.height, camera.width)} of bool")
