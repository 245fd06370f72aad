"""Points from a sensor's depth where the matches give none, as on a bare wall.

They have no track: no image says that it sees them. Training starts Gaussians at them, as at the
others. Depth that is far or not sure is left out, and so is what a single frame shows.
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.io.colmap_library import pycolmap
from recon_cli.io.depth_maps import (
    DepthMap,
    find_edges,
    find_visible,
    lens_camera,
    read_depth_list,
    read_sure_depth,
)
from recon_cli.io.images import read_png
from recon_cli.scene.statistics import LEAST_WITNESSES, MOST_MAPS
from recon_cli.scene.voxels import SURFACE_CELL, number_cells
from recon_cli.sfm.model_arrays import registered_images

SAMPLES = 8000  # of each map


def add_depth_points(
    model: pycolmap.Reconstruction, ingest: Path, frames: Path, metres: float, *,
    without: Collection[str] = (),
) -> int:
    """Adds points to a model, in place, by the depth maps of ingest; returns how many.

    `metres` is the length of a unit of the model, `without` the names of frames that are held out.
    FormatError if a map or frame is damaged.
    """
    maps = {name: one for name, one in read_depth_list(ingest).items() if name not in without}
    images = {image.name: image for image in registered_images(model)}
    names = sorted(set(maps) & set(images))
    count = min(len(names), MOST_MAPS)
    clouds = [
        _unproject(images[name], frames, ingest, maps[name], metres)
        for name in (names[int((at + 0.5) * len(names) / count)] for at in range(count))]
    if not clouds or not sum(len(points) for points, _, _ in clouds):
        return 0
    points, colors, depths = (np.concatenate(part) for part in zip(*clouds, strict=True))
    owner = np.repeat(np.arange(len(clouds)), [len(part[0]) for part in clouds])
    side = SURFACE_CELL * float(np.median(depths))
    known = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    rows = _choose(points, owner, side, known, agree=min(LEAST_WITNESSES, len(clouds)))
    for row in rows:
        model.add_point3D(points[row], pycolmap.Track(), colors[row])
    return len(rows)


def _unproject(
    image: pycolmap.Image, frames: Path, ingest: Path, one: DepthMap, metres: float
) -> tuple[NDArray[np.float64], NDArray[np.uint8], NDArray[np.float64]]:
    """Returns points [P, 3] of a depth map in the model's world, colours [P, 3] and depths [P]."""
    depth = read_sure_depth(ingest, image.name, one)
    depth[find_edges(depth)] = 0
    step = max(1, round((depth.size / SAMPLES) ** 0.5))
    rows, columns = np.nonzero(depth[step // 2::step, step // 2::step])
    rows, columns = rows * step + step // 2, columns * step + step // 2
    z = depth[rows, columns].astype(np.float64) / metres
    rays = np.asarray(lens_camera(one.lens).cam_from_img(np.column_stack([columns, rows]) + 0.5))
    local = np.column_stack([rays.reshape(-1, 2) * z[:, None], z])
    rgb = read_png(frames / image.name)
    seen, column, line = find_visible(image.camera, local)
    world = np.asarray(image.cam_from_world().inverse() * local[seen])
    return world.reshape(-1, 3), rgb[line, column], z[seen]


def _choose(
    points: NDArray[np.float64], owner: NDArray[np.int64], side: float,
    known: NDArray[np.float64], *, agree: int,
) -> NDArray[np.intp]:
    """Returns the rows of one point for each cell that enough maps show and no known point."""
    cells = number_cells(points, side)
    pairs = np.unique(np.column_stack([cells, owner]), axis=0)
    shown, maps = np.unique(pairs[:, 0], return_counts=True)
    good = shown[maps >= agree]
    good = good[~np.isin(good, number_cells(known, side))]
    first, rows = np.unique(cells, return_index=True)
    return np.sort(rows[np.isin(first, good)])
