"""The kernels of a view in their order, host side: compositing, its gradients, the chain rule."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import triton
from torch import Tensor

from recon_cli.render.contract import Statistics
from recon_cli.render.triton.compositing import CHUNK, PIXELS, SUMS, composite, decompose, tally
from recon_cli.render.triton.project_backward import unproject
from recon_cli.render.triton.projection import BLOCK
from recon_cli.render.triton.tile_lists import Lists
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import TERMS, Splats

_WARPS = 1  # a tile is one warp: no barrier in its sums


@dataclass(frozen=True, eq=False)
class Picture:
    """What compositing leaves.

    Attributes:
        rgb: [H, W, 3].
        alpha: [H, W].
        depth: [H, W].
        final: [tiles, PIXELS] transmittance behind the last fragment.
        last: [tiles, PIXELS] int32, number in the tile of the last fragment, from 1.
    """

    rgb: Tensor
    alpha: Tensor
    depth: Tensor
    final: Tensor
    last: Tensor


@dataclass(frozen=True)
class Wanted:
    """What the backward pass is for.

    Attributes:
        plain: the loss depends on colours alone.
        details: absolute_grad and variance are wanted.
        loo: loo is wanted.
    """

    plain: bool = False
    details: bool = True
    loo: bool = False


def composited(
    lists: Lists, camera: Camera, background: Tensor, counting: Tensor | None,
    scores: Statistics | None,
) -> Picture:
    """Returns the picture.

    Args:
        lists: of the view.
        camera: whose size is taken.
        background: [3], contiguous.
        counting: [H, W] uint8, pixels that count in the scores; None where all do.
        scores: gets hits, blend_sum and blend_max; None where nobody asks.
    """
    like, height, width = lists.records, camera.height, camera.width
    rgb, alpha, depth = (like.new_empty(height, width, 3), like.new_empty(height, width),
                         like.new_empty(height, width))
    final = like.new_empty(len(lists.order), PIXELS)
    last = torch.empty(len(lists.order), PIXELS, dtype=torch.int32, device=like.device)
    # zeros: an instance that a tile leaves out is never counted
    tallied = [like.new_zeros(len(lists.members) if scores else 0, dtype=kind)
               for kind in (torch.int32, torch.float32, torch.float32)]
    composite[(len(lists.order),)](
        lists.order, lists.first, lists.members, lists.offsets, lists.records, background,
        width, height, lists.tiles_x, rgb, alpha, depth, final, last, lists.slots, counting,
        *tallied, SCORES=scores is not None, MASKED=counting is not None, CHUNK=CHUNK,
        num_warps=_WARPS)
    n = len(lists.records)
    if scores and n:
        tally[(triton.cdiv(n, BLOCK),)](
            lists.starts, *tallied, n, scores.hits, scores.blend_sum, scores.blend_max,
            BLOCK=BLOCK)
    return Picture(rgb, alpha, depth, final, last)


def decomposed(
    lists: Lists, picture: Picture, background: Tensor, counting: Tensor | None, wanted: Wanted,
    grad_rgb: Tensor, grad_alpha: Tensor | None = None, grad_depth: Tensor | None = None,
) -> Tensor:
    """Returns the sums [E, SUMS] of every instance, see `raster_backward.decompose`.

    Args:
        lists: of the view.
        picture: what they were composited to.
        background: [3], contiguous.
        counting: as in `composited`.
        wanted: what for.
        grad_rgb: [H, W, 3] dL/drgb, contiguous, as are the others.
        grad_alpha: [H, W]; None where `wanted` is plain.
        grad_depth: [H, W]; likewise.
    """
    height, width = picture.alpha.shape
    sums = lists.records.new_zeros(len(lists.members), SUMS)
    decompose[(len(lists.order),)](
        lists.order, lists.first, lists.members, lists.offsets, lists.records, background,
        width, height, lists.tiles_x, picture.final, picture.last, grad_rgb, grad_alpha,
        grad_depth, lists.slots, counting, sums, PLAIN=wanted.plain, DETAILS=wanted.details,
        SCORES=wanted.loo, MASKED=counting is not None, num_warps=_WARPS)
    return sums


def unprojected(
    splats: Splats, view: Tensor, lists: Lists, sums: Tensor, wanted: Wanted, terms: int,
    gradients: Splats, statistics: Statistics, *, counted: Tensor | None = None,
) -> None:
    """Writes the gradients of the raw parameters, and the statistics of the backward pass.

    Args:
        splats: N Gaussians, contiguous.
        view: its numbers, see `view.view_numbers`.
        lists: of the view.
        sums: of `decomposed`.
        wanted: the same.
        terms: coefficients a channel that are in use.
        gradients: tensors of the shapes of the parameters; sh_rest is left alone at degree 0.
        statistics: changed in place.
        counted: [1] int32; where it is zero, all is written as zero. None where it always counts.
    """
    n = len(splats)
    if n:
        unproject[(triton.cdiv(n, BLOCK),)](
            splats.means, splats.quats, splats.log_scales, splats.logit_opacities, splats.sh_rest,
            view, n, len(splats.sh_rest), lists.records, lists.starts, sums, counted,
            *gradients.parameters().values(), statistics.means2d_grad, statistics.absolute_grad,
            statistics.variance, statistics.loo, STRIDE=3 * TERMS[splats.sh_degree], TERMS=terms,
            GATED=counted is not None, PLAIN=wanted.plain, DETAILS=wanted.details,
            SCORES=wanted.loo, BLOCK=BLOCK)
