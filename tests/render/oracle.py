"""An untiled brute force in float64: every Gaussian at every pixel, in the plainest code.

Shares nothing with the rasterizer but the contract's constants. The covariance is inverted as a
matrix, the spherical harmonics come from SciPy's associated Legendre functions.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from scipy.special import lpmv
from torch import Tensor

from recon_cli.render.contract import ALPHA_MAX, ALPHA_MIN, DILATION, NEAR, TRANSMITTANCE_MIN
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats


class Composite(NamedTuple):
    """The oracle's results for a picture.

    Attributes:
        rgb: [H, W, 3], differentiable, like the next two.
        alpha: [H, W].
        depth: [H, W].
        alphas: [N, H, W] of every fragment, 0 where there is none; detached.
        weights: [N, H, W] alpha T of every fragment; detached.
        margin: [H, W] smallest relative distance of an alpha to 1/255, or of the transmittance
            behind a fragment to 1e-4.
    """

    rgb: Tensor
    alpha: Tensor
    depth: Tensor
    alphas: Tensor
    weights: Tensor
    margin: Tensor


class Nudges(NamedTuple):
    """Zeros whose gradients are the parts that single pixels have in a Gaussian's gradient.

    Attributes:
        means2d: [N, H, W, 2] added to the projected mean, at that pixel alone.
        log_alphas: [N, H, W] added to log alpha before it is clamped, at that pixel alone.
    """

    means2d: Tensor
    log_alphas: Tensor

    @staticmethod
    def zeros(n: int, camera: Camera) -> Nudges:
        """Returns nudges that collect gradients."""
        shape = n, camera.height, camera.width
        return Nudges(torch.zeros(*shape, 2, dtype=torch.float64, requires_grad=True),
                      torch.zeros(shape, dtype=torch.float64, requires_grad=True))


def brute_force(
    splats: Splats, camera: Camera, background: Tensor, sh_degree: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Returns rgb [H, W, 3], alpha [H, W] and depth [H, W], differentiable."""
    return composited(splats, camera, background, sh_degree)[:3]


def composited(
    splats: Splats, camera: Camera, background: Tensor, sh_degree: int, *,
    nudges: Nudges | None = None, thresholds: bool = True,
) -> Composite:
    """Returns the picture of float64 splats; without thresholds no fragment is too faint."""
    R = torch.from_numpy(camera.viewmat[:3, :3])
    t = torch.from_numpy(camera.viewmat[:3, 3])
    local = splats.means @ R.T + t
    rows, columns = torch.meshgrid(
        torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    pixels = torch.stack([columns, rows], -1).double()
    size = camera.height, camera.width
    rgb, depth = torch.zeros(*size, 3, dtype=torch.float64), torch.zeros(size, dtype=torch.float64)
    left, margin = torch.ones(size, dtype=torch.float64), torch.full(size, torch.inf)
    alphas = torch.zeros(len(splats), *size, dtype=torch.float64)
    weights = torch.zeros_like(alphas)
    running = torch.ones(size, dtype=torch.bool)
    alpha_min, t_min = (ALPHA_MIN, TRANSMITTANCE_MIN) if thresholds else (0.0, 0.0)
    for i in torch.argsort(local[:, 2].detach(), stable=True).tolist():
        if local[i, 2] <= NEAR:
            continue
        mean, cov = _project(local[i], _covariance(splats, i), R, camera)
        d = pixels - mean
        if nudges is not None:
            d = d - nudges.means2d[i]
        q = torch.einsum("hwi,ij,hwj->hw", d, torch.linalg.inv(cov), d)
        # log sigmoid keeps its gradient where the sigmoid has rounded to 1
        opacity = torch.nn.functional.logsigmoid(splats.logit_opacities[i]).exp()
        alpha = opacity * torch.exp(-q / 2)
        if nudges is not None:
            alpha = alpha * torch.exp(nudges.log_alphas[i])
        alpha = alpha.clamp_max(ALPHA_MAX)
        part = running & (alpha >= alpha_min)
        if thresholds:
            margin = torch.where(running, margin.minimum((alpha / ALPHA_MIN - 1).abs()), margin)
            behind = (left * (1 - alpha) / TRANSMITTANCE_MIN - 1).abs()
            margin = torch.where(part, margin.minimum(behind), margin)
        running = running & ~(part & (left * (1 - alpha) < t_min))
        part = part & running
        alphas[i] = torch.where(part, alpha, 0.0).detach()
        weight = torch.where(part, alpha * left, 0.0)
        weights[i] = weight.detach()
        rgb = rgb + weight[..., None] * color_towards(splats, i, camera, sh_degree)
        depth = depth + weight * local[i, 2]
        left = torch.where(part, left * (1 - alpha), left)
    return Composite(
        rgb + left[..., None] * background, 1 - left, depth, alphas, weights, margin.detach())


def _covariance(splats: Splats, i: int) -> Tensor:
    given = splats.quats[i].abs().max() > 1e-30  # zero stands for no rotation
    quat = splats.quats[i] if given else torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)
    w, x, y, z = quat / quat.norm()
    R = torch.stack([
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]),
    ])
    return R @ torch.diag(torch.exp(2 * splats.log_scales[i])) @ R.T


