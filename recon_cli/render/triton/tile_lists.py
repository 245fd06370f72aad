"""The lists of a view: Gaussians as it sees them, and their instances by tile and depth."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import triton
from torch import Tensor

from recon_cli.render.triton import projection as kernels
from recon_cli.render.triton.compositing import RECORD, SIDE
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
    return Projected(records, shapes, centers, depths, radii, before_each(touched), broken)


def before_each(touched: Tensor) -> Tensor:
    """Returns the tiles [N + 1] int64 that the Gaussians before each meet, and in all."""
    return torch.nn.functional.pad(torch.cumsum(touched, 0), (1, 0))


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
    tiles_x, tiles_y = triton.cdiv(camera.width, SIDE.value), triton.cdiv(camera.height, SIDE.value)
    keys, owners = keyed(seen, starts, view, tiles_x, room)
    keys, slots = in_order(keys)
    members, offsets = placed(seen, starts, keys, slots, owners, tiles_x)
    first, order = by_tile(keys, tiles_x * tiles_y)
    return Lists(tiles_x, seen.records, starts, order, first, members, slots, offsets)


def keyed(
    seen: Projected, starts: Tensor, view: Tensor, tiles_x: int, room: int
) -> tuple[Tensor, Tensor]:
    """Returns key [room] int64 and Gaussian [room] int32 of each instance, by slot."""
    n, device = len(seen.depths), seen.depths.device
    keys = torch.full((room,), _BEHIND, dtype=torch.int64, device=device)
    owners = torch.empty(room, dtype=torch.int32, device=device)
    if n and room:
        kernels.list_tiles[(triton.cdiv(n, kernels.BLOCK),)](
            seen.shapes, seen.centers, seen.depths, starts, view, n, tiles_x, keys, owners,
            BLOCK=kernels.BLOCK)
    return keys, owners


def in_order(keys: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the keys in order, and the slot [room] int64 of each."""
    # slots ascend with the Gaussians, so that a stable sort leaves ties in order of index
    ordered, slots = torch.sort(keys, stable=True)
    return ordered, slots


def placed(
    seen: Projected, starts: Tensor, keys: Tensor, slots: Tensor, owners: Tensor, tiles_x: int
) -> tuple[Tensor, Tensor]:
    """Returns members and offsets of `Lists`, by keys in order."""
    n, room = len(seen.depths), len(keys)
    members, offsets = torch.empty_like(owners), seen.depths.new_empty(room, 2)
    if n and room:
        kernels.place[(triton.cdiv(room, kernels.BLOCK),)](
            keys, slots, owners, seen.centers, seen.records, starts, n, tiles_x, members, offsets,
            BLOCK=kernels.BLOCK)
    return members, offsets


def by_tile(keys: Tensor, tiles: int) -> tuple[Tensor, Tensor]:
    """Returns first and order of `Lists`, by keys in order."""
    numbers = torch.arange(tiles + 1, device=keys.device)
    first = torch.searchsorted(keys, numbers * _LOWER).int()
    return first, torch.argsort(first[1:] - first[:-1], descending=True, stable=True).int()
