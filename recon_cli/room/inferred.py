"""Surface that no view confirms: holes in the large planes of a room, closed where that is certain.

A blank wall gives stereo nothing to match, and its mesh has holes. A hole is closed if it lies in
a plane of the mesh and surface of this plane, or the line in which it meets another one, lies
around it on all sides. What a wall has to hide is left open, and what rays crossed: doors, windows,
niches.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_closing, binary_fill_holes, distance_transform_edt, label

from recon_cli.io.mesh_data import Mesh
from recon_cli.kernels.thread_pool import pool
from recon_cli.room.charts import plane_axes
from recon_cli.room.depth_maps import DepthMaps
from recon_cli.room.mesh_planes import BAND, face_geometry
from recon_cli.room.planes import LEAST_COSINE, Plane, find_planes
from recon_cli.room.texture import draw_mesh
from recon_cli.room.texture_kernels import draw
from recon_cli.scene.camera import Camera
from recon_cli.scene.statistics import MOST_MAPS

_NEAR = 6.0  # voxels, within which a bump is not a hole
_ACROSS = 0.2  # cosine between planes that meet, at most
_CLOSED = 2  # cells of a gap in what surrounds a hole
_REACH = 3.0  # cells, from a plane to the surface of another one that meets it
# Chosen on the room "office", checked on "living" (tests/bench/notes/scenes.md):
_AROUND = 80  # cells, within which what surrounds a hole lies in each of eight directions
_MARGIN = 40  # cells around the surface of a plane, to the lines in which it meets others
_AGREE = 0.05  # of a depth, within which a view shows the plane, not what lies behind it
_MOST_CROSSED = 0.1  # share of them and of those whose rays cross it, that may cross it
_LEAST_CELLS = 12  # of a hole
_MOST_CELLS = 4_000_000  # of the grid of a plane


@dataclass(frozen=True, eq=False)
class _Grid:
    """A plane in cells of a voxel."""

    axes: NDArray[np.float64]  # [3, 3] right, up and normal
    low: NDArray[np.float64]  # [3] its corner in these axes; the third is the height of the plane
    cell: float
    shape: tuple[int, int]  # rows, columns

    def places(self, rows: NDArray[np.int64], columns: NDArray[np.int64],
               heights: NDArray[np.float64], shift: float = 0.0) -> NDArray[np.float64]:
        """Returns the places [N, 3] of corners of cells at heights over the plane.

        With a `shift` of 1/2 they are the middles of cells.
        """
        local = np.stack([(columns + shift) * self.cell, (rows + shift) * self.cell, heights],
                         axis=1) + self.low
        return local @ self.axes

    def local(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns column, row (in cells) and height over the plane [N, 3] of points."""
        moved = points @ self.axes.T - self.low
        return np.concatenate([moved[:, :2] / self.cell, moved[:, 2:]], axis=1)


@dataclass(frozen=True, eq=False)
class _DepthView:
    """A view of the scene."""

    camera: Camera
    depth: NDArray[np.float32]  # [H, W] 0 where there is none
    nearness: NDArray[np.float32]  # [H, W] 1 / depth of the mesh, 0 where there is none


def infer_surface(mesh: Mesh, maps: DepthMaps, voxel: float) -> Mesh | None:
    """Returns the surface that closes holes in the planes of a mesh; None if there is none.

    Args:
        mesh: what views show.
        maps: the depth maps that it was made of.
        voxel: side of its voxels, world units.
    """
    centers, normals, areas = face_geometry(mesh.vertices, mesh.faces)
    planes = find_planes(centers, normals, areas, BAND * voxel)
    views = _draw_depths(maps, mesh)
    vertices, faces, count = [], [], 0
    patches = [(plane, mesh.vertices[_own_faces(plane, mesh, voxel)]) for plane in planes]
    for number, (plane, own) in enumerate(patches):
        others = [*patches[:number], *patches[number + 1:]]
        near = mesh.vertices[_near_faces(plane, mesh, _NEAR * voxel)]
        found = _close(plane, own, near, others, views, voxel) if len(own) else None
        if found is not None:
            vertices.append(found[0])
            faces.append(found[1] + count)
            count += len(found[0])
    if not count:
        return None
    return Mesh(np.concatenate(vertices), np.concatenate(faces),
                np.zeros((count, 3), np.uint8), np.ones(count, bool))


