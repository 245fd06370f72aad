"""transforms.json as nerfstudio and instant-ngp read it: cameras of undistorted images.

The counterpart of `recon_cli.io.transforms`: poses are camera to world with OpenGL axes (x right,
y up, looking along -z), the world is the scene's own, and intrinsics are in pixels with the centre
of the first one at 0.5.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from recon_cli.errors import InputError
from recon_cli.scene.camera import Camera
from recon_cli.workspace.atomic import write_json

_OPENGL = np.diag([1.0, -1, -1, 1])  # from OpenGL's camera axes to OpenCV's


def write_transforms(
    path: Path,
    views: Sequence[tuple[str, Camera]],
    *,
    held_out: Collection[str] = (),
    points: str | None = None,
) -> None:
    """Writes the cameras of images, whole or not at all.

    What all cameras share is said once. With held-out images the lists train_filenames,
    val_filenames and test_filenames are written; the last two are those images, because nerfstudio
    asks for both.

    Args:
        path: of the transforms.json.
        views: path of each image below the folder of `path`, with slashes, and its camera.
        held_out: those of the image paths that are not to be trained on.
        points: path of a .ply of sparse points below that folder; None where there is none.

    Raises:
        InputError: there are no views.
        ValueError: a path leaves the folder, is there twice, or is held out but no view.
    """
    if not views:
        raise InputError("There are no cameras to write.", hint="Run `recon sfm` first.")
    names = [name for name, _ in views]
    for name in (*names, *([points] if points else ())):
        if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
            raise ValueError(f"{name} is no path below the folder of {path}")
    if len(set(names)) < len(names) or not set(held_out) <= set(names):
        raise ValueError("views that are there twice, or held-out ones that are not there")
    inner = [_intrinsics(camera) for _, camera in views]
    alike = all(one == inner[0] for one in inner)
    value: dict[str, Any] = {"camera_model": "PINHOLE", **(inner[0] if alike else {})}
    if points:
        value["ply_file_path"] = points
    if held_out:
        test = [name for name in names if name in held_out]
        value |= {"train_filenames": [name for name in names if name not in held_out],
                  "val_filenames": test, "test_filenames": test}
    value["frames"] = [
        {"file_path": name, **({} if alike else one), "transform_matrix": _pose(camera)}
        for (name, camera), one in zip(views, inner, strict=True)]
    write_json(path, value)


def _intrinsics(camera: Camera) -> dict[str, float]:
    return {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy,
            "w": camera.width, "h": camera.height}


def _pose(camera: Camera) -> list[list[float]]:
    """Returns camera to world with OpenGL axes, [4, 4]."""
    pose = np.eye(4)
    pose[:3, :3] = camera.viewmat[:3, :3].T
    pose[:3, 3] = camera.center
    rows: list[list[float]] = (pose @ _OPENGL).tolist()
    return rows
