"""Plans the cameras of all frames from a request and a trained scene, before rendering starts."""

from __future__ import annotations

import difflib
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from recon_cli.errors import ConfigError, StageError
from recon_cli.export.synthetic_cameras import CAMERAS_AROUND
from recon_cli.flythrough.camera_path import CameraPath, read_camera_path
from recon_cli.flythrough.panorama import WIDTH, panorama_camera
from recon_cli.flythrough.request import (
    FPS,
    ORBIT,
    TOUR,
    TOUR_SIZE,
    TRAINING,
    RenderRequest,
)
from recon_cli.flythrough.trained_scene import TrainedScene
from recon_cli.io.images import fit_camera, fit_size
from recon_cli.machine import free_memory_bytes
from recon_cli.scene.camera import MAX_SIDE, Camera
from recon_cli.scene.camera_paths import find_look_at, orbit_path, smooth_path, tour_path
from recon_cli.scene.scene import Scene, View, views_ahead

# Of a frame with all outputs, from 1200x680 to 3000x1700 pixels: 55 with numba, 93 with torch.
_BYTES_PER_PIXEL = 100


@dataclass(frozen=True, eq=False)
class CameraPlan:
    """The cameras of all frames."""

    name: str  # of the path or views, for the folder
    cameras: dict[str, Camera]  # by the stem of the frame's files, in order
    path: CameraPath | None  # the same cameras with their fps; None for single views


def plan_cameras(request: RenderRequest, trained: TrainedScene) -> CameraPlan:
    """Returns the requested cameras; those of panoramas are level, and stand where they do.

    StageError if views are requested and there are none, ConfigError for a size or name that cannot
    be used, FormatError for the file of a path.
    """
    if not trained.has_views and (request.views or request.path in (TRAINING, TOUR)):
        raise StageError(
            "The scene was imported without views, so there are no cameras of its own to render.",
            hint=f"Give --path {ORBIT}, or --path FILE.json with cameras.")
    plan = _plan_cameras(request, trained)
    if not request.panorama:
        return plan
    width, _ = frame_size(WIDTH, WIDTH // 2, request)
    up = trained.up()
    return CameraPlan(f"{plan.name}_panorama", {
        name: panorama_camera(camera.viewmat, up, 2 * (width // 2))
        for name, camera in plan.cameras.items()}, plan.path)


def _plan_cameras(request: RenderRequest, trained: TrainedScene) -> CameraPlan:
    if request.views:
        views = _select_views(request.views, trained.scene)
        cameras = {
            Path(view.name).stem: _resize_view(view.camera, request, trained) for view in views}
        name = request.views[0] if len(request.views) == 1 else "chosen"
        return CameraPlan(f"views_{Path(name).stem}", cameras, None)
    if request.file is not None:
        path, name = read_camera_path(request.file), f"path_{request.file.stem}"
    else:
        path, name = _make_path(request, trained), request.path
    width, height = frame_size(path.width, path.height, request)
    path = replace(path, width=width, height=height, fps=request.fps or path.fps or FPS)
    return CameraPlan(name, {f"{at:05d}": camera for at, camera in enumerate(path.cameras())}, path)


def _make_path(request: RenderRequest, trained: TrainedScene) -> CameraPath:
    """Returns the path through or around the training cameras, with their lens and size."""
    scene, count = trained.scene, request.frames()
    cameras = [view.camera for view in views_ahead(scene.train)]
    if not trained.has_views:
        cameras = cameras[:CAMERAS_AROUND]  # the synthetic cameras after these are in the middle
    viewmats = np.stack([camera.viewmat for camera in cameras])
    if request.path == TRAINING:
        viewmats = smooth_path(viewmats, count)
    elif request.path == TOUR:
        viewmats = tour_path(viewmats, count)
    else:
        centers = np.stack([camera.center for camera in cameras])
        viewmats = orbit_path(centers, find_look_at(cameras, scene.points), trained.up(), count)
    # the first camera of the shape and focal length that most cameras have
    kinds = [(camera.width, camera.height, camera.fy) for camera in cameras]
    usual = cameras[kinds.index(Counter(kinds).most_common(1)[0][0])]
    fov = np.degrees(2 * np.arctan(usual.height / 2 / usual.fy))
    # a tour is for people: as large as the frames, not as what was trained on
    most = TOUR_SIZE if request.path == TOUR else trained.config.max_size
    width, height = fit_size(usual.width, usual.height, most)
    return CameraPath(viewmats, np.full(count, fov), width, height)


def _resize_view(camera: Camera, request: RenderRequest, trained: TrainedScene) -> Camera:
    """Returns the camera of a view at the requested size, or at that of training and scores."""
    if request.size or request.width or request.height:
        return camera.resized(*frame_size(camera.width, camera.height, request))
    return fit_camera(camera, trained.config.max_size)


def _select_views(names: Sequence[str], scene: Scene) -> list[View]:
    """Returns the views of some names or of whole parts, each once, in the order of names."""
    parts = {"train": scene.train, "validation": scene.validation, "test": scene.test}
    known = {view.name: view for part in parts.values() for view in part}
    selected: dict[str, View] = {}
    for name in names:
        matches = parts.get(name) or tuple(
            view for view in known.values() if name in (view.name, Path(view.name).stem))
        if not matches:
            raise _no_such_view(name, parts, known, scene.unregistered_test)
        selected.update({view.name: view for view in matches})
    return [selected[name] for name in sorted(selected)]


def _no_such_view(
    name: str, parts: Collection[str], known: Collection[str], unregistered: Collection[str]
) -> ConfigError:
    if name in parts:
        return ConfigError(f"This capture has no {name} views.", hint="Give others with --views.")
    if name in unregistered:
        return ConfigError(
            f"The frame {name} has no camera, so it has no view to render.",
            hint=f"Give {', '.join(parts)}, or the name of a frame such as {min(known)}.")
    close = difflib.get_close_matches(name, known, n=1)
    return ConfigError(
        f"None of this capture's {len(known)} views is named {name!r}.",
        hint=f"Did you mean {close[0]}?" if close else (
            f"Give {', '.join(parts)}, or the name of a frame such as {min(known)}."))


def frame_size(width: int, height: int, request: RenderRequest) -> tuple[int, int]:
    """Returns the (width, height) of frames whose own size is `width` x `height`.

    A side that is not requested follows from the other. For a video both are even; ConfigError if a
    requested one is odd.
    """
    sides = (request.width, request.height)
    if request.size:
        sides = (request.size, None) if width >= height else (None, request.size)
    requested = [side for side in sides if side]
    if request.video and any(side % 2 for side in requested):
        raise ConfigError(
            f"Video width and height must be even, not {' by '.join(map(str, requested))} pixels: "
            "H.264 and AV1 store colour for blocks of 2x2 pixels.", hint="Give even numbers.")
    own = (width, height)
    factor = next((side / size for side, size in zip(sides, own, strict=True) if side), 1.0)
    step = 2 if request.video else 1
    width, height = (side or max(step, step * round(size * factor / step))
                     for side, size in zip(sides, own, strict=True))
    return width, height


def check_frame_memory(width: int, height: int) -> None:
    """Raises ConfigError unless a frame of this size can be rendered in the free memory."""
    needed, free = width * height * _BYTES_PER_PIXEL, free_memory_bytes()
    if needed > free or max(width, height) > MAX_SIDE:
        raise ConfigError(
            f"A picture of {width}x{height} pixels takes about {needed / 1e6:,.0f} MB to render; "
            f"{free / 1e6:,.0f} MB are free, and {MAX_SIDE:,} pixels are the longest side.",
            hint="Lower --size, or --width and --height.")