def _project(
    local: Tensor, cov: Tensor, R: Tensor, camera: Camera
) -> tuple[Tensor, Tensor]:
    x, y, z = local
    mean = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])
    wide, high = 0.15 * camera.width, 0.15 * camera.height
    u = (x / z).clamp((-camera.cx - wide) / camera.fx,
                      (camera.width - camera.cx + wide) / camera.fx)
    v = (y / z).clamp((-camera.cy - high) / camera.fy,
                      (camera.height - camera.cy + high) / camera.fy)
    zero = torch.zeros_like(z)
    J = torch.stack([
        torch.stack([camera.fx / z, zero, -camera.fx * u / z]),
        torch.stack([zero, camera.fy / z, -camera.fy * v / z]),
    ])
    return mean, J @ R @ cov @ R.T @ J.T + DILATION * torch.eye(2, dtype=torch.float64)


def color_towards(splats: Splats, i: int, camera: Camera, degree: int) -> Tensor:
    """Returns the colour of one Gaussian, [3]."""
    center = torch.from_numpy(camera.center)
    direction = splats.means[i] - center
    basis = sh_basis(direction / direction.norm(), degree)
    coefficients = splats.sh_dc[i][None]
    if i < len(splats.sh_rest):  # the others have no more
        coefficients = torch.cat([coefficients, splats.sh_rest[i]])
    used = min(len(basis), len(coefficients))
    return (basis[:used] @ coefficients[:used] + 0.5).clamp_min(0)


class _Harmonic(torch.autograd.Function):
    """One real spherical harmonic with a central difference as derivative."""

    @staticmethod
    def forward(ctx, direction, degree, order):
        ctx.save_for_backward(direction)
        ctx.which = degree, order
        return torch.tensor(_harmonic(direction.numpy(), degree, order), dtype=torch.float64)

    @staticmethod
    def backward(ctx, grad):
        direction, (degree, order) = ctx.saved_tensors[0].numpy(), ctx.which
        step = 1e-5
        slopes = [
            (_harmonic(direction + step * e, degree, order)
             - _harmonic(direction - step * e, degree, order)) / (2 * step)
            for e in np.eye(3)
        ]
        return grad * torch.tensor(slopes, dtype=torch.float64), None, None


def sh_basis(direction: Tensor, degree: int) -> Tensor:
    """Returns the real spherical harmonics of degree 0 to `degree` at a direction, [K]."""
    return torch.stack([
        _Harmonic.apply(direction, n, m) for n in range(degree + 1) for m in range(-n, n + 1)])


def _harmonic(direction: np.ndarray, degree: int, order: int) -> float:
    x, y, z = direction / np.linalg.norm(direction)
    m = abs(order)
    scale = math.sqrt((2 * degree + 1) / (4 * math.pi)
                      * math.factorial(degree - m) / math.factorial(degree + m))
    legendre = lpmv(m, degree, z)  # holds the Condon-Shortley phase (-1)^m, as INRIA's signs do
    angle = math.atan2(y, x)
    if order == 0:
        return scale * legendre
    wave = math.sin(m * angle) if order < 0 else math.cos(m * angle)
    return math.sqrt(2) * scale * legendre * wave
