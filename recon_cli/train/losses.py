"""L1 and D-SSIM in one differentiable function with a closed-form gradient.

SSIM as the reference uses it in its loss: 11 taps, sigma 1.5, zeros beyond the border, mean over
all pixels and channels (Wang et al. 2004, eq. 13). Autograd through five blurs would keep some
thirty images alive; the closed form keeps nine.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

_SIGMA = 1.5
_RADIUS = 5
_C1, _C2 = 0.01**2, 0.03**2  # for images in [0, 1]


def photometric_loss(
    image: Tensor, truth: Tensor, ssim_weight: float, *, mask: Tensor | None = None
) -> Tensor:
    """Returns (1 - w) L1 + w (1 - SSIM) (Kerbl et al. 2023, eq. 7).

    A pixel that the mask ignores counts as one without error, and gets no gradient. The truth
    there still lies in the windows of its neighbours: paint it with something neutral.

    Args:
        image: [H, W, 3] rendered, gradients flow here.
        truth: [H, W, 3] in [0, 1], same dtype and device.
        ssim_weight: w in [0, 1].
        mask: [H, W] bool, True where a pixel counts; None where all do.
    """
    if mask is not None:
        image = torch.where(mask[..., None], image, truth)
    loss = (image - truth).abs().mean()
    if ssim_weight == 0:
        return loss
    ssim: Tensor = _Ssim.apply(image, truth)  # type: ignore[no-untyped-call]
    return (1 - ssim_weight) * loss + ssim_weight * (1 - ssim)


def _taps() -> list[float]:
    """Returns the right half of the normalised window, the centre first."""
    window = torch.exp(-0.5 * (torch.arange(-_RADIUS, _RADIUS + 1.0).double() / _SIGMA) ** 2)
    half: list[float] = (window / window.sum())[_RADIUS:].tolist()
    return half


def blur(images: Tensor) -> Tensor:
    """Returns [..., H, W] images convolved with the window; zeros lie beyond the border.

    Shifted additions along whole rows: ten times faster on a CPU than a grouped convolution.
    """
    taps = _taps()
    for axis in (-1, -2):
        length = images.shape[axis]
        out = images * taps[0]
        for shift in range(1, min(_RADIUS, length - 1) + 1):
            rest = length - shift
            out.narrow(axis, 0, rest).add_(images.narrow(axis, shift, rest), alpha=taps[shift])
            out.narrow(axis, shift, rest).add_(images.narrow(axis, 0, rest), alpha=taps[shift])
        images = out
    return images


class _Ssim(torch.autograd.Function):
    """Mean structural similarity of two [H, W, 3] images."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, truth: Tensor) -> Tensor:
        x, y = (item.permute(2, 0, 1).contiguous() for item in (image, truth))
        mu_x, mu_y, xx, yy, xy = blur(torch.stack([x, y, x * x, y * y, x * y]))
        a1, a2 = 2 * mu_x * mu_y + _C1, 2 * (xy - mu_x * mu_y) + _C2
        b1 = mu_x * mu_x + mu_y * mu_y + _C1
        b2 = (xx - mu_x * mu_x) + (yy - mu_y * mu_y) + _C2
        ssim = a1 * a2 / (b1 * b2)
        ctx.save_for_backward(x, y, mu_x, mu_y, a1, a2, b1, b2, ssim)
        mean: Tensor = ssim.mean()
        return mean

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        x, y, mu_x, mu_y, a1, a2, b1, b2, ssim = ctx.saved_tensors
        by_variance = -ssim / b2
        by_covariance = 2 * a1 / (b1 * b2)
        by_mean = (
            2 * mu_y * a2 / (b1 * b2) - 2 * mu_x * ssim / b1
            - 2 * mu_x * by_variance - mu_y * by_covariance
        )
        # the window is symmetric and the border zero: the blur is its own transpose
        mean, variance, covariance = blur(torch.stack([by_mean, by_variance, by_covariance]))
        slope = mean + 2 * x * variance + y * covariance
        return (slope * (grad / slope.numel())).permute(1, 2, 0), None
