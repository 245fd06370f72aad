"""The large planes of a mesh, of which a room is measured: walls, floor and ceiling."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recon_cli.room.depth_maps import DepthMaps
from recon_cli.room.planes import Plane, confirm_all, find_planes
from recon_cli.room.volume import extract, fuse

BAND = 2.0  # voxels, within which surface belongs to a plane, and a side of those it is fused in


def surface_planes(
    maps: DepthMaps, voxel: float, farthest: float, points: NDArray[np.float64]
) -> list[tuple[Plane, Plane | None]]:
    """Returns the large planes of the surface, each also as triangulated points confirm it."""
    band = BAND * voxel
    vertices, faces = extract(fuse(maps, band, farthest))
    centers, normals, areas = face_geometry(vertices, faces)
    planes = find_planes(centers, normals, areas, band)
    return list(zip(planes, confirm_all(planes, centers, points, band), strict=True))


def face_geometry(
    vertices: NDArray[np.float64], faces: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Returns centres [F, 3], unit normals [F, 3] and areas [F] of the triangles that have one."""
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    there = lengths > 0
    return (corners[there].mean(axis=1), normals[there] / lengths[there, None], lengths[there] / 2)


def vertex_normals(
    vertices: NDArray[np.float64], faces: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Returns unit normals [V, 3], means of those of the triangles weighted by area."""
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    rows = faces.reshape(-1)
    sums = np.stack([np.bincount(rows, np.repeat(normals[:, axis], 3), len(vertices))
                     for axis in range(3)], axis=1)
    return np.asarray(sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-30))
