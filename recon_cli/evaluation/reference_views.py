"""Views to score at the size they are scored at, and the scores of a model on them."""

from __future__ import annotations

import hashlib
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from recon_cli.context import StageContext, StageInputs, Summary
from recon_cli.errors import ConfigError, ReconstructionError
from recon_cli.evaluation import MIN_PIXELS, MIN_SIDE, ViewScore, leaves_enough, psnr, ssim
from recon_cli.evaluation.lpips import Perceptual
from recon_cli.evaluation.quality import corrected_psnr
from recon_cli.io.colmap import read_scene
from recon_cli.io.frames import read_frame_list
from recon_cli.io.images import eight_bit, fitted_camera, read_masked_image
from recon_cli.render import render
from recon_cli.scene.camera import Camera
from recon_cli.scene.scene import Scene, View
from recon_cli.scene.splats import Splats

LABELS = {"base": "3DGS", "pruned": "ours (pruned)"}  # of the models of a workspace


@dataclass(frozen=True, eq=False)
class Truth:
    """A view at the size it is scored at.

    Attributes:
        name: of the view.
        camera: at that size.
        image: [H, W, 3], the original pixels.
        mask: [H, W], True where a pixel counts; None where all do.
    """

    name: str
    camera: Camera
    image: NDArray[np.uint8]
    mask: NDArray[np.bool_] | None

    @property
    def enough(self) -> bool:
        """Whether the mask leaves enough to score."""
        return self.mask is None or leaves_enough(self.mask)


@dataclass(frozen=True)
class Scored:
    """The scores of one model.

    Attributes:
        views: per view.
        corrected_db: mean PSNR after the best gain per channel of each view: a model with exposures
            shows the mean one, and cannot know that of a view that it was not trained on.
        render_ms: median milliseconds a view.
    """

    views: tuple[ViewScore, ...]
    corrected_db: float
    render_ms: float


def scorable(scene: Scene, max_size: int, ctx: StageContext) -> list[Truth]:
    """Returns the held-out views that can be scored, and names the others.

    Args:
        scene: its views.
        max_size: longest side in pixels.
        ctx: gets the notices.

    Raises:
        ReconstructionError: no held-out view has a camera, or masks leave none.
        ConfigError: they are smaller than the window of SSIM.
    """
    if not scene.test:
        raise ReconstructionError(
            f"No held-out view has a camera ({len(scene.unregistered_test)} were held out).",
            hint="Run `recon ingest` with another --holdout, such as every:8.")
    read = truths(scene.test, max_size)
    kept = [truth for truth in read if truth.enough]
    notice_hidden([truth.name for truth in read if truth not in kept], "not scored", ctx)
    if not kept:
        raise ReconstructionError(
            f"The masks leave nothing to score of {len(read)} held-out views.", hint=MASK_HINT)
    return kept


def truths(views: Sequence[View], max_size: int) -> list[Truth]:
    """Returns views with their original pixels.

    Raises:
        ConfigError: they are smaller than the window of SSIM.
    """
    found = []
    for view in views:
        camera = fitted_camera(view.camera, max_size)
        if min(camera.width, camera.height) < MIN_SIDE:
            raise ConfigError(
                f"Views of {camera.width}x{camera.height} pixels are too small to score; SSIM "
                f"needs {MIN_SIDE} pixels a side.",
                hint="Run `recon eval` with a larger --max-size.")
        image, mask = read_masked_image(view.original, view.mask, camera.width, camera.height)
        found.append(Truth(view.name, camera, image, mask))
    return found


def truth_digest(views: Sequence[Truth]) -> str:
    """Returns a digest of all that models are held against: names, lenses, pixels, masks.

    Scores of two models can be paired where theirs are equal.
    """
    found = hashlib.sha256()
    for truth in views:
        camera = truth.camera
        lens = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        found.update(repr((truth.name, lens, truth.mask is None)).encode())
        for pixels in (truth.image, truth.mask):
            if pixels is not None:
                found.update(np.ascontiguousarray(pixels).tobytes())
    return found.hexdigest()


