"""The largest regions of surface that few views show, or views from one direction only.

There the depth of the scene, and with it all that moves when one walks past, rests on little: film
them again, from several places that lie apart.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import label

from recon_cli.errors import MOST_NAMED
from recon_cli.scene.statistics import MIN_OBSERVATIONS
from recon_cli.trust.records import MIN_SPAN_DEG, PoorlySeenRegion
from recon_cli.trust.support import ViewSupport
from recon_cli.trust.surface import CELL, SurfaceCells

_LEAST = 0.002  # of the surface; smaller regions are noise around edges
_BLOCK = 3  # cells: what lies so near together, some 20 cm in a room, is one region
_LONGEST = round(1 / CELL)  # cells: a longer region is cut, so that its place says where it is

Grid = NDArray[np.int64]


def find_poorly_seen(
    cells: SurfaceCells, support: ViewSupport, frames: Sequence[str]
) -> tuple[PoorlySeenRegion, ...]:
    """Returns the largest regions, the largest first; `frames` are the names of support's views."""
    regions = sorted(_find_regions(cells), key=len, reverse=True)
    return tuple(_describe_region(cells, region, support, frames) for region in regions[:MOST_NAMED]
                 if len(region) >= _LEAST * len(cells.grid))


def _find_regions(cells: SurfaceCells) -> Iterator[Grid]:
    """Yields the numbers [M] of the cells of each region."""
    poor = np.flatnonzero(cells.few + cells.narrow > 0.5)
    if not len(poor):
        return
    blocks = cells.grid[poor] // _BLOCK
    blocks -= blocks.min(axis=0)
    space = np.zeros(blocks.max(axis=0) + 1, bool)
    space[tuple(blocks.T)] = True
    parts, _ = label(space, np.ones((3, 3, 3)))
    own = parts[tuple(blocks.T)]
    for part in np.unique(own):
        yield from _cut(cells.grid, poor[own == part])


def _cut(grid: Grid, region: Grid) -> Iterator[Grid]:
    """Yields a region, cut in half across its longest side while that is too long."""
    places = grid[region]
    sides = np.ptp(places, axis=0)
    if sides.max() < _LONGEST:
        yield region
        return
    along = places[:, sides.argmax()]
    low = along < along.min() + (sides.max() + 1) / 2
    yield from _cut(grid, region[low])
    yield from _cut(grid, region[~low])


def _describe_region(
    cells: SurfaceCells, region: Grid, support: ViewSupport, frames: Sequence[str]
) -> PoorlySeenRegion:
    places = (cells.grid[region] + 0.5) * cells.size
    middle = places[np.linalg.norm(places - places.mean(axis=0), axis=1).argmin()]
    few = bool(cells.few[region].sum() >= cells.narrow[region].sum())
    several, wide = cells.views >= MIN_OBSERVATIONS, cells.span_deg >= MIN_SPAN_DEG
    poor = np.isin(cells.cell, region) & (~several if few else several & ~wide)
    inside = torch.zeros_like(support.count, dtype=torch.bool)
    inside[cells.rows[torch.from_numpy(poor).to(cells.rows.device)]] = True
    shown = [int(inside[view].sum()) for view in support.rows]
    return PoorlySeenRegion(
        position=tuple(round(float(value), 4) for value in middle),
        size=round(float((np.ptp(cells.grid[region], axis=0).max() + 1) * cells.size), 4),
        share=round(len(region) / len(cells.grid), 4), few=few,
        views=round(float(np.median(cells.views[poor]))),
        span_deg=round(float(np.median(cells.span_deg[poor])), 1),
        frame=frames[int(np.argmax(shown))])
