"""Densification: how the count of Gaussians changes during a run. Two strategies.

`reference` is the adaptive density control of Kerbl et al. 2023, section 5.2: small Gaussians with
a large gradient of the projected mean are cloned, large ones are split in two, transparent and
oversized ones are deleted. `budget` follows LiteGS (score from the variance of the per-fragment
gradient, opacity decay instead of resets), with a split along the longest axis; those that are to
blame for the least error make room for splits elsewhere. The count never exceeds what the schedule
allows, so that the time of a step is known before the run.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from recon_cli.errors import TrainingError
from recon_cli.render.torch.projection import rotation_matrices
from recon_cli.scene.splats import MOST_OPACITY, Splats, joined
from recon_cli.splats.values import morton_order
from recon_cli.train.fit.state import DensificationStats, TrainState
from recon_cli.train.fit.task import Task

# of `reference`
RESET_OPACITY = 0.01
_SPLIT = 2  # Gaussians that replace one that is split
_SHRINK = 1.6  # their scales are divided by this
_CLONE_SCALE = 0.01  # x extent; up to it one is cloned, above it split (INRIA's percent_dense)
_LARGE_SCALE = 0.1  # x extent; larger Gaussians are deleted once opacities were reset
# of `budget`
_GROWTH = 0.5  # of the count, at most, at once: children need some steps to find their place
# of the parent's: two halves at +-.5 sigma; a prototype tuned the four numbers together
_OFFSET = 0.5
_LONG = 0.5
_SHORT = 0.85
_OPACITY = 0.6
_FAINTEST = 1e-4  # opacity of a child

@dataclass(frozen=True)
class DensifyRule:
    """Thresholds of one densification."""

    gradient: float  # mean gradient from which a Gaussian is cloned or split
    clone_scale: float  # largest scale, world units, up to which it is cloned and not split
    min_opacity: float  # below this a Gaussian is deleted
    # scale in world units from which it is deleted; None keeps large ones
    large_scale: float | None
    most: int  # count that is never exceeded; the largest gradients come first
    max_radius: float = 20.0  # pixels on the screen; wider ones go where large ones do


def densify_reference(
    splats: Splats, gathered: DensificationStats, rule: DensifyRule, generator: torch.Generator
) -> tuple[Splats, Tensor]:
    """Returns the new Gaussians and the old row [M] that each continues, -1 for new ones."""
    opaque = splats.opacities.detach() >= rule.min_opacity
    stays = opaque & _fits(splats, gathered, rule)
    selected = opaque & _select_largest(gathered.mean_grad2d, rule, len(splats))
    small = splats.scales.detach().amax(1) <= rule.clone_scale
    clones = torch.nonzero(selected & small & stays)[:, 0]
    splits = torch.nonzero(selected & ~small)[:, 0]
    halves = _random_halves(splats, splits, generator)
    stays[splits] = False
    rows = torch.nonzero(stays)[:, 0]
    result, order = joined([splats.select(rows), splats.select(clones), halves])
    new = torch.full((len(clones) + len(halves),), -1, device=rows.device)
    return result, torch.cat([rows, new])[order]


def _select_largest(gradients: Tensor, rule: DensifyRule, n: int) -> Tensor:
    """Returns a mask of at most `rule.most` - n Gaussians; each adds one, cloned or split."""
    selected = gradients >= rule.gradient
    room = max(0, rule.most - n)
    if int(selected.sum()) > room:
        order = torch.argsort(gradients, descending=True, stable=True)
        selected = torch.zeros_like(selected)
        selected[order[:room]] = True
    return selected


def _random_halves(splats: Splats, rows: Tensor, generator: torch.Generator) -> Splats:
    """Returns two smaller Gaussians for each row, drawn from the one that they replace."""
    parent, _ = joined([splats.select(rows)] * _SPLIT)
    noise = torch.randn(len(parent), 3, generator=generator).to(parent.means)
    offsets = rotation_matrices(parent.quats) @ (parent.scales * noise)[..., None]
    parent.means = parent.means + offsets[..., 0]
    parent.log_scales = parent.log_scales - torch.tensor(_SHRINK).log().item()
    return parent


def _fits(splats: Splats, gathered: DensificationStats, rule: DensifyRule) -> Tensor:
    """Returns a mask of the Gaussians that are not too large on the screen or in the world."""
    if rule.large_scale is None:
        return torch.ones_like(gathered.radius, dtype=torch.bool)
    largest = splats.scales.detach().amax(1)
    fits: Tensor = (gathered.radius <= rule.max_radius) & (largest <= rule.large_scale)
    return fits


def cap_opacities(splats: Splats) -> Splats:
    """Returns the splats with every opacity at most RESET_OPACITY."""
    limit = torch.logit(torch.tensor(RESET_OPACITY)).item()
    lowered = splats.map(lambda tensor: tensor.detach())
    lowered.logit_opacities = lowered.logit_opacities.clamp_max(limit)
    return lowered


@dataclass(frozen=True)
class BudgetRule:
    """Limits of one densification."""

    target: int  # count that it aims at and never exceeds
    min_opacity: float  # below this a Gaussian is deleted
    decay: float  # all opacities are multiplied by this first; what the views need comes back
    replaced: float = 0.0  # share of those with a score, deleted from the least: others may split


def densify_budget(
    splats: Splats, score: Tensor, rule: BudgetRule, generator: torch.Generator
) -> tuple[Splats, Tensor]:
    """Returns the new Gaussians and the old row [M] that each continues, -1 for new ones.

    The probability of a split is proportional to `score` [N], the error that each is to blame for;
    those of the least score above zero are deleted first, as many as `rule.replaced` says.
    """
    splats = decay_opacities(splats, rule.decay)
    alive = splats.opacities >= rule.min_opacity
    known = alive & (score > 0)  # no view showed the others: nothing is known of them
    order = torch.argsort(torch.where(known, score, math.inf), stable=True)
    alive[order[:int(rule.replaced * int(known.sum()))]] = False
    room = rule.target - int(alive.sum())
    split = draw_rows(score * alive, min(room, int(_GROWTH * len(splats))), generator)
    alive[split] = False
    rows = torch.nonzero(alive)[:, 0]
    halves = _axis_halves(splats.select(split))
    result, order = joined([splats.select(rows), halves])
    new = torch.full((len(halves),), -1, device=rows.device)
    return result, torch.cat([rows, new])[order]


def decay_opacities(splats: Splats, factor: float) -> Splats:
    """Returns the splats with every opacity multiplied by `factor`, detached."""
    detached = splats.map(lambda tensor: tensor.detach())
    if factor < 1:
        detached.logit_opacities = torch.logit(detached.opacities * factor, 1e-7)
    return detached


def draw_rows(weight: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Returns at most `count` rows [K], drawn by weight without replacement, ascending.

    By the largest of log w + Gumbel noise (Efraimidis and Spirakis 2006); weight 0 is never drawn.
    """
    count = min(count, int((weight > 0).sum()))
    if count <= 0:
        return torch.zeros(0, dtype=torch.int64, device=weight.device)
    uniform = torch.rand(len(weight), generator=generator, dtype=torch.float64).to(weight.device)
    noise = -torch.log(-torch.log(uniform.clamp(1e-300, 1 - 1e-16)))
    key = torch.where(weight > 0, weight.double().clamp_min(1e-300).log() + noise, -math.inf)
    order = torch.argsort(key, descending=True, stable=True)
    return order[:count].sort().values