def _draw_depths(maps: DepthMaps, mesh: Mesh) -> list[_DepthView]:
    """Returns up to `MOST_MAPS` of the maps, evenly spread, and the mesh in them."""
    rows = np.unique(np.linspace(
        0, len(maps.cameras) - 1, min(len(maps.cameras), MOST_MAPS)).round().astype(int))
    return [_DepthView(maps.cameras[row], maps.depths[row], draw_mesh(
        maps.cameras[row], mesh.vertices, mesh.faces).nearness) for row in rows]


def _close(
    plane: Plane, own: NDArray[np.float64], near: NDArray[np.float64],
    others: Sequence[tuple[Plane, NDArray[np.float64]]], views: Sequence[_DepthView], voxel: float,
) -> tuple[NDArray[np.float64], NDArray[np.int64]] | None:
    """Returns vertices and triangles that close the holes of a plane; None if it has none.

    `own` and the second of each of the `others` are triangles in the planes, as corners [K, 3, 3].
    `near` are all beside this one: bumps of it, which are not holes.
    """
    grid = _grid(plane, own.reshape(-1, 3), voxel)
    if grid is None:
        return None
    heights = _heights(grid, own)
    confirmed = np.isfinite(heights)
    meets, beyond, lines = _edges(grid, plane, others)
    around = _pad_close(confirmed | meets)
    holes = (binary_fill_holes(around) | _is_surrounded(around | lines)) & ~confirmed & ~beyond
    holes &= ~np.isfinite(_heights(grid, near))
    rows, columns = np.nonzero(holes)
    if not len(rows):
        return None
    places = grid.places(rows, columns, np.zeros(len(rows)), 0.5)
    holes[rows, columns] = _is_plane(places, views)
    holes = _without_specks(_adjoining(holes, confirmed, lines | meets))
    if not holes.any():
        return None
    return _patch_mesh(grid, holes, confirmed, np.where(confirmed, heights, 0.0))


def _own_faces(plane: Plane, mesh: Mesh, voxel: float) -> NDArray[np.int64]:
    """Returns the triangles [K, 3] of the mesh in a plane."""
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.maximum(np.linalg.norm(normals, axis=1), 1e-30)
    near = np.abs(corners @ plane.normal - plane.offset).max(axis=1) < BAND * voxel
    return np.asarray(mesh.faces[near & (normals @ plane.normal > LEAST_COSINE * lengths)])


def _near_faces(plane: Plane, mesh: Mesh, reach: float) -> NDArray[np.int64]:
    """Returns the triangles [K, 3] of the mesh within `reach` of a plane, of any direction."""
    return np.asarray(mesh.faces[(np.abs(plane.heights(mesh.vertices)) < reach)[mesh.faces].all(1)])


def _grid(plane: Plane, points: NDArray[np.float64], cell: float) -> _Grid | None:
    """Returns the grid that holds points with a margin, None if it would be huge."""
    axes = plane_axes(plane.normal)
    flat = points @ axes.T
    low, high = flat.min(axis=0) - _MARGIN * cell, flat.max(axis=0) + _MARGIN * cell
    low[2] = plane.offset
    columns, rows = (int(side) for side in np.ceil((high - low)[:2] / cell))
    return _Grid(axes, low, cell, (rows, columns)) if rows * columns <= _MOST_CELLS else None


