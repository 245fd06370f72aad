"""The content of the viewer: models and views of a workspace, or a splat file, and a crop box."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import viser
from numpy.typing import NDArray

from recon_cli.context import StageContext
from recon_cli.errors import FormatError
from recon_cli.evaluation.metrics import psnr
from recon_cli.evaluation.reference_views import render_view
from recon_cli.flythrough.request import TOUR_SIZE
from recon_cli.flythrough.trained_scene import open_trained_scene
from recon_cli.io.images import fit_camera, fit_size, read_image, read_masked_image, to_uint8
from recon_cli.pipeline.execute import Job, last_sources, render_context
from recon_cli.render.contract import NEAR
from recon_cli.scene.camera import Camera
from recon_cli.scene.camera_paths import visible_depths
from recon_cli.scene.scene import View, views_ahead
from recon_cli.scene.splats import Splats
from recon_cli.scene.train_view import leaves_enough
from recon_cli.splats.html import find_title
from recon_cli.splats.ply import read_ply
from recon_cli.splats.registry import read_splats
from recon_cli.train.masks import read_summary
from recon_cli.viewer.gaussians import PackedGaussians, pack_splats
from recon_cli.viewer.keyframes import PathFolder

HELD_OUT, TRAINING, VALIDATION = "held-out", "training", "validation"
_FOLDERS = {"pruned": "prune", "base": "train"}
FAR = 1000.0  # world units; viser's default
_FOV = math.radians(60)  # for a file, which has no camera
_STEEP = 0.05  # cosine between the image's and the world's up, below which a view looks up or down
_SHARE = 0.05  # of the Gaussians outside the initial box at either end of each axis
_MARGIN = 0.1  # of its sides
_CORNERS = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)])
_EDGES = [(a, b) for a in range(8) for b in range(a) if (a ^ b).bit_count() == 1]
_THUMBNAIL = 160  # pixels, longest side


@dataclass(frozen=True, eq=False)
class BrowserCamera:
    """A camera as the browser takes it; lengths are in world units."""

    position: NDArray[np.float64]  # [3]
    look_at: NDArray[np.float64]  # [3], the point that it turns around
    fov: float  # vertical, in radians
    near: float
    far: float


@dataclass(frozen=True, eq=False)
class LabeledView:
    """A view that can be jumped to."""

    view: View
    part: str  # held-out, training or validation

    @property
    def label(self) -> str:
        """Its name and part, for lists."""
        return f"{self.view.name} ({self.part})"


@dataclass(frozen=True, eq=False)
class ViewerContent:
    """Everything that browsers can show."""

    models: Mapping[str, PackedGaussians]  # by name, the initial one first
    views: tuple[LabeledView, ...]  # held-out first; none for a file or an import without views
    up: NDArray[np.float64] | None  # [3] unit vector; None where unknown
    start: BrowserCamera
    distance: float  # from a camera to its target, world units
    max_size: int  # longest side that views are rendered at, in pixels
    title: str  # of the page
    paths: PathFolder  # where camera paths are saved
    metres: bool = False  # one world unit is a metre
    masked: str = ""  # what training masked because it moves, a sentence; empty for nothing


def load_workspace(job: Job, model: str) -> ViewerContent:
    """Returns the trained scene of a workspace, with both models if neither is stale.

    `model` is auto, base or pruned: the initial one. StageError if it is missing or stale.
    """
    trained = open_trained_scene(job, model, verb="view")
    models = {trained.model: pack_splats(trained.splats)}
    known = {"base", "pruned"} if job.inspect().check("prune").usable else {"base"}
    for name in sorted(known - models.keys()):
        models[name] = pack_splats(read_ply(job.workspace.folder(_FOLDERS[name]) / "splats.ply"))
    scene = trained.scene
    parts = {HELD_OUT: scene.test, TRAINING: scene.train, VALIDATION: scene.validation}
    views = tuple(LabeledView(view, part) for part, members in parts.items() for view in members
                  if trained.has_views)
    first = views_ahead(scene.train)[0].camera
    depths = visible_depths(first, scene.points)
    distance = float(np.median(depths)) if len(depths) else scene.extent
    return ViewerContent(
        models, views, trained.up(), browser_camera(first, distance, _far_plane(models)), distance,
        trained.config.max_size, _find_title(job), PathFolder(
            job.workspace.root, job.workspace.root, fit_size(first.width, first.height, TOUR_SIZE)),
        trained.metres, _describe_masked(job))


def _describe_masked(job: Job) -> str:
    """Returns what the training of a workspace masked, a sentence; empty for nothing."""
    summary = read_summary(job.workspace.folder("train"))
    if summary is None:
        return ""
    return (f"{summary.share:.1%} of the pixels of {len(summary.shares)} of {summary.views} views "
            "were masked in training, as they move.")


def _find_title(job: Job) -> str:
    """Returns the title of a capture, as that of its exported page."""
    sources = last_sources(job, "ingest")
    return find_title(Path(sources[0].path).name if sources else "")


def load_file(path: Path) -> ViewerContent:
    """Returns a splat file, seen from a corner of its room; FormatError if it is empty."""
    splats = read_splats(path)
    models = {path.name: pack_splats(splats)}
    if not len(models[path.name].splats):
        raise FormatError(f"{path} holds no Gaussian that can be drawn.", hint="Give another file.")
    box = box_around(splats)
    low, high = np.array(box.low), np.array(box.high)
    middle, corner = (low + high) / 2, low + 0.8 * (high - low)
    start = BrowserCamera(corner, middle, _FOV, NEAR, _far_plane(models))
    return ViewerContent(
        models, (), None, start, float(np.linalg.norm(corner - middle)), 0, path.name,
        PathFolder(Path(), None))


def _far_plane(models: Mapping[str, PackedGaussians]) -> float:
    """Returns a distance beyond all Gaussians."""
    reach = [float(model.splats.means.norm(dim=1).max()) if len(model.splats) else 0.0
             for model in models.values()]
    return max(FAR, *(2 * distance for distance in reach))


def browser_camera(camera: Camera, distance: float, far: float) -> BrowserCamera:
    """Returns a camera for the browser, which takes the principal point for the image centre."""
    look_at = camera.center + distance * camera.viewmat[2, :3]
    return BrowserCamera(camera.center, look_at, vertical_fov(camera), NEAR, far)


def vertical_fov(camera: Camera) -> float:
    """Returns the vertical field of view in radians."""
    return 2 * math.atan(camera.height / 2 / camera.fy)


def move_browser(
    client: viser.ClientHandle, target: BrowserCamera, up: NDArray[np.float64] | None,
    camera: Camera,
) -> None:
    """Moves the camera of a browser to `target`, with the roll of `camera`.

    Up becomes the world's as the camera sees it: dragging still turns around the vertical.
    """
    right, image_up = camera.viewmat[0, :3], -camera.viewmat[1, :3]
    world_up = image_up if up is None else up - (up @ right) * right
    with client.atomic():
        client.camera.up_direction = world_up if world_up @ image_up > _STEEP else image_up
        client.camera.position = target.position
        client.camera.look_at = target.look_at
        client.camera.fov = target.fov


def set_initial_camera(server: viser.ViserServer, start: BrowserCamera) -> None:
    """Sets the camera of browsers that connect from now on."""
    camera = server.initial_camera
    camera.position, camera.look_at = start.position, start.look_at
    camera.fov, camera.near, camera.far = start.fov, start.near, start.far


@dataclass(frozen=True)
class CropBox:
    """An axis-aligned box in world units."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    @staticmethod
    def between(low: Sequence[float], high: Sequence[float]) -> CropBox:
        """Returns the box of two corners, rounded as `arguments` writes them."""
        first, second = ((float(_format(x)), float(_format(y)), float(_format(z)))
                         for x, y, z in (low, high))
        return CropBox(first, second)

    @property
    def arguments(self) -> str:
        """The six numbers for `recon export --crop`."""
        return " ".join(_format(value) for value in (*self.low, *self.high))

    @property
    def is_valid(self) -> bool:
        """Whether its low corner is below its high corner."""
        return all(a < b for a, b in zip(self.low, self.high, strict=True))

    def contains(self, splats: Splats) -> NDArray[np.bool_]:
        """Returns [N] which centres are inside, its faces included."""
        low, high = splats.means.new_tensor(self.low), splats.means.new_tensor(self.high)
        inside: NDArray[np.bool_] = (
            (splats.means >= low) & (splats.means <= high)).all(dim=1).numpy()
        return inside

    def edges(self) -> NDArray[np.float32]:
        """Returns its edges [12, 2, 3]."""
        corners = np.where(_CORNERS, self.high, self.low)
        return np.asarray(corners[np.array(_EDGES)], np.float32)


