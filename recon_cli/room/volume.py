"""A block-sparse volume of truncated signed distances, and the surface where they cross zero.

Only blocks of 8 x 8 x 8 voxels that a surface may pass through exist (Niessner et al. 2013), so
memory grows with the surface, not with the room.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from skimage.measure import marching_cubes

from recon_cli.kernels.thread_pool import pool
from recon_cli.kernels.viewpoint import viewpoint
from recon_cli.room.depth_maps import DepthMaps
from recon_cli.room.kernels import CELLS, SIDE, integrate
from recon_cli.scene.faces import pixel_rays
from recon_cli.scene.voxels import join_places, split_numbers

BAND = 3.0  # truncation: voxels before and behind a surface
BYTES = 8 * CELLS  # of a block
_STRIDE = 3  # pixels between those that blocks are made for; they lie much closer than a block
_CHUNK = 8  # blocks along the side of a chunk for marching cubes
_PART = 2048  # parts of a voxel within which two chunks have the same vertex


@dataclass(frozen=True, eq=False)
class Volume:
    """The signed distances."""

    voxel: float  # side of a voxel, world units
    blocks: NDArray[np.int32]  # [B, 3] places in blocks, in the order of their keys
    values: NDArray[np.float32]  # [B * 512] mean distance over the band, -1 to 1
    weights: NDArray[np.float32]  # [B * 512] 0 where no view says anything


def find_blocks(maps: DepthMaps, voxel: float, farthest: float) -> NDArray[np.int32]:
    """Returns the blocks [B, 3] around all surfaces up to a depth of `farthest`."""
    band, size = BAND * voxel, SIDE * voxel
    keys = np.empty(0, np.int64)
    for camera, depth, gain in zip(maps.cameras, maps.depths, maps.gains, strict=True):
        rays = pixel_rays(camera)[::_STRIDE, ::_STRIDE]
        depth = depth[::_STRIDE, ::_STRIDE]
        used = (gain[::_STRIDE, ::_STRIDE] > 0) & (depth < farthest)
        rays, depth = rays[used] @ camera.viewmat[:3, :3], depth[used]
        places = [np.floor((camera.center + rays * (depth + shift)[:, None]) / size).astype(
            np.int64) for shift in (-band, 0.0, band)]
        keys = np.union1d(keys, np.concatenate([join_places(part) for part in places]))
    return split_numbers(keys)


def fuse(
    maps: DepthMaps, voxel: float, farthest: float, on_view: Callable[[], None] = lambda: None
) -> Volume:
    """Returns the volume of all views."""
    blocks = find_blocks(maps, voxel, farthest)
    values = np.ones(len(blocks) * CELLS, np.float32)
    weights = np.zeros_like(values)
    for camera, depth, gain in zip(maps.cameras, maps.depths, maps.gains, strict=True):
        pool.run(
            integrate, blocks, values, weights, depth.reshape(-1), gain.reshape(-1),
            viewpoint(camera), float(voxel), float(BAND * voxel), float(maps.near), scratch=False)
        on_view()
    return Volume(voxel, blocks, values, weights)


def extract(volume: Volume) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Returns vertices [V, 3] and triangles [F, 3], counter-clockwise from outside.

    There is a surface only between voxels that views say something about: its rims stay open.
    """
    keys = join_places(volume.blocks)
    chunks = np.unique(join_places(np.floor_divide(volume.blocks, _CHUNK)))
    vertices: list[NDArray[np.int64]] = [np.empty((0, 3), np.int64)]
    faces: list[NDArray[np.int64]] = [np.empty((0, 3), np.int64)]
    count = 0
    for corner in split_numbers(chunks).astype(np.int64) * _CHUNK:
        values, known = _gather(volume, keys, corner)
        # skimage looks for a cube's mask at its far corner
        cubes = np.zeros(values.shape, bool)
        cubes[1:, 1:, 1:] = _all_corners(known)
        inside = values[known]
        if not cubes.any() or not inside.size or inside.min() >= 0 or inside.max() < 0:
            continue
        try:
            points, triangles, _, _ = marching_cubes(
                values, 0.0, mask=cubes, allow_degenerate=False)
        except (ValueError, RuntimeError):  # no cube that is known holds a surface
            continue
        vertices.append(np.rint(points.astype(np.float64) * _PART).astype(np.int64)
                        + corner * SIDE * _PART)
        faces.append(triangles.astype(np.int64) + count)
        count += len(points)
    places, rows = np.unique(np.concatenate(vertices), axis=0, return_inverse=True)
    triangles = rows.reshape(-1)[np.concatenate(faces)]
    proper = ((triangles[:, 0] != triangles[:, 1]) & (triangles[:, 1] != triangles[:, 2])
             & (triangles[:, 2] != triangles[:, 0]))
    return (places / _PART + 0.5) * volume.voxel, triangles[proper]


def _gather(
    volume: Volume, keys: NDArray[np.int64], corner: NDArray[np.int64]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Returns values and which are known of a chunk with one more voxel on its far sides."""
    size = _CHUNK + 1
    grid = np.stack(np.meshgrid(*[np.arange(size)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    wanted = join_places(grid + corner)
    rows = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    there = keys[rows] == wanted
    values = np.ones((len(grid), CELLS), np.float32)
    known = np.zeros((len(grid), CELLS), bool)
    values[there] = volume.values.reshape(-1, CELLS)[rows[there]]
    known[there] = volume.weights.reshape(-1, CELLS)[rows[there]] > 0
    cut = slice(_CHUNK * SIDE + 1)
    return tuple(  # type: ignore[return-value]
        part.reshape(size, size, size, SIDE, SIDE, SIDE).transpose(0, 3, 1, 4, 2, 5).reshape(
            (size * SIDE,) * 3)[cut, cut, cut] for part in (values, known))


def _all_corners(known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    pairs = known[:-1] & known[1:]
    pairs = pairs[:, :-1] & pairs[:, 1:]
    return np.asarray(pairs[:, :, :-1] & pairs[:, :, 1:])
