"""The texture of a mesh: its charts, and their colours from the photos.

A texel is painted by the sharpest and most frontal of the photos that show it. Gains of the photos
are evened out first, and weights fade towards the border of what a photo shows, so that charts and
photos meet without seams. Where no photo shows a triangle, it keeps the colours of its corners.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.io.mesh_data import Mesh, Texture
from recon_cli.kernels.thread_pool import pool
from recon_cli.progress import Progress
from recon_cli.room.charts import GRAZING, Charts, make_charts
from recon_cli.room.mesh_planes import vertex_normals
from recon_cli.room.texture_kernels import COLUMNS, GAIN, WEIGHT, bake, draw, shade
from recon_cli.scene.camera import Camera
from recon_cli.scene.statistics import LEAST_SHARED, REFIT_ROUNDS, UNCLIPPED
from recon_cli.scene.train_view import TrainView
from recon_cli.stereo.depths import EDGE, camera_row

_SHARPER = 4.0  # exponent of how sharp a view is, in its weight
_CORRECTIONS = 2  # by what the texture misses of the photos
STEPS = 1 + _CORRECTIONS  # of each view
_OFFSET, _STEP = 128, 2.0  # of bytes that say what is missed: no error, and levels of a step
_SMALLEST = 256  # texels, of the last half
MOST_PIXELS = 50_000_000  # of all photos; 11 bytes of each are in memory
TOLERANCE = 0.025  # of a depth, within which a view shows a texel or vertex
_FEATHER = 6  # pixels within which a view fades towards what hides a surface
_SAMPLES = 6000  # vertices by which photos are compared


@dataclass(frozen=True, eq=False)
class Drawn:
    """A mesh as one view shows it."""

    nearness: NDArray[np.float32]  # [H, W] 1 / depth, 0 where there is nothing
    owners: NDArray[np.int32]  # [H, W] triangle, -1 where there is none


def draw_mesh(camera: Camera, vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> Drawn:
    """Returns which triangle each pixel shows, and how near it is."""
    nearness = np.zeros((camera.height, camera.width), np.float32)
    owners = np.full(nearness.shape, -1, np.int32)
    pixels, depths = camera.project(vertices)
    places = np.column_stack([pixels, 1 / np.where(depths > 0, depths, np.inf)])
    pool.run(draw, places, faces, nearness, owners, scratch=False)
    return Drawn(nearness, owners)


def add_texture(
    mesh: Mesh, views: Sequence[TrainView], size: int, kind: str, progress: Progress
) -> Mesh:
    """Returns a mesh with a texture of `size` x `size` texels, an image of a `kind` in files.

    Its vertices are cut where charts end. `views` are at least one, in the world of the mesh.
    """
    charts = make_charts(mesh.vertices, mesh.faces, size)
    normals = vertex_normals(mesh.vertices, mesh.faces)
    with progress.bar("texture", STEPS * len(views), unit="view") as bar:
        image = paint(mesh.vertices, normals, mesh.colors, mesh.faces, charts, views, size,
                      bar.advance)
    marks = None if mesh.inferred is None else mesh.inferred[charts.rows]
    # vertices of inferred surface come last, as in files
    order = np.argsort(np.zeros(len(charts.rows)) if marks is None else marks, kind="stable")
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    rows = charts.rows[order]
    return Mesh(
        mesh.vertices[rows], place[charts.faces], mesh.colors[rows],
        None if marks is None else marks[order], Texture(image, charts.corners[order] / size, kind))


def paint(
    vertices: NDArray[np.float64], normals: NDArray[np.float64], colors: NDArray[np.uint8],
    faces: NDArray[np.int64], charts: Charts, views: Sequence[TrainView], size: int,
    on_step: Callable[[], None] = lambda: None,
) -> NDArray[np.uint8]:
    """Returns the texture [T, T, 3] of a mesh as `views` show it.

    Args:
        vertices: [V, 3]; normals: [V, 3] unit vectors, outwards.
        colors: [V, 3], taken where no view shows a triangle.
        faces: [F, 3] of the vertices.
        charts: of these triangles.
        views: at least one.
        size: T, texels of a side.
        on_step: called `STEPS` times for each view.

    The mean over all views is blurred by their pixels and by what the mesh misses. Twice what each
    photo shows besides it is added, as in back-projection (Irani and Peleg 1991), at half the size.
    """
    drawn = []
    for view in views:
        drawn.append(draw_mesh(view.camera, vertices, faces))
        on_step()
    table = _table(views, drawn, vertices, normals)
    starts = np.concatenate([[0], np.cumsum([one.nearness.size for one in drawn])])[:-1]
    nearness = np.concatenate([one.nearness.reshape(-1) for one in drawn])
    quality = np.concatenate([usable(one.nearness, view.mask).reshape(-1)
                              for view, one in zip(views, drawn, strict=True)])
    places, outward = vertices[charts.rows], normals[charts.rows]

    def mean(
        images: Sequence[NDArray[np.uint8]], table: NDArray[np.float64],
        unseen: NDArray[np.uint8], side: int,
    ) -> NDArray[np.uint8]:
        """Returns the texture [side, side, 3] of images of the views."""
        texture = np.zeros((side, side, 3), np.uint8)
        covered = np.zeros((side, side), np.uint8)
        pixels = np.concatenate([image.reshape(-1, 3) for image in images])
        pool.run(bake, places, outward, unseen, charts.faces, charts.corners * (side / size), table,
                 starts.astype(np.int64), pixels, nearness, quality, TOLERANCE, texture, covered)
        return fill_gaps(texture, covered > 0)

    painted = mean([view.image for view in views], table, colors[charts.rows], size)
    nothing, even = np.full((len(places), 3), _OFFSET, np.uint8), table.copy()
    even[:, GAIN:] = 1
    for _ in range(_CORRECTIONS):
        levels, missed = halve(painted), []
        for view, one, row in zip(views, drawn, table, strict=True):
            image = view.image * row[GAIN:].astype(np.float32)
            error = image - shade_mesh(row, places, charts, one, levels, image)
            missed.append(np.clip(np.rint(error / _STEP + _OFFSET), 0, 255).astype(np.uint8))
            on_step()
        half = mean(missed, even, nothing, max(1, size // 2))
        whole = cv2.resize(half, (size, size), interpolation=cv2.INTER_LINEAR)
        painted = np.asarray(cv2.addWeighted(
            painted, 1.0, whole, _STEP, -_STEP * _OFFSET), np.uint8)
    return painted


def halve(texture: NDArray[np.uint8]) -> list[NDArray[np.uint8]]:
    """Returns a texture and its halves, as viewers reduce it."""
    levels = [texture]
    while len(levels[-1]) >= 2 * _SMALLEST:
        levels.append(np.asarray(cv2.resize(
            levels[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8))
    return levels


def shade_mesh(
    row: NDArray[np.float64], places: NDArray[np.float64], charts: Charts, drawn: Drawn,
    levels: Sequence[NDArray[np.uint8]], backdrop: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Returns a view of the texture [H, W, 3]; `backdrop` where the mesh shows nothing.

    `row` is the camera as of `camera_row`, and `places` [W, 3] are the corners of the charts.
    """
    image = backdrop.astype(np.float32)
    sizes = np.array([len(level) for level in levels], np.int64)
    starts = np.concatenate([[0], np.cumsum(sizes * sizes)])[:-1].astype(np.int64)
    flat = np.concatenate([level.reshape(-1, 3) for level in levels])
    pool.run(shade, row, places, charts.faces, charts.corners, drawn.nearness, drawn.owners, flat,
             starts, sizes, image, scratch=False)
    return image


