"""The loss of a rendered depth against that of a sensor.

With D = sum of alpha T z and A = sum of alpha T of a pixel, z its depth by the sensor, and s the
sensor's relative noise,

    e = (D / A - z) / (s z),  loss = f sum of (sqrt(1 + e^2) - 1)

over the pixels with a known depth that are more than half covered. Within the noise it is nearly
flat; beyond, each pixel pulls alike, so that what the sensor gets wrong, as in a mirror, does not
outweigh the rest (pseudo-Huber: Charbonnier et al. 1997, with the noise as its unit).
"""

from __future__ import annotations

import torch
from torch import Tensor

LEAST_COVERAGE = 0.5  # below it the expected depth is that of whatever little lies there


def depth_loss(
    depth: Tensor,  # [...] D, world units
    alpha: Tensor,  # [...] A
    truth: Tensor,  # [...] z by the sensor, world units; 0 where it is not known
    noise: float,
    factor: float | Tensor,  # f; of a mean over n pixels it is the weight of the term over n
) -> Tensor:
    """Returns the loss; gradients flow to `depth` and `alpha`."""
    used, safe, known = _used(alpha, truth)
    error = (depth / safe - known) / (noise * known)
    return factor * torch.where(used, (1 + error * error).sqrt() - 1, 0).sum()


def depth_loss_gradient(
    depth: Tensor, alpha: Tensor, truth: Tensor, noise: float, factor: float | Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Returns `depth_loss` and its gradients by depth and alpha, without autograd."""
    used, safe, known = _used(alpha, truth)
    expected = depth / safe
    error = (expected - known) / (noise * known)
    root = (1 + error * error).sqrt()
    slope = torch.where(used, factor * error / (root * noise * known * safe), 0)
    return factor * torch.where(used, root - 1, 0).sum(), slope, -slope * expected


def _used(alpha: Tensor, truth: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Returns which pixels count, and coverage and depth that can be divided by everywhere."""
    used = (truth > 0) & (alpha > LEAST_COVERAGE)
    return used, torch.where(used, alpha, 1), torch.where(used, truth, 1)
