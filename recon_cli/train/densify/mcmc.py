"""Densification by relocation and noise (Kheradmand et al. 2024, "3DGS as MCMC").

Transparent Gaussians move onto opaque ones, drawn by opacity, such that the picture stays; new
ones are added the same way up to the count that the schedule allows; noise along the own axes lets
those that are nearly transparent wander. Plain functions over splats.
"""

from __future__ import annotations

import torch
from torch import Tensor

from recon_cli.render.torch.projection import rotation_matrices
from recon_cli.scene.splats import Splats, joined
from recon_cli.train.densify.budget import drawn

_GROWTH = 0.5  # of the count, at most, at once
_RANGE = 0.005, 0.9999  # opacities of what is shared (gsplat's minimum)
_STEEP, _TURN = 100.0, 0.995  # noise fades for opacities above .005 (the paper's k and 1 - t)


def relocate(
    splats: Splats, target: int, min_opacity: float, generator: torch.Generator
) -> tuple[Splats, Tensor]:
    """Returns the new Gaussians and the old row [M] that each continues, -1 for new ones.

    Args:
        splats: N Gaussians.
        target: count that is aimed at and never exceeded.
        min_opacity: Gaussians below it move elsewhere.
        generator: on the CPU; decides the draw.
    """
    splats = splats.map(lambda tensor: tensor.detach())
    opacity = splats.opacities
    alive = opacity >= min_opacity
    wanted = min(max(target, 0), len(splats) + int(_GROWTH * len(splats))) - int(alive.sum())
    source = drawn(opacity * alive, wanted, generator)
    shared = _shared(splats.select(source))
    alive[source] = False
    rows = torch.nonzero(alive)[:, 0]
    result, order = joined([splats.select(rows), shared, shared])
    new = torch.full((2 * len(source),), -1, device=rows.device)
    return result, torch.cat([rows, new])[order]


def _shared(parent: Splats) -> Splats:
    """Returns what two Gaussians in one place must be to look like one (equation 9, N = 2)."""
    opacity = parent.opacities.clamp(*_RANGE)
    half = 1 - torch.sqrt(1 - opacity)
    scale = opacity / (2 * half - half.square() / 2**0.5)
    child = parent.map(torch.clone)
    child.logit_opacities = torch.logit(half.clamp_min(_RANGE[0]))
    child.log_scales = parent.log_scales + scale.log()[:, None]
    return child


@torch.no_grad()
def add_noise(splats: Splats, rate: float, generator: torch.Generator) -> None:
    """Moves the means in place by noise of the Gaussians' own covariance, times `rate`.

    (Equation 7.) Opaque Gaussians stay where they are.
    """
    noise = torch.randn(len(splats), 3, generator=generator).to(splats.means)
    free = torch.sigmoid(_STEEP * (1 - splats.opacities - _TURN))
    rotations = rotation_matrices(splats.quats)
    own = (rotations.mT @ noise[..., None])[..., 0] * splats.scales.square()
    splats.means += rate * free[:, None] * (rotations @ own[..., None])[..., 0]