def box_around(splats: Splats) -> CropBox:
    """Returns the initial box: 90% of the Gaussians along each axis, plus a tenth of its sides."""
    if not len(splats):
        return CropBox((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    low, high = np.quantile(splats.means.numpy(), [_SHARE, 1 - _SHARE], axis=0)
    margin = _MARGIN * (high - low) + 1e-3
    return CropBox.between((low - margin).tolist(), (high + margin).tolist())


def _format(value: float) -> str:
    return f"{value:.4g}"


class PhotoPairs:
    """Photos of views next to recon's own renders of them; for one thread at a time.

    `max_size` is the longest side in pixels.
    """

    def __init__(self, job: Job, max_size: int) -> None:
        self._job, self._max_size = job, max_size
        self._thumbnails: dict[str, NDArray[np.uint8]] = {}

    @cached_property
    def _ctx(self) -> StageContext:
        return render_context(self._job.compute, self._job.progress)

    def load_photo(self, view: View) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None]:
        """Returns a photo [H, W, 3] at the size of training, painted under its mask [H, W]."""
        camera = fit_camera(view.camera, self._max_size)
        return read_masked_image(view.original, view.mask, camera.width, camera.height)

    def render_view(self, view: View, splats: Splats) -> tuple[NDArray[np.uint8], float | None]:
        """Returns recon's render [H, W, 3] of a view and its PSNR in dB, as `recon eval` has it.

        The PSNR is None if a mask leaves too little of the view.
        """
        truth, mask = self.load_photo(view)
        camera, device = fit_camera(view.camera, self._max_size), self._ctx.device
        on_device = splats.map(lambda tensor: tensor.to(device))
        rgb = render_view(on_device, camera, splats.sh_degree, self._ctx.backend).rgb
        image: NDArray[np.float32] = rgb.cpu().numpy()
        return to_uint8(image), psnr(image, truth, mask) if leaves_enough(mask) else None

    def thumbnail(self, view: View) -> NDArray[np.uint8]:
        """Returns a small picture of a view."""
        if view.name not in self._thumbnails:
            size = fit_size(view.camera.width, view.camera.height, _THUMBNAIL)
            self._thumbnails[view.name] = read_image(view.original, *size)
        return self._thumbnails[view.name]
