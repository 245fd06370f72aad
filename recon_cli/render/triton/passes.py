"""The kernels of a view in their order, host side: projection, tile lists, compositing, gradients.

Nothing here waits for the device, but `ellipse_gradients`.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import triton
from torch import Tensor

from recon_cli.render.contract import EllipseGradients, Statistics
from recon_cli.render.triton import projection as kernels
from recon_cli.render.triton.compositing import (
    BUCKET,
    CHUNK,
    PIXELS,
    RECORD,
    SIDE,
    STATE,
    SUMS,
    UNIT,
    composite,
    composite_backward,
    tally,
)
from recon_cli.render.triton.project_backward import harmonics_backward, project_backward
from recon_cli.render.triton.projection import BLOCK
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import TERMS, Splats

# one warp where there are sums over a tile's pixels: no barrier in them
_SUMMING_WARPS, _WARPS = 1, 4
# Gaussians a program that walks along their instances: the one with the most keeps all waiting
NARROW = 32
_COEFFICIENTS = 256  # of sh_rest a program
_LAST_KEY = torch.iinfo(torch.int64).max  # sorts behind all others


@dataclass(frozen=True, eq=False)
class ViewInput:
    """The inputs of the kernels over the Gaussians of a view."""

    splats: Splats  # contiguous
    view: Tensor  # see `gaussian.camera_buffer`
    terms: int  # coefficients a channel that are in use


@dataclass(frozen=True, eq=False)
class ProjectedSplats:
    """N Gaussians as a view sees them; see `projection.project`."""

    records: Tensor  # [N, RECORD]
    shapes: Tensor  # [N, SHAPES]
    centers: Tensor  # [N, 2] float64, pixels
    depths: Tensor  # [N]
    radii: Tensor  # [N]
    ends: Tensor  # [N + 1] int64, tiles of the Gaussians before each; at the end of all of them
    broken: Tensor  # [programs] int32


@dataclass(frozen=True, eq=False)
class TileLists:
    """Instances of Gaussians, each in a tile, with room for E of them."""

    tiles_x: int  # tiles in a row
    records: Tensor  # [N, RECORD]
    starts: Tensor  # [N + 1] int32, first slot of each Gaussian; the last one is the count
    order: Tensor  # [tiles] int32, longest list first
    first: Tensor  # [tiles + 1] int32, where the instances of each tile begin
    members: Tensor  # [E] int32, Gaussian of each instance, by tile and depth
    slots: Tensor  # [E] int64, its place in the order by Gaussian
    offsets: Tensor  # [E, 2] u and v at the first pixel of the tile


@dataclass(frozen=True, eq=False)
class CompositedImage:
    """The result of compositing."""

    rgb: Tensor  # [H, W, 3]
    alpha: Tensor  # [H, W]
    depth: Tensor  # [H, W]
    # what the backward pass needs, empty where none follows; see `compositing.composite`
    final: Tensor  # [tiles, PIXELS]
    last: Tensor  # [tiles, PIXELS] int32
    states: Tensor  # [buckets, STATE, PIXELS]
    bucket_tiles: Tensor  # [buckets] int32


@dataclass(frozen=True)
class BackwardOptions:
    """The outputs of the backward pass beside the gradients."""

    plain: bool = False  # the loss depends on colours alone
    details: bool = True  # variance is wanted
    loo: bool = False
    harmonics: bool = True  # without, the gradient of sh_rest is left as it is


def project_splats(source: ViewInput) -> ProjectedSplats:
    """Projects the Gaussians into a view and counts the tiles that each meets."""
    splats, like = source.splats, source.splats.means
    n, programs = len(splats), triton.cdiv(len(splats), BLOCK)
    records, shapes = like.new_empty(n, RECORD), like.new_empty(n, kernels.SHAPES)
    centers, depths = like.new_empty(n, 2, dtype=torch.float64), like.new_empty(n)
    touched, radii = like.new_empty(n, dtype=torch.int32), like.new_empty(n)
    broken = like.new_zeros(programs, dtype=torch.int32)
    if n:
        kernels.project[(programs,)](
            *splats.parameters().values(), source.view, n, len(splats.sh_rest), records, shapes,
            centers, depths, touched, radii, broken, STRIDE=3 * TERMS[splats.sh_degree],
            TERMS=source.terms, BLOCK=BLOCK)
    return ProjectedSplats(records, shapes, centers, depths, radii, prefix_sums(touched), broken)


def prefix_sums(touched: Tensor) -> Tensor:
    """Returns the tiles [N + 1] int64 that the Gaussians before each meet, and in all."""
    return torch.nn.functional.pad(torch.cumsum(touched, 0), (1, 0))


def build_tile_lists(
    projected: ProjectedSplats, starts: Tensor, camera: Camera, view: Tensor, room: int
) -> TileLists:
    """Returns the lists of a view, for the size of `camera`.

    `starts` [N + 1] int32 are the first slot of each Gaussian; those without slots are left out.
    `room` is how many instances there is memory for; `starts` ends there or before.
    """
    tiles_x, tiles_y = triton.cdiv(camera.width, SIDE.value), triton.cdiv(camera.height, SIDE.value)
    keys, owners = list_instances(projected, starts, view, tiles_x, room)
    keys, slots = sort_keys(keys)
    members, offsets = place_instances(projected, starts, keys, slots, owners, tiles_x)
    first, order = tile_ranges(keys, tiles_x * tiles_y)
    return TileLists(tiles_x, projected.records, starts, order, first, members, slots, offsets)


def list_instances(
    projected: ProjectedSplats, starts: Tensor, view: Tensor, tiles_x: int, room: int
) -> tuple[Tensor, Tensor]:
    """Returns key [room] int64 and Gaussian [room] int32 of each instance, by slot."""
    n, device = len(projected.depths), projected.depths.device
    keys = torch.full((room,), _LAST_KEY, dtype=torch.int64, device=device)
    owners = torch.empty(room, dtype=torch.int32, device=device)
    if n and room:
        kernels.list_tiles[(triton.cdiv(n, NARROW),)](
            projected.shapes, projected.centers, projected.depths, starts, view, n, tiles_x, keys,
            owners, BLOCK=NARROW, num_warps=1)
    return keys, owners


def sort_keys(keys: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the keys in order, and the slot [room] int64 of each."""
    # slots ascend with the Gaussians, so that a stable sort leaves ties in order of index
    ordered, slots = torch.sort(keys, stable=True)
    return ordered, slots