def scored(
    splats: Splats, views: Sequence[Truth], sh_degree: int, ctx: StageContext,
    *, perceptual: Perceptual | None = None,
    on_view: Callable[[Truth, NDArray[np.float32]], None] = lambda _truth, _image: None,
) -> Scored:
    """Renders every view of one model and returns its scores.

    Args:
        splats: the model, on the device of `ctx`.
        views: to score, at least one.
        sh_degree: in use.
        ctx: backend and device.
        perceptual: the perceptual distance, where there is one.
        on_view: gets each view and its picture [H, W, 3], not clamped.
    """
    scores, milliseconds, corrected = [], [], []
    for truth in views:
        image, elapsed = _timed_render(splats, truth.camera, sh_degree, ctx)
        milliseconds.append(elapsed)
        scores.append(view_score(truth, image, perceptual))
        corrected.append(corrected_psnr(image, truth.image, truth.mask))
        on_view(truth, image)
    return Scored(
        tuple(scores), statistics.fmean(corrected), statistics.median(milliseconds))


def mean_psnr(
    splats: Splats, views: Sequence[Truth], sh_degree: int, ctx: StageContext, *,
    corrected: bool, on_view: Callable[[], None],
) -> float:
    """Returns the mean PSNR in dB over views, at least one.

    Args:
        splats: the model, on the device of `ctx`.
        views: to score.
        sh_degree: in use.
        ctx: backend and device.
        corrected: after the best gain per channel of each view.
        on_view: called after each view.
    """
    score = corrected_psnr if corrected else psnr
    found = []
    for truth in views:
        image, _ = _timed_render(splats, truth.camera, sh_degree, ctx)
        found.append(score(image, truth.image, truth.mask))
        on_view()
    return statistics.fmean(found)


def view_score(
    truth: Truth, image: NDArray[np.float32], perceptual: Perceptual | None = None
) -> ViewScore:
    """Returns the scores of a picture [H, W, 3]; LPIPS only of views without a mask."""
    mask = truth.mask
    distance = None
    if perceptual is not None and mask is None:
        distance = perceptual(image, truth.image)
    return ViewScore(
        truth.name, psnr(image, truth.image, mask), psnr(eight_bit(image), truth.image, mask),
        ssim(image, truth.image, mask), ssim(image, truth.image, mask, padded=True), distance,
        None if mask is None else float(mask.mean()))


def _timed_render(
    splats: Splats, camera: Camera, sh_degree: int, ctx: StageContext
) -> tuple[NDArray[np.float32], float]:
    """Returns the image [H, W, 3] and the milliseconds that it took."""
    start = time.perf_counter()
    with torch.no_grad():
        background = torch.zeros(3, device=ctx.device)
        rgb = render(splats, camera, background, sh_degree, backend=ctx.backend).rgb
        image: NDArray[np.float32] = rgb.cpu().numpy()  # waits for the device
    return image, 1e3 * (time.perf_counter() - start)


def held_out_names(ingest: Path) -> frozenset[str]:
    """Returns the names of the frames that ingest kept for the score."""
    return frozenset(frame.name for frame in read_frame_list(ingest).frames if frame.held_out)


def load_scene(inputs: StageInputs, *, validation: float) -> Scene:
    """Returns the views and points that sfm left, split by what each may be used for."""
    undistorted = inputs.folders["sfm"] / "undistorted"
    return read_scene(
        undistorted, held_out=held_out_names(inputs.folders["ingest"]), validation=validation)


MASK_HINT = "Run `recon ingest` with masks that hide less."


def notice_hidden(names: Sequence[str], what: str, ctx: StageContext) -> None:
    """Says which views are left out because of their masks, and what that means for them."""
    if names:
        ctx.notice(f"{len(names)} views are {what}, for their masks leave fewer than {MIN_PIXELS} "
                   f"pixels: {', '.join(names)}")


def size_summary(cameras: Sequence[Camera]) -> Summary:
    """Returns width and height of the largest camera; where sizes differ also all as `sizes`."""
    sizes = sizes_of(cameras)
    summary: Summary = {"width": sizes[0][0], "height": sizes[0][1]}
    return summary if len(sizes) == 1 else {**summary, "sizes": [list(size) for size in sizes]}


def sizes_of(cameras: Sequence[Camera]) -> list[tuple[int, int]]:
    """Returns the different (width, height) of cameras, the one of most pixels first."""
    sizes = {(camera.width, camera.height) for camera in cameras}
    return sorted(sizes, key=lambda size: (size[0] * size[1], size), reverse=True)
