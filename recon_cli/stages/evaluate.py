"""evaluate: scores every model on the held-out views, against the original pixels.

The .ply is read back and rendered, so that what is handed out is what is measured. Writes
metrics.json, metrics.csv, metrics.md, table.txt, and pictures: renders/<model>/, truth/ and
difference/<model>/ (absolute error times four). Pixels that a mask ignores are not scored: they
are painted in one colour in truth/ and black in difference/.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from recon_cli.atomic import write_bytes, write_json
from recon_cli.config import EvaluateConfig
from recon_cli.errors import ConfigError, ReconstructionError
from recon_cli.io.images import eight_bit, fitted_camera, read_masked_image, write_png
from recon_cli.io.ply import read_ply
from recon_cli.metrics import (
    MASK_CONVENTION,
    MIN_SIDE,
    PSNR_CONVENTION,
    SSIM_CONVENTION,
    ModelScore,
    ViewScore,
    csv_table,
    leaves_enough,
    markdown_table,
    psnr,
    ssim,
    text_table,
)
from recon_cli.progress import Bar
from recon_cli.render import render
from recon_cli.scene.camera import Camera
from recon_cli.scene.scene import Scene
from recon_cli.scene.splats import Splats
from recon_cli.stages.context import StageContext, StageInputs, Summary
from recon_cli.stages.fitting import (
    LOG,
    MASK_HINT,
    load_scene,
    notice_hidden,
    read_config,
    seconds_at,
    size_summary,
    sizes_of,
)
from recon_cli.train.trials import corrected_psnr

_LABELS = {"base": "3DGS", "pruned": "ours (pruned)"}
_GAIN = 4  # of the difference images
_EVER = 1 << 62  # an iteration beyond any


@dataclass(frozen=True, eq=False)
class _Truth:
    """A held-out view at the size it is scored at; its mask is None where all pixels count."""

    name: str
    camera: Camera
    image: NDArray[np.uint8]
    mask: NDArray[np.bool_] | None


def run(config: EvaluateConfig, inputs: StageInputs, out: Path, ctx: StageContext) -> Summary:
    """Renders and scores the held-out views and returns the means of each model."""
    train_config = read_config(inputs.folders["train"])
    scene = load_scene(inputs, validation=train_config.validation)
    truths = _scorable(_truths(scene, config.max_size or train_config.max_size), ctx)
    stages = {"base": "train", "pruned": "prune"}
    folders = {model: inputs.folders[stage] for model, stage in stages.items()
               if stage in inputs.folders}
    for truth in truths:
        _save(out / "truth" / f"{Path(truth.name).stem}.png", truth.image)
    scores: dict[str, ModelScore] = {}
    corrected: dict[str, float] = {}
    with ctx.progress.bar("evaluate", len(truths) * len(folders), unit="view") as bar:
        for model, folder in folders.items():
            scores[model], corrected[model] = _score(
                model, folder, truths, train_config.sh_degree, out, ctx, bar)
    if scene.unregistered_test:
        ctx.notice(f"{len(scene.unregistered_test)} held-out views have no camera and are not "
                   f"scored: {', '.join(scene.unregistered_test)}")
    if train_config.exposure != "on":
        corrected = {}
    _write_tables(out, scores, truths, scene, corrected)
    return {
        **_counts(truths, scene),
        **{f"{model}_{key}": round(getattr(score, key), 4)
           for model, score in scores.items() for key in ("psnr_db", "ssim", "gaussians")},
        **{f"{model}_gain_psnr_db": round(value, 4) for model, value in corrected.items()},
    }


def _truths(scene: Scene, max_size: int) -> list[_Truth]:
    if not scene.test:
        raise ReconstructionError(
            f"No held-out view has a camera ({len(scene.unregistered_test)} were held out).",
            hint="Run `recon ingest` with another --holdout, such as every:8.")
    truths = []
    for view in scene.test:
        camera = fitted_camera(view.camera, max_size)
        if min(camera.width, camera.height) < MIN_SIDE:
            raise ConfigError(
                f"Views of {camera.width}x{camera.height} pixels are too small to score; SSIM "
                f"needs {MIN_SIDE} pixels a side.",
                hint="Run `recon eval` with a larger --max-size.")
        image, mask = read_masked_image(view.original, view.mask, camera.width, camera.height)
        truths.append(_Truth(view.name, camera, image, mask))
    return truths


def _scorable(truths: Sequence[_Truth], ctx: StageContext) -> list[_Truth]:
    """Returns the views of which a mask leaves enough to score, and names the others."""
    kept = [truth for truth in truths if truth.mask is None or leaves_enough(truth.mask)]
    notice_hidden([truth.name for truth in truths if truth not in kept], "not scored", ctx)
    if not kept:
        raise ReconstructionError(
            f"The masks leave nothing to score of {len(truths)} held-out views.", hint=MASK_HINT)
    return kept


def _score(
    model: str, folder: Path, truths: Sequence[_Truth], sh_degree: int, out: Path,
    ctx: StageContext, bar: Bar,
) -> tuple[ModelScore, float]:
    """Renders every view of one model and saves the pictures.

    Returns:
        Its scores, and its mean PSNR after the best gain per channel of each view: a model with
        exposures shows the mean one, and cannot know that of a view that it was not trained on.
    """
    path = folder / "splats.ply"
    splats = read_ply(path).map(lambda tensor: tensor.to(ctx.device))
    views, milliseconds, corrected = [], [], []
    for truth in truths:
        image, elapsed = _timed_render(splats, truth.camera, sh_degree, ctx)
        milliseconds.append(elapsed)
        views.append(_view_score(truth, image))
        corrected.append(corrected_psnr(image, truth.image, truth.mask))
        name = f"{Path(truth.name).stem}.png"
        shown = eight_bit(image)
        _save(out / "renders" / model / name, shown)
        difference = np.abs(shown.astype(np.int16) - truth.image) * _GAIN
        if truth.mask is not None:
            difference[~truth.mask] = 0
        _save(out / "difference" / model / name, difference.clip(0, 255).astype(np.uint8))
        bar.advance()
    score = ModelScore(
        _LABELS[model], tuple(views), len(splats), path.stat().st_size,
        statistics.median(milliseconds), seconds_at(folder / LOG, _EVER))
    return score, statistics.fmean(corrected)


def _view_score(truth: _Truth, image: NDArray[np.float32]) -> ViewScore:
    return ViewScore(
        truth.name, psnr(image, truth.image, truth.mask), ssim(image, truth.image, truth.mask),
        None if truth.mask is None else float(truth.mask.mean()))


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


def _save(path: Path, image: NDArray[np.uint8]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, image)


def _write_tables(
    out: Path, scores: dict[str, ModelScore], truths: Sequence[_Truth], scene: Scene,
    corrected: dict[str, float],
) -> None:
    write_json(out / "metrics.json", {
        "models": {
            model: {
                "psnr_db": score.psnr_db, "ssim": score.ssim, "gaussians": score.gaussians,
                "bytes": score.bytes, "render_ms": score.render_ms,
                "train_seconds": score.train_seconds,
                **({"gain_psnr_db": corrected[model]} if corrected else {}),
                "views": [{key: value for key, value in vars(view).items() if value is not None}
                          for view in score.views],
            } for model, score in scores.items()
        },
        "psnr_convention": PSNR_CONVENTION, "ssim_convention": SSIM_CONVENTION,
        **({"mask_convention": MASK_CONVENTION} if _masked(truths) else {}),
        **size_summary([truth.camera for truth in truths]), **_counts(truths, scene),
    })
    table, note = list(scores.values()), _note(truths, scene)
    for model, value in corrected.items():
        note += f"{_LABELS[model]}, after the best gain per channel of each view: {value:.2f} dB\n"
    write_bytes(out / "table.txt", f"{text_table(table)}\n{note}".encode())
    write_bytes(out / "metrics.md", f"{markdown_table(table)}\n{note}".encode())
    write_bytes(out / "metrics.csv", csv_table(scores).encode())


def _masked(truths: Sequence[_Truth]) -> int:
    """Returns the number of views with a mask."""
    return sum(truth.mask is not None for truth in truths)


def _counts(truths: Sequence[_Truth], scene: Scene) -> Summary:
    """Returns how many views are scored, and the names of those that are not."""
    hidden = {view.name for view in scene.test} - {truth.name for truth in truths}
    return {
        "test_views": len(truths), "unregistered_test": list(scene.unregistered_test),
        **({"masked_out_test": sorted(hidden)} if hidden else {}),
    }


def _note(truths: Sequence[_Truth], scene: Scene) -> str:
    """Returns what the figures of the tables mean."""
    sizes = " and ".join(
        f"{width}x{height}" for width, height in sizes_of([truth.camera for truth in truths]))
    note = (f"{len(truths)} held-out views at {sizes}, "
            f"{len(scene.unregistered_test)} more without a camera\n"
            f"PSNR: {PSNR_CONVENTION}\nSSIM: {SSIM_CONVENTION}\n")
    if masked := _masked(truths):
        note += f"Masks on {masked} of {len(truths)} views: {MASK_CONVENTION}\n"
    return note