def _axis_halves(parent: Splats) -> Splats:
    """Returns two Gaussians for each, side by side along its longest axis."""
    axis = parent.log_scales.argmax(1, keepdim=True)  # [K, 1]
    rotations = rotation_matrices(parent.quats)
    direction = rotations.gather(2, axis[:, None].expand(-1, 3, 1))[..., 0]  # [K, 3]
    offset = _OFFSET * direction * parent.scales.gather(1, axis)
    shrink = torch.full_like(parent.log_scales, math.log(_SHORT))
    shrink.scatter_(1, axis, math.log(_LONG))
    child = parent.map(torch.clone)
    child.log_scales = parent.log_scales + shrink
    opacities = (_OPACITY * parent.opacities).clamp(_FAINTEST, MOST_OPACITY)
    child.logit_opacities = torch.logit(opacities)
    sides = [replace(child, means=child.means + side * offset) for side in (-1, 1)]
    return joined(sides)[0]


@dataclass(frozen=True)
class Strategy:
    """How the count changes during a run."""

    # called after each step; adds and deletes Gaussians when the schedule says so
    control: Callable[[TrainState, Task], None]
    variance: bool = False  # it needs the variance of the gradient over each Gaussian's pixels


def replace_splats(state: TrainState, splats: Splats, source: Tensor) -> None:
    """Replaces the Gaussians as `SplatOptimizer.replace`; TrainingError where none is left."""
    if len(splats) == 0:
        raise TrainingError(
            f"No Gaussian is left at step {state.iteration}.",
            hint="Lower --min-opacity, or check the cameras with another viewer.")
    state.optimizer.replace(splats, source)
    state.gathered = DensificationStats.zeros(len(splats), splats.means.device)


def _reference(state: TrainState, task: Task) -> None:
    """Clones, splits, deletes and resets (Kerbl et al. 2023, section 5)."""
    schedule, config = task.schedule, task.schedule.config
    if schedule.densifies(state.iteration):
        large = _LARGE_SCALE * task.extent if schedule.deletes_large(state.iteration) else None
        rule = DensifyRule(
            config.densify_gradient, _CLONE_SCALE * task.extent, config.min_opacity, large,
            config.max_gaussians, config.max_radius or math.inf)
        gathered = replace(
            state.gathered, pull=state.gathered.pull * task.inside(state.splats.means))
        replace_splats(state, *densify_reference(state.splats, gathered, rule, state.generator))
    if schedule.resets(state.iteration):
        rows = torch.arange(len(state.splats), device=task.device)
        state.optimizer.replace(cap_opacities(state.splats), rows)
        state.optimizer.forget("logit_opacities")


def _budget(state: TrainState, task: Task) -> None:
    """Splits where the error is, up to the count that the schedule allows."""
    schedule = task.schedule
    if schedule.densifies(state.iteration):
        rule = BudgetRule(
            schedule.target(state.iteration, state.first_count), schedule.config.min_opacity,
            schedule.recipe.opacity_decay, schedule.replaced)
        splats, source = densify_budget(
            state.splats, state.gathered.variance * task.inside(state.splats.means), rule,
            state.generator)
        if len(splats) and task.device.type == "cpu":  # what a view sees lies together in memory
            order = _spatial_order(splats)
            splats, source = splats.select(order), source[order]
        replace_splats(state, splats, source)


def _spatial_order(splats: Splats) -> Tensor:
    """Returns the rows [N] along a Z-order curve, those with coefficients first."""
    order = torch.from_numpy(morton_order(splats.means.detach().numpy()))
    plain = order >= len(splats.sh_rest)
    return torch.cat([order[~plain], order[plain]])


STRATEGIES = {"reference": Strategy(_reference), "budget": Strategy(_budget, variance=True)}
