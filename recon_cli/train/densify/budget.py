"""Budgeted, error-driven densification: the count grows on a line, and where the error is.

After LiteGS (score from the variance of the per-fragment gradient, opacity decay in place of
resets), with a split along the longest axis. The count never exceeds what the schedule allows, so
the time of a step is known before the run. Plain functions over splats; the caller tells the
optimizer which rows stayed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from recon_cli.render.torch.projection import rotation_matrices
from recon_cli.scene.splats import Splats, joined

_GROWTH = 0.5  # of the count, at most, at once: children need some steps to find their place
# of the parent's: two halves at +-.5 sigma. A prototype tuned the four numbers together; they were
# not varied since
_OFFSET = 0.5
_LONG = 0.5
_SHORT = 0.85
_OPACITY = 0.6
_RANGE = 1e-4, 0.999  # of a child's opacity: the logit stays finite


@dataclass(frozen=True)
class BudgetRule:
    """What one densification may do.

    Attributes:
        target: count that it aims at and never exceeds.
        min_opacity: below this a Gaussian is deleted.
        decay: all opacities are multiplied by this first; what the views need comes back.
    """

    target: int
    min_opacity: float
    decay: float


def densify(
    splats: Splats, score: Tensor, rule: BudgetRule, generator: torch.Generator
) -> tuple[Splats, Tensor]:
    """Returns the new Gaussians and the old row [M] that each continues, -1 for new ones.

    Args:
        splats: N Gaussians.
        score: [N] the error that each is to blame for; the chance of a split is proportional.
        rule: count and thresholds.
        generator: on the CPU; decides the draw.
    """
    splats = decayed(splats, rule.decay)
    alive = splats.opacities >= rule.min_opacity
    room = rule.target - int(alive.sum())
    split = drawn(score * alive, min(room, int(_GROWTH * len(splats))), generator)
    alive[split] = False
    rows = torch.nonzero(alive)[:, 0]
    halves = _halves(splats.select(split))
    result, order = joined([splats.select(rows), halves])
    new = torch.full((len(halves),), -1, device=rows.device)
    return result, torch.cat([rows, new])[order]


def decayed(splats: Splats, factor: float) -> Splats:
    """Returns the splats with every opacity multiplied by `factor`, detached."""
    detached = splats.map(lambda tensor: tensor.detach())
    if factor < 1:
        detached.logit_opacities = torch.logit(detached.opacities * factor, 1e-7)
    return detached


def drawn(weight: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Returns the rows [K] of a draw without replacement, ascending; chance by weight.

    By the largest of log w + Gumbel noise (Efraimidis and Spirakis 2006). Rows of weight 0 are
    never drawn, so K is at most `count`.
    """
    count = min(count, int((weight > 0).sum()))
    if count <= 0:
        return torch.zeros(0, dtype=torch.int64, device=weight.device)
    uniform = torch.rand(len(weight), generator=generator, dtype=torch.float64).to(weight.device)
    noise = -torch.log(-torch.log(uniform.clamp(1e-300, 1 - 1e-16)))
    key = torch.where(weight > 0, weight.double().clamp_min(1e-300).log() + noise, -math.inf)
    order = torch.argsort(key, descending=True, stable=True)
    return order[:count].sort().values


def _halves(parent: Splats) -> Splats:
    """Returns two Gaussians for each, side by side along its longest axis."""
    axis = parent.log_scales.argmax(1, keepdim=True)  # [K, 1]
    rotations = rotation_matrices(parent.quats)
    direction = rotations.gather(2, axis[:, None].expand(-1, 3, 1))[..., 0]  # [K, 3]
    offset = _OFFSET * direction * parent.scales.gather(1, axis)
    shrink = torch.full_like(parent.log_scales, math.log(_SHORT))
    shrink.scatter_(1, axis, math.log(_LONG))
    child = parent.map(torch.clone)
    child.log_scales = parent.log_scales + shrink
    child.logit_opacities = torch.logit((_OPACITY * parent.opacities).clamp(*_RANGE))
    sides = [replace(child, means=child.means + side * offset) for side in (-1, 1)]
    return joined(sides)[0]
