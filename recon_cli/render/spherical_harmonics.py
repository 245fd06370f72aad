"""View-dependent colour from real spherical harmonics of degree 0 to 3."""

from __future__ import annotations

import torch
from torch import Tensor

from recon_cli.scene.harmonics import basis_rest
from recon_cli.scene.splats import SH_C0


def colors_from_sh(
    offsets: Tensor,  # [V, 3] from the camera's centre to the Gaussians
    sh_dc: Tensor,  # [V, 3]
    sh_rest: Tensor,  # [M, T, 3] of all Gaussians that have such coefficients
    ids: Tensor,  # [V] rows of the Gaussians; from row M on they are of degree 0
    degree: int,  # in use, at most that of T
) -> Tensor:
    """Returns the colours [V, 3] towards the camera, clamped at 0 from below."""
    colors = SH_C0 * sh_dc + 0.5
    if degree > 0:
        colored = torch.nonzero(ids < len(sh_rest))[:, 0]
        basis = basis_rest(
            torch.nn.functional.normalize(offsets[colored], dim=-1, eps=1e-30), degree)
        used = sh_rest[ids[colored], :basis.shape[1]]
        # each row is added to once: no order of additions to depend on
        colors = colors.index_add(0, colored, (basis[:, None, :] @ used)[:, 0])
    return colors.clamp_min(0)
