"""Depth maps of the training views, and how far each of their pixels can be trusted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon_cli.kernels.thread_pool import pool
from recon_cli.render.surface_depth import render_surface
from recon_cli.room.kernels import LEAST_COSINE
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats
from recon_cli.scene.train_view import TrainView
from recon_cli.stereo.depths import NEAREST, TOLERANCE, camera_row
from recon_cli.stereo.kernels import compare

# Chosen on the room "living" and checked on "office", tests/bench/bench_mesh.py:
_NEIGHBOURS = 12  # views that each is compared with
_TURN = 2.0  # median depths that a difference of 1 in the cosine of two directions counts as
_LEAST_TURN = 0.5  # cosine between the directions of neighbours


@dataclass(frozen=True, eq=False)
class DepthMaps:
    """The surface in every view."""

    views: Sequence[TrainView]
    cameras: Sequence[Camera]
    depths: list[NDArray[np.float32]]  # [H, W] world units, 0 where there is none
    gains: list[NDArray[np.float32]]  # [H, W] weight of each pixel, 0 where it is not used
    median: float  # of all depths, world units

    @property
    def near(self) -> float:
        """Least depth of a surface, world units."""
        return NEAREST * self.median


def render_depth_maps(
    splats: Splats, views: Sequence[TrainView], backend: str,
    on_view: Callable[[], None] = lambda: None,
) -> DepthMaps:
    """Renders the median depth of every view, weighted by angle and distance.

    Of pixels that a mask hides nothing is used. At least one view is needed.
    """
    depths, gains = [], []
    for view in views:
        surface = render_surface(splats, view.camera, backend=backend)
        depth = surface.depth.cpu().numpy().astype(np.float32)
        cosine = surface.cosine.cpu().numpy()
        used = (depth > 0) & (cosine > LEAST_COSINE)
        if view.mask is not None:
            used &= view.mask
        depths.append(np.where(used, depth, 0).astype(np.float32))
        gains.append(np.where(used, cosine, 0).astype(np.float32))
        on_view()
    return weigh(views, [view.camera for view in views], depths, gains)


def weigh(
    views: Sequence[TrainView], cameras: Sequence[Camera], depths: list[NDArray[np.float32]],
    cosines: list[NDArray[np.float32]],
) -> DepthMaps:
    """Returns depth maps whose weights are cosines [H, W] over squared depths, 0 where too near."""
    some = np.concatenate([depth[::4, ::4][depth[::4, ::4] > 0] for depth in depths])
    median = float(np.median(some)) if len(some) else 0.0
    least = NEAREST * median
    gains = [np.where(depth > least, cosine / np.maximum(depth / max(median, 1e-30), 0.1) ** 2, 0)
             .astype(np.float32) for depth, cosine in zip(depths, cosines, strict=True)]
    return DepthMaps(views, cameras, depths, gains, median)


def weigh_by_agreement(maps: DepthMaps) -> None:
    """Multiplies the weights by the squared share of views that agree, of those that see as far.

    A pixel that no neighbour agrees with counts for nothing: it is a floater, or between layers.
    """
    if len(maps.cameras) < 2:
        return
    flat = np.concatenate([depth.reshape(-1) for depth in maps.depths])
    starts = np.concatenate([[0], np.cumsum([depth.size for depth in maps.depths])])[:-1]
    table = np.stack([camera_row(camera) for camera in maps.cameras])
    neighbours = find_neighbours(maps.cameras, maps.median)
    for own, (gain, others) in enumerate(zip(maps.gains, neighbours, strict=True)):
        agree, through = np.zeros((2, gain.size), np.int32)
        pool.run(compare, flat, starts, table, own, others, TOLERANCE, maps.near, agree, through,
                 scratch=False)
        share = agree / np.maximum(agree + through, 1)
        gain *= (share * share).reshape(gain.shape).astype(np.float32)


def find_neighbours(cameras: Sequence[Camera], median: float) -> list[NDArray[np.int64]]:
    """Returns the views that look where each one looks from near it, evenly spread, [K] each."""
    centers = np.stack([camera.center for camera in cameras])
    forward = np.stack([camera.viewmat[2, :3] for camera in cameras])
    rows = []
    for own in range(len(cameras)):
        cosines = forward @ forward[own]
        apart = np.linalg.norm(centers - centers[own], axis=1)
        apart = apart + _TURN * median * (1 - cosines)
        apart[(cosines < _LEAST_TURN) | (np.arange(len(cameras)) == own)] = np.inf
        nearest = np.argsort(apart, kind="stable")[:3 * _NEIGHBOURS]
        nearest = nearest[np.isfinite(apart[nearest])]
        rows.append(nearest[::max(1, len(nearest) // _NEIGHBOURS)][:_NEIGHBOURS])
    return rows
