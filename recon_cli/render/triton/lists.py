"""The lists of a view: Gaussians as it sees them, and their instances by tile and depth."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import triton
from torch import Tensor

from recon_cli.render.triton import projection as kernels
from recon_cli.render.triton.fragments import RECORD, SIDE
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import TERMS, Splats

_LOWER = 1 << 32  # a key is a tile times this, and the bits of a depth
_BEHIND = (1 << 63) - 1  # a key that sorts behind all others


@dataclass(frozen=True, eq=False)
class Projected:
    """N Gaussians as a view sees them.

    Attributes:
        records: [N, RECORD], see `fragments`.
        shapes: [N, SHAPES], see `projection.project`.
        centers: [N, 2] float64, pixels.
        depths: [N].
        radii: [N], see `Statistics`.
        ends: [N + 1] int64, tiles that the Gaussians before each meet; the last one is how many
            instances there are.
        broken: [programs] int32, how many hold or become what is not finite.
    """

    records: Tensor
    shapes: Tensor
    centers: Tensor
    depths: Tensor
    radii: Tensor
    ends: Tensor
    broken: Tensor


@dataclass(frozen=True, eq=False)
class Lists:
    """Instances of Gaussians, each in a tile, with room for E of them.

    Attributes:
        tiles_x: tiles in a row.
        records: [N, RECORD], see `fragments`.
        starts: [N + 1] int32, first slot of each Gaussian; the last one is how many there are.
        order: [tiles] int32, longest list first.
        first: [tiles + 1] int32, where the instances of each tile begin.
        members: [E] int32, Gaussian of each instance, by tile and depth.
        slots: [E] int64, its place in the order by Gaussian.
        offsets: [E, 2] u and v at the first pixel of the tile.
    """

    tiles_x: int
    records: Tensor
    starts: Tensor
    order: Tensor
    first: Tensor
    members: Tensor
    slots: Tensor
    offsets: Tensor


def project(splats: Splats, view: Tensor, terms: int) -> Projected:
    """Returns what a view sees; nothing waits for the device.

    Args:
        splats: contiguous.
        view: its numbers, see `view.view_numbers`.
        terms: coefficients a channel that are in use.
    """
    n, like = len(splats), splats.means
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
    ends = torch.nn.functional.pad(torch.cumsum(touched, 0), (1, 0))
    return Projected(records, shapes, centers, depths, radii, ends, broken)


def listed(
    seen: Projected, starts: Tensor, camera: Camera, view: Tensor, room: int
) -> Lists:
    """Returns the lists of a view; nothing waits for the device.

    Args:
        seen: by the view.
        starts: [N + 1] int32, first slot of each Gaussian; those whose slots are none are left out.
        camera: whose size is taken.
        view: its numbers.
        room: instances that there is memory for; `starts` ends there or before.
    """
    n, like = len(seen.depths), seen.depths
    tiles_x, tiles_y = triton.cdiv(camera.width, SIDE.value), triton.cdiv(camera.height, SIDE.value)
    keys = torch.full((room,), _BEHIND, dtype=torch.int64, device=like.device)
    owners = torch.empty(room, dtype=torch.int32, device=like.device)
    members, offsets = torch.empty_like(owners), like.new_empty(room, 2)
    if n and room:
        kernels.list_tiles[(triton.cdiv(n, kernels.BLOCK),)](
            seen.shapes, seen.centers, seen.depths, starts, view, n, tiles_x, keys, owners,
            BLOCK=kernels.BLOCK)
    # slots ascend with the Gaussians, so that a stable sort leaves ties in order of index
    keys, slots = torch.sort(keys, stable=True)
    if n and room:
        kernels.place[(triton.cdiv(room, kernels.BLOCK),)](
            keys, slots, owners, seen.centers, seen.records, starts, n, tiles_x, members, offsets,
            BLOCK=kernels.BLOCK)
    tiles = torch.arange(tiles_x * tiles_y + 1, device=like.device)
    first = torch.searchsorted(keys, tiles * _LOWER).int()
    order = torch.argsort(first[1:] - first[:-1], descending=True, stable=True).int()
    return Lists(tiles_x, seen.records, starts, order, first, members, slots, offsets)
