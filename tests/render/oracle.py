"""An untiled brute force in float64: every Gaussian at every pixel, in the plainest code.

Shares nothing with the rasterizer but the contract's constants. The covariance is inverted as a
matrix, the spherical harmonics come from SciPy's associated Legendre functions.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.special import lpmv
from torch import Tensor

from recon_cli.render.contract import ALPHA_MAX, ALPHA_MIN, DILATION, NEAR, TRANSMITTANCE_MIN
from recon_cli.scene import Camera, Splats


def brute_force(
    splats: Splats, camera: Camera, background: Tensor, sh_degree: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Returns rgb [H, W, 3], alpha [H, W] and depth [H, W], differentiable."""
    return composited(splats, camera, background, sh_degree)[:3]


def blend_weights(splats: Splats, camera: Camera) -> Tensor:
    """Returns alpha T of every Gaussian at every pixel, [N, H, W]."""
    return composited(splats, camera, torch.zeros(3, dtype=torch.float64), 0)[3]


def composited(
    splats: Splats, camera: Camera, background: Tensor, sh_degree: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Returns rgb, alpha, depth and the detached blend weights [N, H, W]."""
    R = torch.from_numpy(camera.viewmat[:3, :3])
    t = torch.from_numpy(camera.viewmat[:3, 3])
    local = splats.means @ R.T + t
    rows, columns = torch.meshgrid(
        torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    pixels = torch.stack([columns, rows], -1).double()
    rgb = torch.zeros(camera.height, camera.width, 3, dtype=torch.float64)
    depth = torch.zeros(camera.height, camera.width, dtype=torch.float64)
    left = torch.ones(camera.height, camera.width, dtype=torch.float64)
    weights = torch.zeros(len(splats), camera.height, camera.width, dtype=torch.float64)
    running = torch.ones(camera.height, camera.width, dtype=torch.bool)
    for i in torch.argsort(local[:, 2].detach(), stable=True).tolist():
        if local[i, 2] <= NEAR:
            continue
        mean, cov = _project(local[i], _covariance(splats, i), R, camera)
        d = pixels - mean
        q = torch.einsum("hwi,ij,hwj->hw", d, torch.linalg.inv(cov), d)
        alpha = (splats.opacities[i] * torch.exp(-q / 2)).clamp_max(ALPHA_MAX)
        part = running & (alpha >= ALPHA_MIN)
        running = running & ~(part & (left * (1 - alpha) < TRANSMITTANCE_MIN))
        part = part & running
        weight = torch.where(part, alpha * left, 0.0)
        weights[i] = weight.detach()
        rgb = rgb + weight[..., None] * _color(splats, i, camera, sh_degree)
        depth = depth + weight * local[i, 2]
        left = torch.where(part, left * (1 - alpha), left)
    return rgb + left[..., None] * background, 1 - left, depth, weights


def _covariance(splats: Splats, i: int) -> Tensor:
    w, x, y, z = splats.quats[i] / splats.quats[i].norm()
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


def _color(splats: Splats, i: int, camera: Camera, degree: int) -> Tensor:
    center = torch.from_numpy(camera.center)
    direction = splats.means[i] - center
    basis = sh_basis(direction / direction.norm(), degree)
    coefficients = torch.cat([splats.sh_dc[i][None], splats.sh_rest[i]])[: len(basis)]
    return (basis @ coefficients + 0.5).clamp_min(0)


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
