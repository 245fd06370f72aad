"""Reference views: photos at the size they are scored at, and the scores of renders."""

from __future__ import annotations

import hashlib
import statistics
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from recon_cli.context import StageContext
from recon_cli.errors import ConfigError, Hint, ReconstructionError
from recon_cli.evaluation.metrics import Perceptual, both_ssim, corrected_psnr, psnr, ssim
from recon_cli.evaluation.panoramas import FaceScore, face_weights, join_faces, score_face
from recon_cli.evaluation.scores import MeanScore, ViewScore
from recon_cli.io.images import fit_camera, to_uint8
from recon_cli.io.views import MASK_HINT, ReferenceView, load_views
from recon_cli.render import RenderOutput, render
from recon_cli.render.response import LensFalloffs
from recon_cli.scene.camera import Camera
from recon_cli.scene.scene import Scene, View
from recon_cli.scene.splats import Splats
from recon_cli.scene.train_view import MIN_SIDE, TrainView

_AT_ONCE = 4  # views a thread: renders that are in memory together
_Item = TypeVar("_Item")
_View = TypeVar("_View", bound=TrainView)


@dataclass(frozen=True)
class RenderScores:
    """The scores of one model on reference views."""

    views: tuple[ViewScore, ...]
    render_ms: float  # median milliseconds a view


@dataclass(frozen=True, eq=False)
class Images:
    """The images of a render, on the CPU."""

    rgb: NDArray[np.float32]  # [H, W, 3] on the backdrop, not clamped
    alpha: NDArray[np.float32]  # [H, W]
    depth: NDArray[np.float32]  # [H, W] sum of alpha T z, world units

    @staticmethod
    def from_output(output: RenderOutput) -> Images:
        """Returns those of a backend's output; waits for them."""
        return Images(*(np.asarray(tensor.cpu().numpy(), np.float32)
                        for tensor in (output.rgb, output.alpha, output.depth)))


class RenderedModel:
    """A model, and images of it that need not be rendered again, by camera."""

    def __init__(self, splats: Splats, sh_degree: int, backend: str, room: int = 0) -> None:
        self.splats, self.sh_degree, self.backend = splats, sh_degree, backend
        self._room = room  # bytes that are left for images
        self._kept: dict[bytes, Images] = {}
        self._lock = threading.Lock()

    def keep(self, camera: Camera, images: Images) -> None:
        """Keeps what a camera sees if there is room for it."""
        size = images.rgb.nbytes + images.alpha.nbytes + images.depth.nbytes
        with self._lock:
            if size <= self._room and _key(camera) not in self._kept:
                self._kept[_key(camera)] = images
                self._room -= size

    def images(self, camera: Camera) -> Images:
        """Returns what a camera sees, rendered unless it was kept."""
        kept = self._kept.get(_key(camera))
        return kept or Images.from_output(
            render_view(self.splats, camera, self.sh_degree, self.backend))


def _key(camera: Camera) -> bytes:
    lens = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    return np.array(lens, np.float64).tobytes() + camera.viewmat.tobytes()


def load_reference_views(
    views: Sequence[View], max_size: int, ctx: StageContext | None = None, *, threads: int = 1
) -> list[ReferenceView]:
    """Returns views with their original pixels, without those whose mask leaves too little.

    `max_size` is the longest side in pixels; `ctx`, if any, gets a notice of views left out.
    ConfigError if they are smaller than the window of SSIM, FormatError for a damaged image.
    """
    for camera in (fit_camera(view.camera, max_size) for view in views):
        if min(camera.width, camera.height) < MIN_SIDE:
            raise ConfigError(
                f"Views of {camera.width}x{camera.height} pixels are too small to score; SSIM "
                f"needs {MIN_SIDE} pixels a side.", hint="Use a larger --max-size.")
    return load_views(
        views, max_size, "not scored", ctx.notice if ctx is not None else None, threads=threads)


def load_held_out_views(scene: Scene, max_size: int, ctx: StageContext) -> list[ReferenceView]:
    """Returns the held-out views that can be scored; a notice names those that masks hide.

    ReconstructionError if no held-out view has a camera, or masks leave none; ConfigError if they
    are smaller than the window of SSIM.
    """
    if not scene.test:
        raise ReconstructionError(
            f"No held-out view has a camera ({len(scene.unregistered_test)} were held out).",
            hint=Hint("ingest", then=" with another --holdout, such as every:8"))
    views = load_reference_views(scene.test, max_size, ctx, threads=ctx.threads)
    if not views:
        raise ReconstructionError(
            f"The masks leave nothing to score of {len(scene.test)} held-out views.",
            hint=MASK_HINT)
    return views


def render_view(splats: Splats, camera: Camera, sh_degree: int, backend: str) -> RenderOutput:
    """Returns a view of a model on its backdrop, without gradients, on the model's device."""
    with torch.no_grad():
        return render(splats, camera, splats.background, sh_degree, backend=backend)


def score_image(
    name: str, image: NDArray[np.float32], truth: NDArray[Any],
    mask: NDArray[np.bool_] | None = None, *, perceptual: Perceptual | None = None,
) -> ViewScore:
    """Returns the scores of an image [H, W, 3], not clamped, against its truth of the same size.

    The truth is of 8 bits, or float in [0, 1]. A view with a mask has no LPIPS.
    """
    return ViewScore(
        name, psnr(image, truth, mask), psnr(to_uint8(image), truth, mask),
        *both_ssim(image, truth, mask),
        perceptual(image, truth) if perceptual is not None and mask is None else None,
        None if mask is None else float(mask.mean()))


