"""Charts: a mesh cut into pieces that lie flat, and the place of each piece in a texture.

Indoor surfaces face few directions, so a piece is what connects and faces one of them, seen along
it; xatlas packs the pieces. (Its own charts of 300,000 noisy triangles take minutes.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xatlas
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components

from recon_cli.kernels.thread_pool import pool
from recon_cli.room.kernels import LEAST_COSINE
from recon_cli.room.texture_kernels import draw

_PADDING = 2  # texels between charts
_SMOOTHED = 6  # rings of triangles that the direction of one is a mean over
_STEPS = 8  # of k-means over the directions
GRAZING = 0.3  # cosine between the normal of a surface and the direction that it is seen along
_TINY = 40  # triangles; smaller pieces join their neighbours, if they face the same way at all
_MERGED = 4  # times that this is tried
_LAYERS = 4  # that lie over each other in one piece, at most
_CELLS = 2.0  # cells along the edge of a mean triangle, for finding them
_APART = 1.5  # mean edges, from which on a triangle lies under another one


@dataclass(frozen=True, eq=False)
class Charts:
    """A mesh whose charts lie in a texture."""

    rows: NDArray[np.int64]  # [W] vertices of the mesh; those on the rim of a chart come again
    faces: NDArray[np.int64]  # [F, 3] of these rows, in the order of the mesh
    corners: NDArray[np.float64]  # [W, 2] column and row in the texture, in texels
    count: int


def make_charts(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], size: int
) -> Charts:
    """Returns the charts of a mesh in a texture of `size` x `size` texels."""
    normals = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]],
                       vertices[faces[:, 2]] - vertices[faces[:, 0]])
    links = _neighbours(faces, len(vertices))
    labels, directions = _label(normals, links)
    pieces = _connect(labels, links)
    axes = np.stack([plane_axes(direction) for direction in directions])
    pieces = _split_layers(vertices, faces, pieces, axes[labels])
    keys = pieces[:, None] * len(vertices) + faces
    keys, corners = np.unique(keys, return_inverse=True)
    corners = corners.reshape(faces.shape).astype(np.int64)
    rows = keys % len(vertices)
    owner = np.zeros(len(rows), np.int64)
    owner[corners] = labels[:, None]
    flat = np.einsum("wij,wj->wi", axes[owner, :2], vertices[rows])
    return _pack(rows, corners, flat, pieces, size)


def _neighbours(faces: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Returns pairs of triangles [E, 2] that share an edge."""
    edges = np.sort(np.concatenate([faces[:, :2], faces[:, 1:], faces[:, ::2]]), axis=1)
    keys = edges[:, 0] * count + edges[:, 1]
    order = np.argsort(keys, kind="stable")
    same = keys[order][1:] == keys[order][:-1]
    return np.stack([order[:-1][same], order[1:][same]], axis=1) % len(faces)


def _graph(links: NDArray[np.int64], count: int) -> csr_matrix:
    ones = np.ones(len(links), np.float32)
    half = coo_matrix((ones, links.T), shape=(count, count))
    return (half + half.T).tocsr()


