"""From a request and a scene to the cameras of all frames, before anything is rendered."""

from __future__ import annotations

import difflib
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from recon_cli.errors import ConfigError, StageError
from recon_cli.export.synthetic_cameras import AROUND
from recon_cli.flythrough.camera_path import CameraPath, read_camera_path
from recon_cli.flythrough.images import frame_size
from recon_cli.flythrough.request import FPS, ORBIT, TRAINING, Request
from recon_cli.flythrough.smooth import middle_of_sight, orbit_path, smooth_path
from recon_cli.flythrough.source import Source
from recon_cli.io.images import fitted_camera, fitted_size
from recon_cli.scene.camera import Camera
from recon_cli.scene.scene import Scene, View


@dataclass(frozen=True, eq=False)
class Plan:
    """All frames.

    Attributes:
        name: of what is shown, for the folder.
        cameras: one a frame, by the stem of its files, in order.
        path: the same cameras as a path with its pace; None for single views.
    """

    name: str
    cameras: dict[str, Camera]
    path: CameraPath | None


def plan(request: Request, source: Source) -> Plan:
    """Returns the cameras that are asked for.

    Raises:
        StageError: views are asked for, and there are none.
        ConfigError: a size or a view's name cannot be used.
        FormatError: the file of a path cannot be used.
    """
    if not source.has_views and request.file is None:
        _refuse_without_views(request)
    if request.views:
        views = _views(request.views, source.scene)
        cameras = {
            Path(view.name).stem: _view_camera(view.camera, request, source) for view in views}
        name = request.views[0] if len(request.views) == 1 else "chosen"
        return Plan(f"views_{Path(name).stem}", cameras, None)
    if request.file is not None:
        path, name = read_camera_path(request.file), f"path_{request.file.stem}"
    else:
        path, name = _made_path(request, source), request.path
    width, height = frame_size(path.width, path.height, request)
    path = replace(path, width=width, height=height, fps=request.fps or path.fps or FPS)
    return Plan(name, {f"{at:05d}": camera for at, camera in enumerate(path.cameras())}, path)


def _refuse_without_views(request: Request) -> None:
    """Raises StageError where cameras of views are asked for, and there are none."""
    if request.views or request.path == TRAINING:
        raise StageError(
            "The scene was imported without views, so there are no cameras of its own to render.",
            hint=f"Give --path {ORBIT}, or --path FILE.json with cameras.")


def _made_path(request: Request, source: Source) -> CameraPath:
    """Returns the path through or around the training cameras, as they see and at their size."""
    scene, count = source.scene, request.frames()
    cameras = [view.camera for view in scene.train]
    if not source.has_views:  # the others stand in the middle
        cameras = cameras[:AROUND]
    viewmats = np.stack([camera.viewmat for camera in cameras])
    if request.path == TRAINING:
        viewmats = smooth_path(viewmats, count)
    else:
        centers = np.stack([camera.center for camera in cameras])
        viewmats = orbit_path(
            centers, middle_of_sight(cameras, scene.points), source.up(), count)
    like = _usual(cameras)
    fov = np.degrees(2 * np.arctan(like.height / 2 / like.fy))
    width, height = fitted_size(like.width, like.height, source.max_size)
    return CameraPath(viewmats, np.full(count, fov), width, height)


def _usual(cameras: Sequence[Camera]) -> Camera:
    """Returns the first camera of the shape and focal length that most have."""
    kinds = [(camera.width, camera.height, camera.fy) for camera in cameras]
    return cameras[kinds.index(Counter(kinds).most_common(1)[0][0])]


def _view_camera(camera: Camera, request: Request, source: Source) -> Camera:
    """Returns the camera of a view at the size asked for, or at that of training and scores."""
    if request.size or request.width or request.height:
        return camera.resized(*frame_size(camera.width, camera.height, request))
    return fitted_camera(camera, source.max_size)


def _views(names: Sequence[str], scene: Scene) -> list[View]:
    """Returns the views of some names or of whole parts, each once, in the order of names."""
    parts = {"train": scene.train, "validation": scene.validation, "test": scene.test}
    known = {view.name: view for part in parts.values() for view in part}
    chosen: dict[str, View] = {}
    for name in names:
        found = parts.get(name) or tuple(
            view for view in known.values() if name in (view.name, Path(view.name).stem))
        if not found:
            raise _unknown(name, parts, known, scene.unregistered_test)
        chosen.update({view.name: view for view in found})
    return [chosen[name] for name in sorted(chosen)]


def _unknown(
    name: str, parts: Collection[str], known: Collection[str], unregistered: Collection[str]
) -> ConfigError:
    if name in parts:
        return ConfigError(f"This capture has no {name} views.", hint="Name others with --views.")
    if name in unregistered:
        return ConfigError(f"The frame {name} got no camera, so it has no view to render.")
    close = difflib.get_close_matches(name, known, n=1)
    return ConfigError(
        f"There is no view {name!r} among the {len(known)} of this capture.",
        hint=f"Did you mean {close[0]}?" if close else (
            f"Give {', '.join(parts)}, or the name of a frame such as {min(known)}."))