def place_instances(
    projected: ProjectedSplats, starts: Tensor, keys: Tensor, slots: Tensor, owners: Tensor,
    tiles_x: int,
) -> tuple[Tensor, Tensor]:
    """Returns members and offsets of `TileLists`, by keys in order."""
    n, room = len(projected.depths), len(keys)
    members, offsets = torch.empty_like(owners), projected.depths.new_empty(room, 2)
    if n and room:
        kernels.place[(triton.cdiv(room, BLOCK),)](
            keys, slots, owners, projected.centers, projected.records, starts, n, tiles_x, members,
            offsets, BLOCK=BLOCK)
    return members, offsets


def tile_ranges(keys: Tensor, tiles: int) -> tuple[Tensor, Tensor]:
    """Returns first and order of `TileLists`, by keys in order."""
    first = torch.empty(tiles + 1, dtype=torch.int32, device=keys.device)
    kernels.tile_starts[(triton.cdiv(len(keys) + 1, BLOCK),)](
        keys, len(keys), tiles, first, BLOCK=BLOCK)
    return first, torch.argsort(first[1:] - first[:-1], descending=True, stable=True).int()


def composite_tiles(
    lists: TileLists, camera: Camera, background: Tensor, counting: Tensor | None,
    scores: Statistics | None, *, keep: bool, plain: bool = False,
) -> CompositedImage:
    """Composites all tiles, for the size of `camera`.

    `background` [3] is contiguous; `counting` [H, W] uint8 are the pixels that count in the scores,
    None where all do; `scores` gets hits, blend_sum and blend_max. `keep` what
    `composite_tiles_backward` needs; with `plain` colours are all that is composited.
    """
    like, height, width = lists.records, camera.height, camera.width
    rgb = like.new_empty(height, width, 3)
    alpha, depth = (like.new_empty(0 if plain else height, width) for _ in range(2))
    tiles = len(lists.order)
    buckets = len(lists.members) // BUCKET + tiles if keep else 0
    final = like.new_empty(tiles if keep else 0, PIXELS)
    last = torch.empty(final.shape, dtype=torch.int32, device=like.device)
    states = like.new_empty(buckets, STATE - plain, PIXELS)
    bucket_tiles = torch.empty(buckets, dtype=torch.int32, device=like.device)
    # zeros: an instance that a tile leaves out is never counted
    tallied = [like.new_zeros(len(lists.members) if scores else 0, dtype=kind)
               for kind in (torch.int32, torch.float32, torch.float32)]
    composite[(tiles,)](
        lists.order, lists.first, lists.members, lists.offsets, lists.records, background,
        width, height, lists.tiles_x, rgb, alpha, depth, final, last, states, bucket_tiles,
        lists.slots, counting, *tallied, KEEP=keep, PLAIN=plain, SCORES=scores is not None,
        MASKED=counting is not None, CHUNK=CHUNK, BUCKET=BUCKET,
        num_warps=_WARPS if scores is None else _SUMMING_WARPS)
    n = len(lists.records)
    if scores and n:
        tally[(triton.cdiv(n, NARROW),)](
            lists.starts, *tallied, n, scores.hits, scores.blend_sum, scores.blend_max,
            BLOCK=NARROW, num_warps=1)
    return CompositedImage(rgb, alpha, depth, final, last, states, bucket_tiles)


