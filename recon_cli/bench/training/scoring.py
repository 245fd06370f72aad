"""Scores of a model on views: what `recon eval` computes, without its pictures."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from recon_cli.errors import ConfigError
from recon_cli.io.images import fitted_camera, read_masked_image
from recon_cli.io.ply import read_ply, write_ply
from recon_cli.metrics import MIN_SIDE, leaves_enough, psnr, ssim
from recon_cli.render import render
from recon_cli.scene.scene import View
from recon_cli.scene.splats import Splats
from recon_cli.stages.context import StageContext
from recon_cli.stages.fitting import notice_hidden
from recon_cli.train.step import TrainView


@dataclass(frozen=True)
class Score:
    """How good and how large a model is.

    Attributes:
        psnr_db: mean over the views.
        ssim: mean over the views.
        gaussians: count.
        bytes: of its .ply.
    """

    psnr_db: float
    ssim: float
    gaussians: int
    bytes: int


def load_scored(views: Sequence[View], max_size: int, ctx: StageContext) -> list[TrainView]:
    """Returns views with their original pixels; those that a mask hides are named and left out.

    Raises:
        ConfigError: they are smaller than the window of SSIM.
    """
    loaded, hidden = [], []
    for view in views:
        camera = fitted_camera(view.camera, max_size)
        if min(camera.width, camera.height) < MIN_SIDE:
            raise ConfigError(
                f"Views of {camera.width}x{camera.height} pixels are too small to score; SSIM "
                f"needs {MIN_SIDE} pixels a side.", hint="Give a larger --max-size.")
        image, mask = read_masked_image(view.original, view.mask, camera.width, camera.height)
        if mask is None or leaves_enough(mask):
            loaded.append(TrainView(camera, image, mask))
        else:
            hidden.append(view.name)
    notice_hidden(hidden, "not scored", ctx)
    return loaded


def score(splats: Splats, views: Sequence[TrainView], sh_degree: int, ctx: StageContext) -> Score:
    """Returns the scores of a model as its .ply holds it.

    Args:
        splats: the model.
        views: to score.
        sh_degree: in use.
        ctx: backend and device.
    """
    with tempfile.TemporaryDirectory(prefix="recon-score-") as folder:
        path = Path(folder) / "splats.ply"
        write_ply(path, splats)
        size = path.stat().st_size
        written = read_ply(path).map(lambda tensor: tensor.to(ctx.device))
    background = torch.zeros(3, device=ctx.device)
    pairs = []
    for view in views:
        with torch.no_grad():
            image = render(
                written, view.camera, background, sh_degree, backend=ctx.backend).rgb.cpu().numpy()
        pairs.append((psnr(image, view.image, view.mask), ssim(image, view.image, view.mask)))
    mean = np.mean(pairs, axis=0)
    return Score(float(mean[0]), float(mean[1]), len(splats), size)
