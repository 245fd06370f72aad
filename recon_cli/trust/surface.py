"""How much of a room's surface is well seen: by enough views, from directions far enough apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from recon_cli.scene.splats import Splats
from recon_cli.scene.statistics import MIN_OBSERVATIONS
from recon_cli.splats.ply import MIN_OPACITY
from recon_cli.trust.records import MIN_SPAN_DEG, SurfaceShares
from recon_cli.trust.support import ViewSupport

# Median distances from the middle beyond which a surface is outside, as through a window. The
# corner of an oblong room is two away.
_ROOM = 3.0
CELL = 0.03  # median distances: some centimetres in a room


def surface_rows(splats: Splats, support: ViewSupport) -> torch.Tensor:
    """Returns rows [K] of the Gaussians that are the surface of the room, seen by a view."""
    drawn = (splats.opacities >= MIN_OPACITY) & (support.count > 0)
    drawn &= torch.isfinite(splats.means).all(1)
    rows = torch.nonzero(drawn)[:, 0]
    if not len(rows):
        return rows
    inside = torch.from_numpy(_distances(splats, rows)[0] <= _ROOM)
    return rows[inside.to(rows.device)]


def _distances(splats: Splats, rows: torch.Tensor) -> tuple[NDArray[np.float64], float]:
    """Returns the distances [K] of Gaussians from their middle over the median, and the median."""
    means = splats.means[rows].detach().cpu().double().numpy()
    distances = np.linalg.norm(means - np.median(means, axis=0), axis=1)
    median = max(float(np.median(distances)), 1e-9)
    return distances / median, median


@dataclass(frozen=True, eq=False)
class SurfaceCells:
    """Cells of space that the surface passes through, and how well views see the surface there."""

    rows: torch.Tensor  # [K] of the Gaussians that are the surface
    views: NDArray[np.int64]  # [K] that show each
    span_deg: NDArray[np.float32]  # [K] angle that the rays of these views span
    cell: NDArray[np.int64]  # [K] number of its cell
    size: float  # of a cell, world units
    grid: NDArray[np.int64]  # [C, 3] position of the cells in units of `size`
    few: NDArray[np.float64]  # [C] share that too few views show, by opacity
    narrow: NDArray[np.float64]  # [C] share that views show from one direction


def find_cells(splats: Splats, support: ViewSupport) -> SurfaceCells:
    """Returns the cells of the surface; none where no view shows any."""
    rows = surface_rows(splats, support)
    views = support.count[rows].cpu().numpy()
    span_deg = np.degrees(support.span(splats.means)[rows].cpu().numpy())
    several, wide = views >= MIN_OBSERVATIONS, span_deg >= MIN_SPAN_DEG
    means = splats.means[rows].detach().cpu().double().numpy()
    size = CELL * _distances(splats, rows)[1] if len(rows) else 1.0
    grid, cell = np.unique(np.floor(means / size).astype(np.int64), axis=0, return_inverse=True)
    cell = cell.ravel()
    opacity = splats.opacities[rows].detach().cpu().double().numpy()
    total = np.bincount(cell, opacity)

    def share(which: NDArray[np.bool_]) -> NDArray[np.float64]:
        return np.asarray(np.bincount(cell, opacity * which) / total)

    return SurfaceCells(rows, views, span_deg, cell, size, grid, share(~several),
                        share(several & ~wide))


def surface_shares(cells: SurfaceCells) -> SurfaceShares:
    """Returns the shares by area: each cell counts once."""
    if not len(cells.grid):
        return SurfaceShares(well=0.0, narrow=0.0, few=0.0, cells=0)
    few, narrow = float(cells.few.mean()), float(cells.narrow.mean())
    return SurfaceShares(
        well=round(1 - few - narrow, 4), narrow=round(narrow, 4), few=round(few, 4),
        cells=len(cells.grid))
