"""View-dependent colour from real spherical harmonics of degree 0 to 3."""

from __future__ import annotations

import torch
from torch import Tensor

from recon_cli.scene.harmonics import basis_rest
from recon_cli.scene.splats import SH_C0


def colors_from_sh(
    offsets: Tensor,  # [M, 3] from the camera's centre to the Gaussians
    sh_dc: Tensor,  # [M, 3]
    sh_rest: Tensor,  # [M, 15, 3]
    degree: int,
) -> Tensor:
    """Returns the colours [M, 3] towards the camera, clamped at 0 from below."""
    colors = SH_C0 * sh_dc + 0.5
    if degree > 0:
        basis = basis_rest(torch.nn.functional.normalize(offsets, dim=-1, eps=1e-30), degree)
        used = sh_rest[:, :basis.shape[1]]
        colors = colors + (basis[:, None, :] @ used)[:, 0]
    return colors.clamp_min(0)
