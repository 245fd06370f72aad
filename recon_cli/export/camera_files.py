"""The cameras of an export for other trainers: COLMAP's model, and nerfstudio's transforms.json.

COLMAP gets a database beside the model, with the position of each camera and the direction of
gravity as priors: `colmap pose_prior_mapper` starts from these. nerfstudio gets depth, where the
capture came with it and the scene is in metres.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.datasets.transforms import DepthPaths, write_transforms
from recon_cli.export.source import ExportSource
from recon_cli.io.colmap import write_colmap, write_priors
from recon_cli.io.depth_maps import (
    DepthMap,
    find_visible,
    lens_camera,
    read_depth,
    read_depth_list,
)
from recon_cli.io.images import write_png
from recon_cli.io.meshes import write_point_cloud
from recon_cli.scene.camera import Camera
from recon_cli.scene.faces import pixel_rays
from recon_cli.workspace.export_formats import ExportFormat

_IMAGES, _DEPTH, _DATABASE = "images", "depth", "database.db"
_SPARSE = "sparse_pc.ply"  # as nerfstudio calls it
_MOST = int(np.iinfo(np.uint16).max)  # value of 16 bits
_UNIT = 1e-3  # of the scene, of a value of 1: millimetres, nerfstudio's default
# Standard deviation of a camera's place in a room, in metres: what bundle adjustment leaves.
_DEVIATION = 0.01


def write_cameras(out: Path, row: ExportFormat, source: ExportSource) -> None:
    """Writes the cameras in one of the formats of this kind, and copies the images."""
    cameras, scene = _copy_images(out, source), source.scene
    if row.index:  # a folder: a model of COLMAP
        shutil.rmtree(out / row.file, ignore_errors=True)  # of a run that was killed
        write_colmap(out / row.file, cameras, source.points, scene.colors)
        deviation = _DEVIATION * source.scale if source.in_metres else None
        write_priors(out / _DATABASE, cameras, deviation=deviation, up=source.known_up)
        return
    points = None
    if len(scene.points):
        points = _SPARSE
        write_point_cloud(out / points, source.points, scene.colors)
    write_transforms(
        out / row.file, [(f"{_IMAGES}/{name}", camera) for name, camera in cameras],
        held_out={f"{_IMAGES}/{view.name}" for view in scene.test}, points=points,
        depth=_write_depth(out, cameras, source))


def _copy_images(out: Path, source: ExportSource) -> list[tuple[str, Camera]]:
    """Copies the undistorted images, and returns all cameras, which are useless without."""
    scene = source.scene
    every = (*scene.train, *scene.validation, *scene.test)
    for view in every:
        target = out / _IMAGES / view.name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(view.original, target)
    return source.place(every)


def _write_depth(
    out: Path, cameras: list[tuple[str, Camera]], source: ExportSource
) -> DepthPaths | None:
    """Writes the depth of every view, at its size; None where there is none.

    nerfstudio wants depth for all images or for none, so that views without get zeros, which mean
    unknown. Those are also the held-out ones: depth would reveal what they are scored on.
    """
    shutil.rmtree(out / _DEPTH, ignore_errors=True)
    if source.capture is None or not source.in_metres:
        return None
    ingest = source.capture.ingest
    maps = read_depth_list(ingest)
    hidden = {view.name for view in source.scene.test}
    maps = {name: one for name, one in maps.items() if name not in hidden}
    if not any(name in maps for name, _ in cameras):
        return None
    (out / _DEPTH).mkdir()
    unit, paths = _UNIT * source.scale, {}
    for name, camera in cameras:
        depth = np.zeros((camera.height, camera.width))
        if name in maps:
            depth = _as_seen(ingest, name, maps[name], camera) * source.scale
        values = np.rint(depth / unit)
        write_png(out / _DEPTH / name, np.where(values > _MOST, 0, values).astype(np.uint16))
        paths[f"{_IMAGES}/{name}"] = f"{_DEPTH}/{name}"
    return DepthPaths(paths, unit)


def _as_seen(ingest: Path, name: str, one: DepthMap, camera: Camera) -> NDArray[np.float64]:
    """Returns [H, W] metres of an undistorted view, 0 where unknown or not reliable.

    A value is looked up at the nearest pixel along the ray: in between there is no surface.
    """
    depth, levels = read_depth(ingest, name, one)
    if levels is not None:
        depth[levels == 0] = 0
    if one.reliable is not None:
        depth[depth > one.reliable] = 0
    seen = np.zeros(camera.height * camera.width)
    rows, column, line = find_visible(lens_camera(one.lens), pixel_rays(camera).reshape(-1, 3))
    seen[rows] = depth[line, column]
    return seen.reshape(camera.height, camera.width)
