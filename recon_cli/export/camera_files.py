"""Cameras and images of the capture for other trainers, in the world of the exported files."""

from __future__ import annotations

import shutil
from pathlib import Path

from recon_cli.datasets.transforms import write_transforms
from recon_cli.export.source import ExportSource
from recon_cli.io.colmap import write_colmap
from recon_cli.io.meshes import write_point_cloud
from recon_cli.scene.camera import Camera
from recon_cli.workspace.export_formats import ExportFormat

_IMAGES = "images"
_SPARSE = "sparse_pc.ply"  # as nerfstudio calls it


def write_cameras(out: Path, row: ExportFormat, source: ExportSource) -> None:
    """Writes the cameras in one of the formats of this kind, and copies the images."""
    cameras, scene = _copy_images(out, source), source.scene
    if row.index:  # a folder: a model of COLMAP
        shutil.rmtree(out / row.file, ignore_errors=True)  # of a run that was killed
        write_colmap(out / row.file, cameras, source.points, scene.colors)
        return
    points = None
    if len(scene.points):
        points = _SPARSE
        write_point_cloud(out / points, source.points, scene.colors)
    write_transforms(
        out / row.file, [(f"{_IMAGES}/{name}", camera) for name, camera in cameras],
        held_out={f"{_IMAGES}/{view.name}" for view in scene.test}, points=points)


def _copy_images(out: Path, source: ExportSource) -> list[tuple[str, Camera]]:
    """Copies the undistorted images, and returns all cameras, which are useless without."""
    scene = source.scene
    every = (*scene.train, *scene.validation, *scene.test)
    for view in every:
        target = out / _IMAGES / view.name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(view.original, target)
    return source.place(every)
