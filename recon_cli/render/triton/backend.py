"""The triton backend behind the contract: float32, differentiable by autograd.

Projection and binning are the torch backend's, which run wholly on the device. The kernels take
what grows with the pixels: compositing, its gradients, and the sums over each Gaussian's tiles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
import triton
from torch import Tensor

from recon_cli.render.binning import Instances, bin_to_tiles
from recon_cli.render.contract import TILE, RenderOutput, Statistics
from recon_cli.render.projection import Projection, project
from recon_cli.render.torch_blocks import gradients_of, whitening_factors
from recon_cli.render.triton.fragments import LOG2_E, PIXELS, RECORD, SUMS
from recon_cli.render.triton.raster_backward import decompose, gather
from recon_cli.render.triton.raster_forward import CHUNK, composite, tally
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats

_UNIT = math.sqrt(LOG2_E / 2)  # what the whitening factors are multiplied by: alpha as a power of 2
_BLOCK = 128  # Gaussians a program where sums are gathered
_WARPS = 1  # a tile is one warp: no barrier in its sums


def render(
    splats: Splats, camera: Camera, background: Tensor, sh_degree: int, scores: bool,
    mask: Tensor | None = None,
) -> RenderOutput:
    """Renders by the contract; see `recon_cli.render.registry.render`.

    Raises:
        ValueError: the splats are not float32.
    """
    if splats.means.dtype != torch.float32:
        raise ValueError(
            f"the triton backend takes float32, not {splats.means.dtype}; the torch backend takes "
            "both")
    projection = project(splats, camera, sh_degree)
    with torch.no_grad():
        lists = Lists.of(projection, bin_to_tiles(projection, camera.width, camera.height))
        statistics = Statistics.zeros(splats.means)
        statistics.broken = projection.broken
        a, b, c = projection.cov2d.unbind(-1)
        longest = (a + c) / 2 + (((a - c) / 2) ** 2 + b * b).sqrt()
        statistics.radii[projection.ids] = 3 * longest.sqrt()
    # log sigmoid keeps its gradient where the sigmoid has rounded to 1
    log_opacities = torch.nn.functional.logsigmoid(splats.logit_opacities[projection.ids])
    channels = torch.cat([projection.colors, projection.depths[:, None]], dim=-1)
    rgb, alpha, depth = _Rasterize.apply(
        projection.means2d, projection.directions, projection.log_scales, log_opacities, channels,
        background, projection.ids, lists, (camera.height, camera.width), statistics, scores, mask)
    return RenderOutput(rgb, alpha, depth, statistics)


@dataclass(frozen=True, eq=False)
class Lists:
    """What the kernels read of the instances, E of M Gaussians.

    Attributes:
        tiles_x: tiles in a row.
        order: [tiles] int32, longest list first.
        first: [tiles + 1] int32, where the instances of each tile begin.
        members: [E] int32, Gaussian of each instance, by tile and depth.
        slots: [E] int32, its place in the order by Gaussian.
        starts: [M + 1] int32, first slot of each Gaussian.
        whitening: [M, 3] float64 factors (U_X, U_Y, V_Y).
        offsets: [E, 2] u and v at the first pixel of the tile.
    """

    tiles_x: int
    order: Tensor
    first: Tensor
    members: Tensor
    slots: Tensor
    starts: Tensor
    whitening: Tensor
    offsets: Tensor

    @staticmethod
    def of(projection: Projection, instances: Instances) -> Lists:
        """Returns the lists of the instances of a view."""
        counts, members = instances.counts, instances.gaussians
        tile = torch.repeat_interleave(counts, output_size=len(members))
        whitening = _UNIT * whitening_factors(projection.cov2d, projection.det)
        corner = torch.stack([tile % instances.tiles_x, tile // instances.tiles_x], dim=-1)
        dx, dy = (TILE * corner + 0.5 - projection.means2d.double()[members]).unbind(-1)
        u_x, u_y, v_y = whitening[members].unbind(-1)
        return Lists(
            instances.tiles_x, torch.argsort(counts, descending=True, stable=True).int(),
            _begins(counts), members.int(), instances.slots.int(), _begins(instances.per_gaussian),
            whitening, torch.stack([u_x * dx + u_y * dy, v_y * dy], dim=-1).float())


def _begins(counts: Tensor) -> Tensor:
    """Returns [n + 1] int32 where runs of these lengths begin, and where the last one ends."""
    return torch.nn.functional.pad(torch.cumsum(counts, 0), (1, 0)).int()


class _Rasterize(torch.autograd.Function):
    """Composites instances and carries gradients back to the projected Gaussians."""

    @staticmethod
    def forward(
        ctx: Any,
        means2d: Tensor, directions: Tensor, log_scales: Tensor, log_opacities: Tensor,
        channels: Tensor, background: Tensor, ids: Tensor, lists: Lists, size: tuple[int, int],
        statistics: Statistics, scores: bool, mask: Tensor | None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        height, width = size
        tiles, instances = len(lists.order), len(lists.members)
        records = torch.cat([
            lists.whitening.float(), log_opacities[:, None] * LOG2_E, channels], dim=-1)
        assert records.shape[1] == RECORD
        rgb, alpha, depth = (means2d.new_empty(height, width, 3), means2d.new_empty(size),
                             means2d.new_empty(size))
        final = means2d.new_empty(tiles, PIXELS)
        last = torch.empty(tiles, PIXELS, dtype=torch.int32, device=means2d.device)
        # what leaves a tile early is never counted
        tallied = [torch.zeros(instances * scores, dtype=kind, device=means2d.device)
                   for kind in (torch.int32, torch.float32, torch.float32)]
        counting = None if mask is None else mask.contiguous().to(torch.uint8)
        composite[(tiles,)](
            lists.order, lists.first, lists.members, lists.offsets, records,
            background.contiguous(), width, height, lists.tiles_x, rgb, alpha, depth, final, last,
            lists.slots, counting, *tallied, SCORES=scores, MASKED=counting is not None,
            CHUNK=CHUNK, num_warps=_WARPS)
        if scores and len(ids):
            _tally(ids, lists, tallied, statistics)
        ctx.save_for_backward(directions, log_scales, records, background, final, last, alpha)
        ctx.rest = ids, lists, statistics, scores, counting
        return rgb, alpha, depth

    @staticmethod
    def backward(
        ctx: Any, grad_rgb: Tensor, grad_alpha: Tensor, grad_depth: Tensor
    ) -> tuple[Tensor | None, ...]:
        directions, log_scales, records, background, final, last, alpha = ctx.saved_tensors
        ids, lists, statistics, scores, counting = ctx.rest
        height, width = alpha.shape
        sums = records.new_empty(len(lists.members), SUMS)
        grad_rgb = grad_rgb.contiguous()
        decompose[(len(lists.order),)](
            lists.order, lists.first, lists.members, lists.offsets, records,
            background.contiguous(), width, height, lists.tiles_x, final, last, grad_rgb,
            grad_alpha.contiguous(), grad_depth.contiguous(), lists.slots, counting, sums,
            SCORES=scores, MASKED=counting is not None, num_warps=_WARPS)
        totals = records.new_empty(len(ids), SUMS)
        if len(ids):
            gather[(triton.cdiv(len(ids), _BLOCK),)](
                lists.starts, sums, len(ids), totals, USED=14 + scores, BLOCK=_BLOCK)
        grad_background = (grad_rgb * (1 - alpha)[..., None]).sum((0, 1))
        factors = totals.new_tensor([_UNIT, _UNIT, _UNIT**2, _UNIT**2, _UNIT**2])
        shape = [gradient.to(totals.dtype) for gradient in gradients_of(
            totals[:, 5:10] / factors, lists.whitening / _UNIT, directions, log_scales)]
        _write_statistics(ids, shape[0], totals, statistics, scores=scores)
        return (*shape, totals[:, 4], totals[:, :4], grad_background,
                None, None, None, None, None, None)


def _tally(ids: Tensor, lists: Lists, tallied: list[Tensor], statistics: Statistics) -> None:
    """Writes hits and blend weights of the Gaussians `ids`, [M]."""
    found = [values.new_empty(len(ids)) for values in (
        statistics.hits, statistics.blend_sum, statistics.blend_max)]
    tally[(triton.cdiv(len(ids), _BLOCK),)](
        lists.starts, *tallied, len(ids), *found, BLOCK=_BLOCK)
    statistics.hits[ids], statistics.blend_sum[ids], statistics.blend_max[ids] = found


def _write_statistics(
    ids: Tensor, means2d_grad: Tensor, totals: Tensor, statistics: Statistics, *, scores: bool
) -> None:
    """Writes what the backward pass gathers, from the sums [M, SUMS] of `decompose`."""
    statistics.means2d_grad[ids] = means2d_grad
    statistics.absolute_grad[ids] = totals[:, 10:12] / _UNIT**2
    squares, count = totals[:, 12].double(), totals[:, 13].double().clamp_min(1)
    variance = squares - totals[:, 4].double().square() / count
    statistics.variance[ids] = variance.clamp_min(0).to(totals.dtype)
    if scores:
        statistics.loo[ids] = totals[:, 14]