def _table(
    views: Sequence[TrainView], drawn: Sequence[Drawn], vertices: NDArray[np.float64],
    normals: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Returns the table of the views, as `bake` takes it."""
    gains, sharp = compare_views(views, drawn, vertices, normals)
    table = np.zeros((len(views), COLUMNS))
    for row, view, gain, one in zip(table, views, gains, sharp, strict=True):
        row[:WEIGHT] = camera_row(view.camera)
        row[WEIGHT], row[GAIN:] = one**_SHARPER, gain
    return table


def usable(
    nearness: NDArray[np.float32], mask: NDArray[np.bool_] | None
) -> NDArray[np.uint8]:
    """Returns how well each pixel [H, W] shows its surface, 1 to 255, and 0 where it must not.

    It falls towards the border of the image, and towards pixels in which another surface begins.
    """
    middle = nearness[1:-1, 1:-1]
    bend = np.maximum(np.abs(nearness[1:-1, :-2] + nearness[1:-1, 2:] - 2 * middle),
                      np.abs(nearness[:-2, 1:-1] + nearness[2:, 1:-1] - 2 * middle))
    calm = np.zeros(nearness.shape, np.uint8)
    calm[1:-1, 1:-1] = bend <= EDGE * middle
    if mask is not None:
        calm[~mask] = 0
    inner = cv2.distanceTransform(calm, cv2.DIST_L2, 3)
    quality = np.asarray(np.rint(1 + 254 * np.minimum(inner / _FEATHER, 1)), np.uint8)
    quality[nearness <= 0] = 0
    if mask is not None:
        quality[~mask] = 0
    return quality


def compare_views(
    views: Sequence[TrainView], drawn: Sequence[Drawn], vertices: NDArray[np.float64],
    normals: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns gains [C, 3] that make colours of views alike, and how sharp each one is [C].

    Both are medians over places of the surface of what a view shows there against what all views
    show. Gains have a geometric mean of 1: the exposure of the scene.
    """
    rows = np.unique(np.linspace(0, len(vertices) - 1, _SAMPLES).round().astype(int))
    points, outward = vertices[rows], normals[rows]
    logs = np.full((len(views), len(rows), 4), np.nan)
    for row, view, one in zip(logs, views, drawn, strict=True):
        row[:] = _measure(view, one, points, outward)
    found = _offsets(logs)
    return np.exp(-found[:, :3]), np.exp(np.clip(found[:, 3], -1, 1))


def _measure(
    view: TrainView, one: Drawn, points: NDArray[np.float64], normals: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns logarithms of colour and of local contrast [P, 4] of points; NaN where not seen."""
    rows, column, row, depth = view.camera.find_visible(points)
    ray = points[rows] - view.camera.center
    cosine = -(ray * normals[rows]).sum(1) / np.linalg.norm(ray, axis=1)
    seen = (cosine > GRAZING) & (
        np.abs(one.nearness[row, column] - 1 / depth) < TOLERANCE / depth)
    if view.mask is not None:
        seen &= view.mask[row, column]
    soft = cv2.blur(view.image, (5, 5)).astype(np.float64)
    gray = cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    fine = cv2.blur(np.abs(gray - cv2.GaussianBlur(gray, (0, 0), 1.5)), (9, 9))
    colors = soft[row, column]
    dark, bright = UNCLIPPED
    fair = seen & (colors > dark).all(1) & (colors < bright).all(1)
    values = np.concatenate([colors, fine[row, column][:, None] + 0.5], axis=1)
    logs = np.full((len(points), 4), np.nan)
    logs[rows[fair]] = np.log(np.maximum(values[fair], 1e-3))
    return logs


def _offsets(logs: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns by how much each view [C, K] lies above the others in values [C, P, K], NaN: none."""
    known = np.isfinite(logs[..., 0])
    several = known.sum(axis=0) > 1
    logs, known = logs[:, several], known[:, several]
    offsets = np.zeros((len(logs), logs.shape[2]))
    used = known.sum(axis=1) >= LEAST_SHARED
    if not used.any():
        return offsets
    for _ in range(REFIT_ROUNDS):
        shared = np.nanmedian(logs - offsets[:, None], axis=0)
        offsets[used] = np.nanmedian(logs[used] - shared, axis=1)
        offsets[used] -= offsets[used].mean(axis=0)
    return offsets


def fill_gaps(texture: NDArray[np.uint8], known: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Returns a texture whose unknown texels have colours of those around them.

    Viewers read between texels, and reduce textures: what lies between charts shows at their rims.
    Means over ever larger squares fill what smaller ones leave open. `texture` [T, T, 3] is black
    where `known` [T, T] is not set.
    """
    levels = [(texture, np.where(known, 255, 0).astype(np.uint8))]
    while not levels[-1][1].all() and len(levels[-1][1]) > 1 and levels[-1][1].any():
        image, share = levels[-1]
        half = tuple(max(1, side // 2) for side in share.shape[::-1])
        weight = cv2.resize(share, half, interpolation=cv2.INTER_AREA)
        values = cv2.resize(image, half, interpolation=cv2.INTER_AREA).astype(np.float32)
        values *= 255 / np.maximum(weight, 1).astype(np.float32)[..., None]
        levels.append((cv2.convertScaleAbs(values), np.where(weight > 0, 255, 0).astype(np.uint8)))
    while len(levels) > 1:
        coarse, _ = levels.pop()
        image, share = levels[-1]
        whole = cv2.resize(coarse, share.shape[::-1], interpolation=cv2.INTER_NEAREST)
        cv2.copyTo(image, share, whole)
        levels[-1] = (whole, share)
    return np.asarray(levels[0][0], np.uint8)