def composite_tiles_backward(
    lists: TileLists, image: CompositedImage, background: Tensor, counting: Tensor | None,
    options: BackwardOptions, grad_rgb: Tensor, grad_alpha: Tensor | None = None,
    grad_depth: Tensor | None = None,
) -> Tensor:
    """Returns the sums [E, SUMS] of every instance, see `compositing.composite_backward`.

    The gradients [H, W, 3] and [H, W] are contiguous; the last two may be None with
    `options.plain`, which `image` need not be.
    """
    height, width, _ = image.rgb.shape
    sums = lists.records.new_empty(len(lists.members), SUMS)
    composite_backward[(len(image.bucket_tiles),)](
        lists.first, lists.members, lists.offsets, lists.records, background, width, height,
        lists.tiles_x, len(lists.order), image.rgb, image.depth, image.final, image.last,
        image.states, image.bucket_tiles, grad_rgb, grad_alpha, grad_depth, lists.slots, counting,
        sums, PLANES=image.states.shape[1],
        PLAIN=options.plain, DETAILS=options.details, SCORES=options.loo,
        MASKED=counting is not None, BUCKET=BUCKET, num_warps=_SUMMING_WARPS)
    return sums


def project_splats_backward(
    source: ViewInput, lists: TileLists, sums: Tensor, options: BackwardOptions,
    gradients: Splats, statistics: Statistics, *, counted: Tensor | None = None,
) -> None:
    """Writes the gradients of the raw parameters, and the statistics of the backward pass.

    The arguments are those of the passes before. sh_rest of `gradients` is left alone at degree 0.
    Where `counted` [1] int32 is zero, all is written as zero; None always counts.
    """
    splats, n, stride = source.splats, len(source.splats), 3 * TERMS[source.splats.sh_degree]
    if not n:
        return
    *others, sh_rest = gradients.parameters().values()
    directions = splats.means.new_empty(n if source.terms else 0, 3)
    project_backward[(triton.cdiv(n, NARROW),)](
        splats.means, splats.quats, splats.log_scales, splats.logit_opacities, splats.sh_rest,
        source.view, n, len(splats.sh_rest), lists.records, lists.starts, sums, counted,
        *others, directions, statistics.means2d_grad, statistics.variance, statistics.loo,
        STRIDE=stride, TERMS=source.terms, GATED=counted is not None, PLAIN=options.plain,
        DETAILS=options.details, SCORES=options.loo, BLOCK=NARROW, num_warps=1)
    if options.harmonics and source.terms and len(sh_rest):
        coefficients = sh_rest.numel() // 3
        harmonics_backward[(triton.cdiv(coefficients, _COEFFICIENTS),)](
            directions, gradients.sh_dc, coefficients, sh_rest, STRIDE=stride, TERMS=source.terms,
            BLOCK=_COEFFICIENTS)


def ellipse_gradients(lists: TileLists, sums: Tensor, *, plain: bool) -> EllipseGradients:
    """Returns what `composite_tiles_backward` summed, by Gaussian; `plain` as it was there."""
    lengths = (lists.starts[1:] - lists.starts[:-1]).long()
    totals = torch.segment_reduce(
        sums[:, :10].contiguous(), "sum", lengths=lengths, axis=0, unsafe=True, initial=0)
    ids = torch.nonzero(lengths)[:, 0]
    totals = totals[ids]
    # u and v of the kernels hold a factor UNIT
    factors = totals.new_tensor([1 / UNIT.value] * 5).pow(totals.new_tensor([1, 1, 2, 2, 2]))
    depths = torch.zeros_like(totals[:, 3]) if plain else totals[:, 3]
    return EllipseGradients(ids, totals[:, 5:10] * factors, totals[:, :3], depths)