def _label(
    normals: NDArray[np.float64], links: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Returns the direction [F] that each triangle is seen along, and the directions [6, 3].

    `normals` [F, 3] are as long as the triangles are large.
    """
    graph = _graph(links, len(normals))
    smooth = normals
    for _ in range(_SMOOTHED):
        smooth = smooth + graph @ smooth
    smooth = _unit(smooth)
    areas, unit = np.linalg.norm(normals, axis=1), _unit(normals)
    directions = np.concatenate([np.eye(3), -np.eye(3)])
    for _ in range(_STEPS):
        labels = (smooth @ directions.T).argmax(axis=1)
        sums = np.stack([smooth.T @ (areas * (labels == row)) for row in range(len(directions))])
        directions = np.where((sums != 0).any(axis=1, keepdims=True), _unit(sums), directions)
    labels = (smooth @ directions.T).argmax(axis=1)
    cosines = unit @ directions.T
    away = cosines[np.arange(len(labels)), labels] < GRAZING
    labels[away] = cosines[away].argmax(axis=1)
    for _ in range(_MERGED):
        pieces = _connect(labels, links)
        tiny = np.bincount(pieces)[pieces] < _TINY
        votes = np.stack([graph @ (labels == row) for row in range(len(directions))], axis=1)
        votes[cosines < LEAST_COSINE] = 0
        best = votes.argmax(axis=1)
        moved = tiny & (votes[np.arange(len(best)), best] > 0)
        labels[moved] = best[moved]
    return labels, directions


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(
        vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-30))


def _connect(labels: NDArray[np.int64], links: NDArray[np.int64]) -> NDArray[np.int64]:
    """Returns the number of the connected piece of equal labels that each triangle belongs to."""
    alike = links[labels[links[:, 0]] == labels[links[:, 1]]]
    graph = coo_matrix((np.ones(len(alike), np.int8), alike.T), shape=(len(labels),) * 2)
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)


def plane_axes(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns two axes across a direction and the direction, right-handed, [3, 3]."""
    first = np.eye(3)[np.argmin(np.abs(direction))]
    first = first - (first @ direction) * direction
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(direction, first), direction])


def _split_layers(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], pieces: NDArray[np.int64],
    axes: NDArray[np.float64],  # [F, 3, 3] of each triangle
) -> NDArray[np.int64]:
    """Returns pieces [F] of which none covers itself: what lies under another part is cut off."""
    edge = float(np.median(np.linalg.norm(
        vertices[faces[:, 1]] - vertices[faces[:, 0]], axis=1)))
    pieces = pieces.copy()
    left = np.unique(pieces)
    for _ in range(_LAYERS - 1):
        order = np.argsort(pieces, kind="stable")
        starts = np.searchsorted(pieces[order], left)
        ends = np.searchsorted(pieces[order], left, side="right")
        added, count = [], int(pieces.max()) + 1
        for first, last in zip(starts, ends, strict=True):
            rows = order[first:last]
            if len(rows) < 3:
                continue
            hidden = rows[_covered(vertices[faces[rows]] @ axes[rows[0]].T, edge)]
            if len(hidden):
                pieces[hidden] = count
                added.append(count)
                count += 1
        if not added:
            break
        left = np.array(added)
    return pieces


def _covered(corners: NDArray[np.float64], edge: float) -> NDArray[np.bool_]:
    """Returns which triangles [F] lie under others; `corners` [F, 3, 3] are in axes of the view."""
    cell = edge / _CELLS
    low = corners.min(axis=(0, 1)) - cell
    places = (corners - low) / cell
    width, height, _ = (int(side) + 2 for side in places.max(axis=(0, 1)))
    nearness, owners = np.zeros((height, width), np.float32), np.full((height, width), -1, np.int32)
    own = np.arange(3 * len(corners)).reshape(-1, 3)
    pool.run(draw, places.reshape(-1, 3), own, nearness, owners, scratch=False)
    middle = places.mean(axis=1)
    column, row = np.floor(middle[:, :2]).astype(int).T
    return np.asarray(nearness[row, column] > middle[:, 2] + _APART * _CELLS)


def _pack(
    rows: NDArray[np.int64], faces: NDArray[np.int64], flat: NDArray[np.float64],
    pieces: NDArray[np.int64], size: int,
) -> Charts:
    """Returns charts packed into a square; `flat` [W, 2] are their corners in world units."""
    atlas = xatlas.Atlas()
    atlas.add_uv_mesh(
        flat.astype(np.float32), faces.astype(np.uint32), pieces.astype(np.uint32)[:, None])
    packing = xatlas.PackOptions()
    packing.padding, packing.resolution = _PADDING, size
    atlas.generate(xatlas.ChartOptions(), packing)
    again, triangles, places = atlas.get_mesh(0)
    scale = size / max(atlas.width, atlas.height) * np.array([atlas.width, atlas.height])
    return Charts(rows[again.astype(np.int64)], triangles.astype(np.int64), places * scale,
                  atlas.chart_count)
