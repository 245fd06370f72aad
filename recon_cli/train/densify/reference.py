"""Adaptive density control of the reference (Kerbl et al. 2023, section 5.2).

Small Gaussians whose projected mean is pulled hard are cloned, large ones are split in two,
transparent and oversized ones are deleted. Plain functions over splats; the caller tells the
optimizer which rows stayed.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from recon_cli.render.torch.projection import rotation_matrices
from recon_cli.scene.splats import Splats, joined
from recon_cli.train.densification_stats import DensificationStats

_SPLIT = 2  # Gaussians that replace one that is split
_SHRINK = 1.6  # their scales are divided by this
_MAX_RADIUS = 20.0  # pixels on the screen
RESET_OPACITY = 0.01


@dataclass(frozen=True)
class DensifyRule:
    """Thresholds of one densification.

    Attributes:
        gradient: mean pull from which a Gaussian is cloned or split.
        clone_scale: largest scale, world units, up to which it is cloned and not split.
        min_opacity: below this a Gaussian is deleted.
        large_scale: scale in world units from which it is deleted; None keeps large ones.
        most: count that is never exceeded; the hardest pulled come first.
    """

    gradient: float
    clone_scale: float
    min_opacity: float
    large_scale: float | None
    most: int


def densify(
    splats: Splats, gathered: DensificationStats, rule: DensifyRule, generator: torch.Generator
) -> tuple[Splats, Tensor]:
    """Returns the new Gaussians and the old row [M] that each continues, -1 for new ones."""
    opaque = splats.opacities.detach() >= rule.min_opacity
    kept = opaque & _not_oversized(splats, gathered, rule)
    selected = opaque & _hardest_pulled(gathered.mean_grad2d, rule, len(splats))
    small = splats.scales.detach().amax(1) <= rule.clone_scale
    clones = torch.nonzero(selected & small & kept)[:, 0]
    splits = torch.nonzero(selected & ~small)[:, 0]
    halves = _halves(splats, splits, generator)
    kept[splits] = False
    rows = torch.nonzero(kept)[:, 0]
    parts = [splats.select(rows), splats.select(clones), halves]
    result, order = joined(parts)
    new = torch.full((len(clones) + len(halves),), -1, device=rows.device)
    return result, torch.cat([rows, new])[order]


def _hardest_pulled(pull: Tensor, rule: DensifyRule, n: int) -> Tensor:
    """Returns a mask of at most `rule.most` - n Gaussians; each adds one, cloned or split."""
    selected = pull >= rule.gradient
    room = max(0, rule.most - n)
    if int(selected.sum()) > room:
        order = torch.argsort(pull, descending=True, stable=True)
        selected = torch.zeros_like(selected)
        selected[order[:room]] = True
    return selected


def _halves(splats: Splats, rows: Tensor, generator: torch.Generator) -> Splats:
    """Returns two smaller Gaussians for each row, drawn from the one that they replace."""
    parent, _ = joined([splats.select(rows)] * _SPLIT)
    noise = torch.randn(len(parent), 3, generator=generator).to(parent.means)
    offsets = rotation_matrices(parent.quats) @ (parent.scales * noise)[..., None]
    parent.means = parent.means + offsets[..., 0]
    parent.log_scales = parent.log_scales - torch.tensor(_SHRINK).log().item()
    return parent


def _not_oversized(splats: Splats, gathered: DensificationStats, rule: DensifyRule) -> Tensor:
    """Returns a mask of the Gaussians that are not too large on the screen or in the world."""
    if rule.large_scale is None:
        return torch.ones_like(gathered.radius, dtype=torch.bool)
    largest = splats.scales.detach().amax(1)
    fits: Tensor = (gathered.radius <= _MAX_RADIUS) & (largest <= rule.large_scale)
    return fits


def lowered_opacities(splats: Splats) -> Splats:
    """Returns the splats with every opacity at most RESET_OPACITY."""
    limit = torch.logit(torch.tensor(RESET_OPACITY)).item()
    lowered = splats.map(lambda tensor: tensor.detach())
    lowered.logit_opacities = lowered.logit_opacities.clamp_max(limit)
    return lowered
