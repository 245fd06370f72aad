"""An untiled brute force of `rasterization` in float64, from gsplat's published equations.

Every Gaussian at every pixel, one camera after the other. All numbers are tensors, so that autograd
gives each gradient, every entry of the cameras' matrices included. Shares nothing with the package
but the contract's constants.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from oracle import exactly, sh_basis
from torch import Tensor

from recon_cli.render.contract import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN


class Truth(NamedTuple):
    """The oracle's results.

    Attributes:
        images: [C, H, W, X].
        alphas: [C, H, W, 1].
        margin: [C, H, W] smallest relative distance of an alpha to 1/255, or of the transmittance
            behind a fragment to 1e-4.
        means2d: [C, N, 2] with a graph; its gradient is that of the images by it.
        conics: [C, N, 3].
        opacities: [C, N] times the compensation.
    """

    images: Tensor
    alphas: Tensor
    margin: Tensor
    means2d: Tensor
    conics: Tensor
    opacities: Tensor


def brute_force(
    means, quats, scales, opacities, colors, viewmats, Ks, width, height, *, near_plane=0.01,
    far_plane=1e10, eps2d=0.3, sh_degree=None, backgrounds=None, render_mode="RGB",
    rasterize_mode="classic", rounded: Callable[[Tensor], Tensor] = exactly,
) -> Truth:
    """Renders; the arguments are those of `rasterization`, and `rounded` of each intermediate."""
    views = []
    for c in range(len(viewmats)):
        per_camera = colors.dim() == (4 if sh_degree is not None else 3)
        shades = colors[c] if per_camera else colors
        local = rounded(means @ viewmats[c, :3, :3].T + viewmats[c, :3, 3])
        if sh_degree is not None:
            shades = rounded(_shades(means, shades, viewmats[c], sh_degree))
        depths = local[:, 2:]
        layers = {"RGB": shades, "D": depths, "ED": depths}.get(
            render_mode, torch.cat([shades, depths], 1))
        behind = means.new_zeros(layers.shape[1])
        if backgrounds is not None and "RGB" in render_mode:
            behind = torch.cat([backgrounds[c], behind[backgrounds.shape[1]:]])
        means2d, conics, share = _project(local, quats, scales, viewmats[c], Ks[c], width, height,
                                          eps2d, rounded)
        means2d.retain_grad()
        visible = opacities * (share.sqrt() if rasterize_mode == "antialiased" else 1)
        drawn = (depths[:, 0] >= near_plane) & (depths[:, 0] <= far_plane)
        image, alpha, margin = _composite(
            means2d, conics, visible, layers, behind, local[:, 2].detach(), drawn, width, height,
            rounded)
        if render_mode.endswith("ED"):
            image = torch.cat([image[..., :-1], image[..., -1:] / alpha.clamp(min=1e-10)], -1)
        views.append(Truth(image, alpha, margin, means2d, conics, visible))
    return Truth(*(
        list(part) if name == "means2d" else torch.stack(part)
        for name, part in zip(Truth._fields, zip(*views, strict=True), strict=True)))


def _shades(means, coefficients, viewmat, degree):
    center = torch.linalg.inv(viewmat)[:3, 3]
    towards = (means - center) / (means - center).norm(dim=1, keepdim=True)
    used = coefficients[:, :(degree + 1) ** 2]
    return ((sh_basis(towards, degree)[..., None] * used).sum(1) + 0.5).clamp_min(0)


def _project(local, quats, scales, viewmat, K, width, height, eps2d, rounded):
    w, x, y, z = rounded(quats / quats.norm(dim=1, keepdim=True)).unbind(1)
    turn = rounded(torch.stack([
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1).view(-1, 3, 3))
    cov = rounded(turn @ torch.diag_embed(scales ** 2) @ turn.mT)
    cov = rounded(viewmat[:3, :3] @ cov @ viewmat[:3, :3].T)
    x, y, z = local.unbind(1)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    u = (x / z).clamp((-cx - 0.15 * width) / fx, (width - cx + 0.15 * width) / fx)
    v = (y / z).clamp((-cy - 0.15 * height) / fy, (height - cy + 0.15 * height) / fy)
    zero = torch.zeros_like(z)
    J = rounded(torch.stack([fx / z, zero, -fx * u / z, zero, fy / z, -fy * v / z], 1))
    plain = rounded(J.view(-1, 2, 3) @ cov @ J.view(-1, 2, 3).mT)
    wide = rounded(plain + eps2d * torch.eye(2, dtype=plain.dtype))
    inverse = rounded(torch.linalg.inv(wide))
    means2d = rounded(torch.stack([fx * x / z + cx, fy * y / z + cy], 1))
    share = rounded((torch.linalg.det(plain) / torch.linalg.det(wide)).clamp_min(1e-20))
    return means2d, torch.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], 1), share


def _composite(means2d, conics, opacities, layers, behind, depths, drawn, width, height, rounded):
    rows, columns = torch.meshgrid(
        torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack([columns, rows], -1).double()
    image = torch.zeros(height, width, layers.shape[1], dtype=torch.float64)
    left = torch.ones(height, width, dtype=torch.float64)
    margin, running = torch.full_like(left, torch.inf), torch.ones_like(left, dtype=torch.bool)
    for i in torch.argsort(depths, stable=True).tolist():
        if not drawn[i]:
            continue
        dx, dy = (pixels - means2d[i]).unbind(-1)
        a, b, c = conics[i]
        q = rounded(a * dx * dx + 2 * b * dx * dy + c * dy * dy)
        alpha = rounded(opacities[i] * torch.exp(-q / 2)).clamp_max(ALPHA_MAX)
        part = running & (alpha >= ALPHA_MIN)
        rest = rounded(left * (1 - alpha))
        margin = torch.where(running, margin.minimum((alpha / ALPHA_MIN - 1).abs()), margin)
        margin = torch.where(part, margin.minimum((rest / TRANSMITTANCE_MIN - 1).abs()), margin)
        running = running & ~(part & (rest < TRANSMITTANCE_MIN))
        part = part & running
        image = rounded(image + torch.where(part, alpha * left, 0.0)[..., None] * layers[i])
        left = torch.where(part, rest, left)
    return image + left[..., None] * behind, 1 - left[..., None], margin.detach()
