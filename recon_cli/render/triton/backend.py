"""The triton backend behind the contract: float32, differentiable by autograd."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import triton
from torch import Tensor

from recon_cli.render.contract import RenderOutput, Statistics
from recon_cli.render.triton import projection as kernels
from recon_cli.render.triton.fragments import PIXELS, RECORD, SIDE, SUMS
from recon_cli.render.triton.projection_gradient import unproject
from recon_cli.render.triton.raster_backward import decompose
from recon_cli.render.triton.raster_forward import CHUNK, composite, tally
from recon_cli.render.triton.view import view_numbers
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import TERMS, Splats

_WARPS = 1  # a tile is one warp: no barrier in its sums
_LOWER = 1 << 32  # a key is a tile times this, and the bits of a depth


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
    statistics = Statistics.zeros(splats.means)
    tensors = list(splats.parameters().values())
    if min(sh_degree, splats.sh_degree) == 0:
        tensors[5] = tensors[5].detach()  # no part of the picture
    rgb, alpha, depth = _Render.apply(
        *tensors, background, camera, sh_degree, scores, mask, statistics)
    return RenderOutput(rgb, alpha, depth, statistics)


@dataclass(frozen=True, eq=False)
class Lists:
    """Gaussians as a view sees them, and E instances of them, each in a tile.

    Attributes:
        tiles_x: tiles in a row.
        records: [N, RECORD], see `fragments`.
        starts: [N + 1] int32, first slot of each Gaussian.
        order: [tiles] int32, longest list first.
        first: [tiles + 1] int32, where the instances of each tile begin.
        members: [E] int32, Gaussian of each instance, by tile and depth.
        slots: [E] int64, its place in the order by Gaussian.
        offsets: [E, 2] u and v at the first pixel of the tile.
        radii: [N], see `Statistics`.
        broken: how many Gaussians hold or become what is not finite.
    """

    tiles_x: int
    records: Tensor
    starts: Tensor
    order: Tensor
    first: Tensor
    members: Tensor
    slots: Tensor
    offsets: Tensor
    radii: Tensor
    broken: int


def project(splats: Splats, camera: Camera, view: Tensor, terms: int) -> Lists:
    """Returns the lists of a view.

    Args:
        splats: contiguous.
        camera: whose size is taken.
        view: its numbers, see `view.view_numbers`.
        terms: coefficients a channel that are in use.
    """
    n, like = len(splats), splats.means
    tiles_x, tiles_y = triton.cdiv(camera.width, SIDE.value), triton.cdiv(camera.height, SIDE.value)
    records, shapes = like.new_empty(n, RECORD), like.new_empty(n, kernels.SHAPES)
    centers, depths = like.new_empty(n, 2, dtype=torch.float64), like.new_empty(n)
    touched, radii = like.new_empty(n, dtype=torch.int32), like.new_empty(n)
    programs = triton.cdiv(n, kernels.BLOCK)
    broken = like.new_zeros(programs, dtype=torch.int32)
    if n:
        kernels.project[(programs,)](
            *splats.parameters().values(), view, n, len(splats.sh_rest), records, shapes, centers,
            depths, touched, radii, broken, STRIDE=3 * TERMS[splats.sh_degree], TERMS=terms,
            BLOCK=kernels.BLOCK)
    starts = torch.nn.functional.pad(torch.cumsum(touched, 0), (1, 0))
    # the one wait for the device: how much memory the instances take
    instances, unsound = torch.stack([starts[-1], broken.sum()]).tolist()
    starts = starts.int()
    keys = torch.empty(instances, dtype=torch.int64, device=like.device)
    owners = torch.empty(instances, dtype=torch.int32, device=like.device)
    members, offsets = torch.empty_like(owners), like.new_empty(instances, 2)
    if instances:
        kernels.list_tiles[(programs,)](
            shapes, centers, depths, touched, starts, view, n, tiles_x, keys, owners,
            BLOCK=kernels.BLOCK)
    # slots ascend with the Gaussians, so that a stable sort leaves ties in order of index
    keys, slots = torch.sort(keys, stable=True)
    if instances:
        kernels.place[(triton.cdiv(instances, kernels.BLOCK),)](
            keys, slots, owners, centers, records, instances, tiles_x, members, offsets,
            BLOCK=kernels.BLOCK)
    tiles = torch.arange(tiles_x * tiles_y + 1, device=like.device)
    first = torch.searchsorted(keys, tiles * _LOWER).int()
    order = torch.argsort(first[1:] - first[:-1], descending=True, stable=True).int()
    return Lists(tiles_x, records, starts, order, first, members, slots, offsets, radii, unsound)


class _Render(torch.autograd.Function):
    """All kernels of a view as one differentiable operation."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, quats: Tensor, log_scales: Tensor, logit_opacities: Tensor,
        sh_dc: Tensor, sh_rest: Tensor, background: Tensor, camera: Camera, sh_degree: int,
        scores: bool, mask: Tensor | None, statistics: Statistics,
    ) -> tuple[Tensor, Tensor, Tensor]:
        splats = Splats(*(tensor.contiguous() for tensor in (
            means, quats, log_scales, logit_opacities, sh_dc, sh_rest)))
        terms = TERMS[min(sh_degree, splats.sh_degree)]
        view = view_numbers(camera, means.device)
        lists = project(splats, camera, view, terms)
        statistics.radii, statistics.broken = lists.radii, lists.broken
        height, width = camera.height, camera.width
        rgb, alpha, depth = (means.new_empty(height, width, 3), means.new_empty(height, width),
                             means.new_empty(height, width))
        final = means.new_empty(len(lists.order), PIXELS)
        last = torch.empty(len(lists.order), PIXELS, dtype=torch.int32, device=means.device)
        # zeros: an instance that a tile leaves out is never counted
        tallied = [means.new_zeros(len(lists.members) * scores, dtype=kind)
                   for kind in (torch.int32, torch.float32, torch.float32)]
        counting = None if mask is None else mask.contiguous().to(torch.uint8)
        background = background.contiguous()
        composite[(len(lists.order),)](
            lists.order, lists.first, lists.members, lists.offsets, lists.records, background,
            width, height, lists.tiles_x, rgb, alpha, depth, final, last, lists.slots, counting,
            *tallied, SCORES=scores, MASKED=counting is not None, CHUNK=CHUNK, num_warps=_WARPS)
        if scores and len(splats):
            tally[(triton.cdiv(len(splats), kernels.BLOCK),)](
                lists.starts, *tallied, len(splats), statistics.hits, statistics.blend_sum,
                statistics.blend_max, BLOCK=kernels.BLOCK)
        # the output itself would hold its own graph, and with it everything here, for ever
        ctx.save_for_backward(
            *splats.parameters().values(), view, background, final, last, alpha.detach())
        ctx.rest = lists, statistics, terms, scores, counting
        return rgb, alpha, depth

    @staticmethod
    def backward(
        ctx: Any, grad_rgb: Tensor, grad_alpha: Tensor, grad_depth: Tensor
    ) -> tuple[Tensor | None, ...]:
        *tensors, view, background, final, last, alpha = ctx.saved_tensors
        lists, statistics, terms, scores, counting = ctx.rest
        splats = Splats(*tensors)
        height, width = alpha.shape
        sums = alpha.new_empty(len(lists.members), SUMS)
        grad_rgb = grad_rgb.contiguous()
        decompose[(len(lists.order),)](
            lists.order, lists.first, lists.members, lists.offsets, lists.records, background,
            width, height, lists.tiles_x, final, last, grad_rgb, grad_alpha.contiguous(),
            grad_depth.contiguous(), lists.slots, counting, sums, SCORES=scores,
            MASKED=counting is not None, num_warps=_WARPS)
        gradients = [torch.empty_like(tensor) for tensor in tensors]
        if len(splats):
            unproject[(triton.cdiv(len(splats), kernels.BLOCK),)](
                splats.means, splats.quats, splats.log_scales, splats.logit_opacities,
                splats.sh_rest, view, len(splats), len(splats.sh_rest), lists.records,
                lists.starts, sums, *gradients, statistics.means2d_grad, statistics.absolute_grad,
                statistics.variance, statistics.loo, STRIDE=3 * TERMS[splats.sh_degree],
                TERMS=terms, SCORES=scores, BLOCK=kernels.BLOCK)
        grad_background = (grad_rgb * (1 - alpha)[..., None]).sum((0, 1))
        return (*gradients, grad_background, None, None, None, None, None)
