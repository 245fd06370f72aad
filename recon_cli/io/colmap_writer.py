"""COLMAP models of undistorted views, binary or as text, written by pycolmap."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from recon_cli.errors import InputError
from recon_cli.scene.camera import Camera


def write_colmap(
    folder: Path,
    views: Sequence[tuple[str, Camera]],
    points: NDArray[np.float64],  # [P, 3]
    colors: NDArray[np.uint8],  # [P, 3]
    *,
    text: bool = False,
) -> None:
    """Writes a model of pinhole cameras, whole or not at all.

    Views with the same intrinsics share a camera. Nothing says which view sees which point.

    Args:
        folder: of the model, such as sparse/0; it may not exist yet, or has to be empty.
        views: name of each image below the images' folder, and its camera.
        points: in world units.
        colors: RGB.
        text: write cameras.txt and so on in place of the binary files.

    Raises:
        InputError: there are no views, or the folder holds something.
    """
    if not views:
        raise InputError("There are no cameras to write.", hint="Run `recon sfm` first.")
    if folder.exists() and any(folder.iterdir()):
        raise InputError(f"{folder} is not empty.", hint="Name another folder, or remove it.")
    model = _model(views)
    for point, color in zip(points, colors, strict=True):
        model.add_point3D(point, pycolmap.Track(), color)
    partial = folder.with_name(f".{folder.name}.tmp{os.getpid()}")
    partial.mkdir(parents=True)
    try:
        (model.write_text if text else model.write_binary)(partial)
        if folder.exists():
            folder.rmdir()
        partial.rename(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _model(views: Sequence[tuple[str, Camera]]) -> pycolmap.Reconstruction:
    model, ids = pycolmap.Reconstruction(), dict[tuple[float, ...], int]()
    for number, (name, camera) in enumerate(views, start=1):
        inner = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        if inner not in ids:
            ids[inner] = len(ids) + 1
            model.add_camera_with_trivial_rig(pycolmap.Camera(
                camera_id=ids[inner], model="PINHOLE", width=camera.width, height=camera.height,
                params=inner[2:]))
        model.add_image_with_trivial_frame(
            pycolmap.Image(image_id=number, name=name, camera_id=ids[inner]),
            pycolmap.Rigid3d(camera.viewmat[:3]))
    return model