def score_views(
    splats: Splats, views: Sequence[ReferenceView], sh_degree: int, backend: str,
    *, perceptual: Perceptual | None = None, threads: int = 1,
    falloffs: LensFalloffs | None = None,
    on_view: Callable[[ReferenceView, Images], None] = lambda _view, _images: None,
) -> RenderScores:
    """Renders every view, at least one, of a model and returns its scores.

    The faces of a panorama are scored together, under the name of their frame. `perceptual` is
    LPIPS; `falloffs` shade the renders; `on_view` gets each view and its images in one of
    `threads`.
    """
    weights = face_weights(views)

    def score(
        view: ReferenceView, images: Images
    ) -> tuple[ViewScore, float] | FaceScore:
        image = images.rgb
        if view.name in weights:
            face = score_face(view, image, weights[view.name])
            on_view(view, images)
            return face
        photo, mask = view.image, view.mask
        scores = score_image(view.name, image, photo, mask, perceptual=perceptual)
        on_view(view, images)
        return scores, corrected_psnr(image, photo, mask)

    milliseconds: list[float] = []
    found = _measure(
        splats, views, sh_degree, backend, score, threads=threads, milliseconds=milliseconds,
        falloffs=falloffs)
    rows = [row for row in found if not isinstance(row, FaceScore)]
    rows += join_faces([row for row in found if isinstance(row, FaceScore)])
    scores = tuple(replace(score, gain_psnr_db=corrected) for score, corrected in rows)
    return RenderScores(scores, statistics.median(milliseconds))


def mean_psnr(
    splats: Splats, views: Sequence[TrainView], sh_degree: int, backend: str,
    *, corrected: bool = False, threads: int = 1, falloffs: LensFalloffs | None = None,
    on_view: Callable[[TrainView, Images], None] = lambda _view, _images: None,
) -> float:
    """Returns the mean PSNR in dB over views, at least one; arguments are as of `score_views`."""
    metric = corrected_psnr if corrected else psnr

    def score(view: TrainView, images: Images) -> float:
        value = metric(images.rgb, view.image, view.mask)
        on_view(view, images)
        return value

    return statistics.fmean(_measure(
        splats, views, sh_degree, backend, score, threads=threads, falloffs=falloffs))


def mean_score(
    splats: Splats, views: Sequence[TrainView], sh_degree: int, backend: str
) -> MeanScore:
    """Returns the mean PSNR and SSIM over views, at least one."""
    mean = np.mean(_measure(splats, views, sh_degree, backend, lambda view, images: (
        psnr(images.rgb, view.image, view.mask), ssim(images.rgb, view.image, view.mask))), axis=0)
    return MeanScore(float(mean[0]), float(mean[1]))


def _measure(
    splats: Splats, views: Sequence[_View], sh_degree: int, backend: str,
    score: Callable[[_View, Images], _Item], *, threads: int = 1,
    milliseconds: list[float] | None = None, falloffs: LensFalloffs | None = None,
) -> list[_Item]:
    """Returns the `score` of each view and its images, the render as `falloffs` shade it.

    Scores of some views are taken at once, as most of them keep to one core; meanwhile nothing is
    rendered, so that `milliseconds`, to which the times of the renders are added, mean something.
    """
    results: list[_Item] = []
    with ThreadPoolExecutor(threads) as pool:
        for begin in range(0, len(views), _AT_ONCE * threads):
            group, rendered = views[begin:begin + _AT_ONCE * threads], []
            for view in group:
                start = time.perf_counter()
                output = render_view(splats, view.camera, sh_degree, backend)
                images = Images.from_output(output)
                if falloffs is not None:
                    images = replace(images, rgb=falloffs.shade(images.rgb, view.camera))
                rendered.append(images)
                if milliseconds is not None:
                    milliseconds.append(1e3 * (time.perf_counter() - start))
            results += pool.map(score, group, rendered)
    return results


def mean_psnr_on_device(
    splats: Splats, views: Sequence[TrainView], sh_degree: int, backend: str,
    falloffs: LensFalloffs | None = None,
) -> float:
    """Returns the mean PSNR in dB over views, at least one, in float32 on the model's device."""
    device = splats.means.device
    values = []
    with torch.no_grad():
        for view in views:
            rgb = render_view(splats, view.camera, sh_degree, backend).rgb
            if falloffs is not None:
                rgb = falloffs.shade_tensor(rgb, view.camera)
            errors = (rgb.clamp(0, 1) - view.pixels(device)).square()
            counting = view.counting(device)
            error = (errors if counting is None else errors[counting]).mean().item()
            values.append(-10 * np.log10(max(error, 1e-10)))
    return float(np.mean(values))


def reference_digest(views: Sequence[ReferenceView]) -> str:
    """Returns a digest of names, lenses, pixels and masks; scores with equal ones can be paired."""
    digest = hashlib.sha256()
    for view in views:
        camera = view.camera
        lens = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        digest.update(repr((view.name, lens, view.mask is None)).encode())
        for pixels in (view.image, view.mask):
            if pixels is not None:
                digest.update(np.ascontiguousarray(pixels).tobytes())
    return digest.hexdigest()
