"""Which ellipse meets which tile: the list of Gaussians of every tile, in order of depth.

An instance is one Gaussian in one tile. The test is exact: the smallest value of the quadratic
form q over the tile's pixel centres is at most 2 ln(255 o), where alpha falls to 1/255. The
paper's 99% square keeps two to three times as many and is wrong by up to 6e-3 in alpha.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from recon_cli.render.contract import ALPHA_MIN, CULL_SLACK, TILE
from recon_cli.render.torch.projection import Projection, half_extents

_CANDIDATES = 1 << 20  # Gaussian-tile pairs that are tested at a time: bounds the memory


@dataclass(frozen=True, eq=False)
class Instances:
    """E instances, in two orders: by tile (to composite) and by Gaussian (to reduce)."""

    tiles_x: int
    tiles_y: int
    gaussians: Tensor  # [E] int64, by tile and depth: row in the projection
    slots: Tensor  # [E] int64, by tile and depth: position in the order by Gaussian
    counts: Tensor  # [tiles_y * tiles_x] int64, instances of each tile
    per_gaussian: Tensor  # [M] int64, instances of each Gaussian


def bin_to_tiles(projection: Projection, width: int, height: int) -> Instances:
    """Returns the instances of all projected Gaussians for an image of width x height pixels."""
    tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
    pairs = [_instances(projection, rows, boxes, tiles_x)
             for rows, boxes in _candidate_chunks(projection, tiles_x, tiles_y)]
    device = projection.means2d.device
    empty = torch.zeros(0, dtype=torch.int64, device=device)
    gaussians = torch.cat([pair[0] for pair in pairs]) if pairs else empty
    tiles = torch.cat([pair[1] for pair in pairs]) if pairs else empty
    # The projection is sorted by depth, so a stable sort by tile leaves each tile in depth order.
    slots = torch.sort(tiles.to(torch.int32), stable=True).indices
    return Instances(
        tiles_x, tiles_y, gaussians[slots], slots,
        counts=torch.bincount(tiles, minlength=tiles_x * tiles_y),
        per_gaussian=torch.bincount(gaussians, minlength=len(projection.ids)))


def _candidate_chunks(
    projection: Projection, tiles_x: int, tiles_y: int
) -> Iterator[tuple[Tensor, Tensor]]:
    """Yields rows [k] and tile boxes (x0, y0, columns, rows) [k, 4] of bounded total area."""
    half = half_extents(projection.cov2d, projection.opacities)
    limit = torch.tensor([tiles_x, tiles_y], device=half.device)
    # Pixel centres lie at +0.5: the first one at or right of m - h has index ceil(m - h - 0.5).
    low = ((projection.means2d - half - 0.5 - CULL_SLACK).ceil() / TILE).floor()
    high = ((projection.means2d + half - 0.5 + CULL_SLACK).floor() / TILE).floor()
    low = torch.minimum(low.clamp_min(0), limit.to(low.dtype)).long()
    high = torch.minimum(high.clamp_min(-1), limit.to(low.dtype) - 1).long()
    boxes = torch.cat([low, (high - low + 1).clamp_min(0)], dim=-1)
    total = torch.cumsum(boxes[:, 2] * boxes[:, 3], dim=0)
    first = 0
    while first < len(boxes):
        before = int(total[first - 1]) if first else 0
        last = int(torch.searchsorted(total, before + _CANDIDATES, right=True))
        last = max(last, first + 1)
        yield torch.arange(first, last, device=half.device), boxes[first:last]
        first = last


def _instances(
    projection: Projection, rows: Tensor, boxes: Tensor, tiles_x: int
) -> tuple[Tensor, Tensor]:
    """Returns (Gaussian, tile) of the candidates of some rows that pass the exact test."""
    area = boxes[:, 2] * boxes[:, 3]
    local = torch.repeat_interleave(area)
    inside = torch.arange(len(local), device=area.device) - (torch.cumsum(area, 0) - area)[local]
    columns = boxes[local, 2]
    tile_x = boxes[local, 0] + inside % columns
    tile_y = boxes[local, 1] + inside // columns
    gaussians = rows[local]
    keep = _meets(projection, gaussians, tile_x, tile_y)
    return gaussians[keep], (tile_y * tiles_x + tile_x)[keep]


def _meets(projection: Projection, rows: Tensor, tile_x: Tensor, tile_y: Tensor) -> Tensor:
    """Returns a mask: somewhere on the tile's pixel centres q <= 2 ln(255 o)."""
    a, b, c = projection.cov2d[rows].unbind(-1)
    det = projection.det[rows]
    mean_x, mean_y = projection.means2d[rows].unbind(-1)
    left, top = tile_x * TILE + 0.5 - mean_x, tile_y * TILE + 0.5 - mean_y
    right, bottom = left + (TILE - 1), top + (TILE - 1)
    zero = torch.zeros_like(left)
    near_x = torch.minimum(torch.maximum(zero, left), right)
    near_y = torch.minimum(torch.maximum(zero, top), bottom)

    def form(dx: Tensor, dy: Tensor) -> Tensor:
        """q = c/det (dx - b/c dy)^2 + dy^2/c, a sum of squares: nothing cancels in needles."""
        return c / det * (dx - b / c * dy) ** 2 + dy * dy / c

    # A convex form is smallest on the edges that face the mean; along each edge the unbounded
    # minimum is linear in the other coordinate and is clamped to the tile.
    on_column = form(near_x, torch.minimum(torch.maximum(b / a * near_x, top), bottom))
    on_row = form(torch.minimum(torch.maximum(b / c * near_y, left), right), near_y)
    reach = 2 * torch.log(projection.opacities[rows] / ALPHA_MIN)
    return torch.minimum(on_column, on_row) <= reach * (1 + CULL_SLACK) + CULL_SLACK
