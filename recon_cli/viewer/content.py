"""What there is to look at: the models of a workspace and its views, or a file of Gaussians."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import FormatError
from recon_cli.flythrough.smooth import depths_seen
from recon_cli.flythrough.source import open_source
from recon_cli.io.ply import read_ply
from recon_cli.io.splats.registry import read_splats
from recon_cli.pipeline.execute import Job
from recon_cli.render.contract import NEAR
from recon_cli.scene.camera import Camera
from recon_cli.scene.scene import View
from recon_cli.scene.splats import Splats
from recon_cli.viewer.crop_box import box_around
from recon_cli.viewer.gaussians import Packed, packed

HELD_OUT, TRAINING, VALIDATION = "held-out", "training", "validation"
_FOLDERS = {"pruned": "prune", "base": "train"}
FAR = 1000.0  # world units; what viser draws to by itself
_FOV = math.radians(60)  # of a file, which has no lens


@dataclass(frozen=True, eq=False)
class Eye:
    """Where a browser stands.

    Attributes:
        position: [3] in world units.
        look_at: [3], what it turns around.
        fov: vertical, in radians.
        near: what is nearer is not drawn, world units.
        far: what is farther is not drawn, world units.
    """

    position: NDArray[np.float64]
    look_at: NDArray[np.float64]
    fov: float
    near: float
    far: float


@dataclass(frozen=True, eq=False)
class ShownView:
    """A view that can be jumped to.

    Attributes:
        view: with its camera.
        part: held-out, training or validation.
    """

    view: View
    part: str

    @property
    def label(self) -> str:
        """Its name and part, for lists."""
        return f"{self.view.name} ({self.part})"


@dataclass(frozen=True, eq=False)
class Content:
    """All that browsers are shown.

    Attributes:
        models: by name, the one to begin with first.
        views: the held-out ones first; none for a file, or a scene imported without views.
        up: [3] unit vector; None where it is not known.
        start: where every browser begins.
        distance: from a camera to what it looks at, world units.
        max_size: longest side that views are rendered at, in pixels.
    """

    models: Mapping[str, Packed]
    views: tuple[ShownView, ...]
    up: NDArray[np.float64] | None
    start: Eye
    distance: float
    max_size: int


def of_workspace(job: Job, model: str) -> Content:
    """Returns the trained scene of a workspace, with both models where both are fresh.

    Args:
        job: whose workspace it is.
        model: auto, base or pruned: the one to begin with.

    Raises:
        StageError: there is no such model that is fresh.
        FormatError: a file of the workspace is damaged.
    """
    source = open_source(job, model, verb="view")
    models = {source.model: packed(source.splats)}
    fresh = {"base", "pruned"} if job.inspect().check("prune").fresh else {"base"}
    for name in sorted(fresh - models.keys()):
        models[name] = packed(read_ply(job.workspace.folder(_FOLDERS[name]) / "splats.ply"))
    scene = source.scene
    parts = {HELD_OUT: scene.test, TRAINING: scene.train, VALIDATION: scene.validation}
    views = tuple(ShownView(view, part) for part, some in parts.items() for view in some
                  if source.has_views)
    first = scene.train[0].camera
    seen = depths_seen(first, scene.points)
    distance = float(np.median(seen)) if len(seen) else scene.extent
    return Content(
        models, views, source.up(), eye_of(first, distance, _farthest(models)), distance,
        source.max_size)


def of_file(path: Path) -> Content:
    """Returns a file of Gaussians, looked at from a corner of its room.

    Raises:
        FormatError: its format is not known, or it is damaged or empty.
    """
    splats = read_splats(path)
    models = {path.name: packed(splats)}
    if not len(models[path.name].splats):
        raise FormatError(
            f"{path} holds no Gaussian that can be drawn.", hint="Give another file.")
    box = box_around(splats)
    low, high = np.array(box.low), np.array(box.high)
    middle, corner = (low + high) / 2, low + 0.8 * (high - low)
    start = Eye(corner, middle, _FOV, NEAR, _farthest(models))
    return Content(models, (), None, start, float(np.linalg.norm(corner - middle)), 0)


def eye_of(camera: Camera, distance: float, far: float) -> Eye:
    """Returns where a camera stands; its principal point is taken for the middle."""
    forward = camera.viewmat[2, :3]
    return Eye(camera.center, camera.center + distance * forward, vertical_fov(camera), NEAR, far)


def vertical_fov(camera: Camera) -> float:
    """Returns the vertical field of view in radians."""
    return 2 * math.atan(camera.height / 2 / camera.fy)


def _farthest(models: Mapping[str, Packed]) -> float:
    """Returns a distance beyond all Gaussians."""
    return max(FAR, *(2 * _reach(model.splats) for model in models.values()))


def _reach(splats: Splats) -> float:
    return float(splats.means.norm(dim=1).max()) if len(splats) else 0.0