def _heights(grid: _Grid, corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the height [H, W] of triangles [K, 3, 3] over the cells, NaN where there is none."""
    local = grid.local(corners.reshape(-1, 3))
    shift = 1 - float(local[:, 2].min())  # the kernel wants numbers above 0
    local[:, 2] += shift
    top = np.zeros(grid.shape, np.float32)
    owners = np.full(grid.shape, -1, np.int32)
    pool.run(draw, local, np.arange(len(local)).reshape(-1, 3), top, owners, scratch=False)
    return np.where(owners >= 0, top - shift, np.nan)


def _edges(
    grid: _Grid, plane: Plane, others: Sequence[tuple[Plane, NDArray[np.float64]]]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]:
    """Returns the cells where surface of other planes meets this one, and those behind it.

    And the lines in which the planes meet, with or without surface.
    """
    meets, beyond, lines = np.zeros((3, *grid.shape), bool)
    shift = 0.5 * grid.cell
    row, column = np.ogrid[:grid.shape[0], :grid.shape[1]]
    corner = grid.places(np.zeros(1, int), np.zeros(1, int), np.zeros(1), 0.5)
    for other, triangles in others:
        if abs(float(other.normal @ plane.normal)) > _ACROSS:
            continue
        slope = grid.cell * (grid.axes @ other.normal)
        lines |= np.abs(other.heights(corner) + slope[0] * column + slope[1] * row) < grid.cell
        local = grid.local(triangles.mean(axis=1))
        local = local[np.abs(local[:, 2]) < _REACH * grid.cell]
        x, y = np.floor(local[:, :2]).astype(int).T
        inside = (y >= 0) & (x >= 0) & (y < grid.shape[0]) & (x < grid.shape[1])
        touched = np.zeros(grid.shape, np.uint8)
        touched[y[inside], x[inside]] = 1
        rows, columns = np.nonzero(cv2.dilate(touched, np.ones((5, 5), np.uint8)))
        behind = other.heights(grid.places(rows, columns, np.zeros(len(rows)), 0.5)) < -shift
        meets[rows, columns] = True
        beyond[rows[behind], columns[behind]] = True
    return meets, beyond, lines


def _is_surrounded(cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Returns the cells from which others lie near in each of eight directions."""
    height, width = cells.shape
    padded = np.pad(cells, _AROUND)
    found = np.ones(cells.shape, bool)
    for down, right in ((0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1)):
        hit = np.zeros(cells.shape, bool)
        for step in range(1, round(_AROUND / np.hypot(down, right)) + 1):
            top, left = _AROUND + step * down, _AROUND + step * right
            hit |= padded[top:top + height, left:left + width]
        found &= hit
    return found


def _adjoining(
    holes: NDArray[np.bool_], confirmed: NDArray[np.bool_], lines: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Returns the holes that reach surface of their plane without crossing a line.

    Of the `lines`, where others meet the plane, those at a hole or surface: alone they would be
    a ledge along a wall.
    """
    parts, _ = label((holes & ~lines) | confirmed)
    kept = holes & ~lines & np.isin(parts, np.unique(parts[confirmed]))
    at_line = cv2.dilate((kept | confirmed).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    return np.asarray(kept | (holes & lines & at_line))


def _pad_close(cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Returns cells with narrow gaps between them closed."""
    padded = np.pad(cells, _CLOSED + 1)
    closed = binary_closing(padded, iterations=_CLOSED)
    inner = slice(_CLOSED + 1, -_CLOSED - 1)
    return np.asarray(closed[inner, inner] | cells)


def _is_plane(
    places: NDArray[np.float64], views: Sequence[_DepthView]
) -> NDArray[np.bool_]:
    """Returns at which places [N] views show the plane, and next to none looks through it.

    Where one view alone shows it, none does.
    """
    agree, crossed = np.zeros((2, len(places)))
    for view in views:
        rows, column, line, z = view.camera.find_visible(places)
        seen = view.depth[line, column]
        hidden = view.nearness[line, column] > (1 + _AGREE) / z  # behind the mesh
        looks = ~hidden & (seen > 0)
        agree[rows] += looks & (np.abs(seen - z) <= _AGREE * z)
        crossed[rows] += looks & (seen > (1 + _AGREE) * z)
    return np.asarray((agree > 0) & (crossed <= _MOST_CROSSED * (agree + crossed)))


def _without_specks(holes: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Returns holes without what is narrower than two cells or smaller than `_LEAST_CELLS`."""
    smooth = cv2.medianBlur(holes.astype(np.uint8), 3)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(smooth, connectivity=4)
    large = stats[:, cv2.CC_STAT_AREA] >= _LEAST_CELLS
    large[0] = False
    return np.asarray(large[labels])


def _patch_mesh(
    grid: _Grid, holes: NDArray[np.bool_], confirmed: NDArray[np.bool_],
    heights: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Returns vertices and triangles over the cells of holes and a ring around them.

    Their height is that of the nearest surface at the rim, and falls to that of the plane.
    """
    cells = holes | (cv2.dilate(holes.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0) & confirmed
    apart, (row, column) = distance_transform_edt(~confirmed, return_indices=True)
    level = heights[row, column] / (1 + apart)
    rows, columns = np.nonzero(cells)
    corner = np.stack([np.stack([rows + dy, columns + dx], axis=1)
                       for dy, dx in ((0, 0), (0, 1), (1, 1), (1, 0))], axis=1)
    wide = grid.shape[1] + 1
    keys, numbers = np.unique(corner[..., 0] * wide + corner[..., 1], return_inverse=True)
    numbers = numbers.reshape(-1, 4)
    # a corner lies at the mean height of its cells
    sums = np.bincount(numbers.reshape(-1), level[rows, columns].repeat(4))
    counts = np.bincount(numbers.reshape(-1))
    places = grid.places(keys // wide, keys % wide, sums / counts)
    faces = np.concatenate([numbers[:, [0, 1, 2]], numbers[:, [0, 2, 3]]])
    return places, faces.astype(np.int64)
