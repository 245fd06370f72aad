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


def exactly(values: Tensor) -> Tensor:
    """Returns values as they are: the oracle rounds nothing by itself."""
    return values


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
    order = torch.argsort(local[:, 2].detach(), stable=True)
    order = order[local[order, 2] > NEAR]
    means, covs = _project(local[order], _covariances(splats, order), R, camera)
    inverses = torch.linalg.inv(covs)
    # log sigmoid keeps its gradient where the sigmoid has rounded to 1
    opacities = torch.nn.functional.logsigmoid(splats.logit_opacities[order]).exp()
    colors, depths = _colors(splats, order, camera, sh_degree), local[order, 2]
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
    for k, i in enumerate(order.tolist()):
        d = pixels - means[k]
        if nudges is not None:
            d = d - nudges.means2d[i]
        alpha = opacities[k] * torch.exp(-((d @ inverses[k]) * d).sum(-1) / 2)
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
        rgb = rgb + weight[..., None] * colors[k]
        depth = depth + weight * depths[k]
        left = torch.where(part, left * (1 - alpha), left)
    return Composite(
        rgb + left[..., None] * background, 1 - left, depth, alphas, weights, margin.detach())


def _covariances(splats: Splats, ids: Tensor) -> Tensor:
    quats = splats.quats[ids]
    given = quats.abs().amax(1, keepdim=True) > 1e-30  # zero stands for no rotation
    quats = torch.where(given, quats, torch.tensor([1.0, 0, 0, 0], dtype=torch.float64))
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True)).unbind(1)
    R = torch.stack([
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1).view(-1, 3, 3)
    return R @ torch.diag_embed(torch.exp(2 * splats.log_scales[ids])) @ R.mT


def _project(
    local: Tensor, covs: Tensor, R: Tensor, camera: Camera
) -> tuple[Tensor, Tensor]:
    x, y, z = local.unbind(1)
    means = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], 1)
    wide, high = 0.15 * camera.width, 0.15 * camera.height
    u = (x / z).clamp((-camera.cx - wide) / camera.fx,
                      (camera.width - camera.cx + wide) / camera.fx)
    v = (y / z).clamp((-camera.cy - high) / camera.fy,
                      (camera.height - camera.cy + high) / camera.fy)
    zero = torch.zeros_like(z)
    J = torch.stack([camera.fx / z, zero, -camera.fx * u / z,
                     zero, camera.fy / z, -camera.fy * v / z], 1).view(-1, 2, 3)
    return means, J @ R @ covs @ R.T @ J.mT + DILATION * torch.eye(2, dtype=torch.float64)


def _colors(splats: Splats, ids: Tensor, camera: Camera, degree: int) -> Tensor:
    """Returns the colours of Gaussians towards the camera, [M, 3]."""
    toward = splats.means[ids] - torch.from_numpy(camera.center)
    basis = sh_basis(toward / toward.norm(dim=1, keepdim=True), degree)
    colored, terms, _ = splats.sh_rest.shape  # the others have no more than sh_dc
    nothing = splats.sh_rest.new_zeros(len(splats) - colored, terms, 3)
    coefficients = torch.cat([splats.sh_dc[:, None], torch.cat([splats.sh_rest, nothing])], 1)
    used = min(basis.shape[1], 1 + terms)
    return ((basis[:, :used, None] * coefficients[ids, :used]).sum(1) + 0.5).clamp_min(0)


class _Harmonic(torch.autograd.Function):
    """One real spherical harmonic with a central difference as derivative."""

    @staticmethod
    def forward(ctx, directions, degree, order):
        ctx.save_for_backward(directions)
        ctx.which = degree, order
        return torch.from_numpy(_harmonic(directions.numpy(), degree, order))

    @staticmethod
    def backward(ctx, grad):
        directions, (degree, order) = ctx.saved_tensors[0].numpy(), ctx.which
        step = 1e-5
        slopes = [
            (_harmonic(directions + step * e, degree, order)
             - _harmonic(directions - step * e, degree, order)) / (2 * step)
            for e in np.eye(3)
        ]
        return grad[:, None] * torch.from_numpy(np.stack(slopes, 1)), None, None


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """Returns the real spherical harmonics of degree 0 to `degree` at directions [N, 3], [N, K]."""
    return torch.stack([
        _Harmonic.apply(directions, n, m) for n in range(degree + 1) for m in range(-n, n + 1)], 1)


def _harmonic(directions: np.ndarray, degree: int, order: int) -> np.ndarray:
    x, y, z = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).T
    m = abs(order)
    scale = math.sqrt((2 * degree + 1) / (4 * math.pi)
                      * math.factorial(degree - m) / math.factorial(degree + m))
    legendre = lpmv(m, degree, z)  # holds the Condon-Shortley phase (-1)^m, as INRIA's signs do
    if order == 0:
        return scale * legendre
    angle = m * np.arctan2(y, x)
    wave = np.sin(angle) if order < 0 else np.cos(angle)
    return math.sqrt(2) * scale * legendre * wave
