"""What an export cleans away where it is asked to: floaters and islands. docs/cleanup.md."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import torch
from torch import Tensor

from recon_cli.errors import ConfigError
from recon_cli.scene.scene import Scene
from recon_cli.scene.similarity import Similarity
from recon_cli.scene.splats import Splats
from recon_cli.stages.context import StageContext
from recon_cli.train.floaters import floaters, sightings
from recon_cli.train.islands import islands
from recon_cli.train.step import TrainView

logger = logging.getLogger("recon")


def without_floaters(splats: Splats, views: Sequence[TrainView], ctx: StageContext) -> Splats:
    """Returns a scene without what hangs in the air, and says how much of which kind goes.

    Args:
        splats: the scene, on the CPU.
        views: training views with cameras in its world.
        ctx: backend, device and progress.

    Raises:
        ConfigError: nothing would be left.
    """
    there = splats.map(lambda tensor: tensor.to(ctx.device))
    with ctx.progress.bar("look for floaters", 3 * len(views), unit="view") as bar:
        found = floaters(there, views, backend=ctx.backend, on_view=bar.advance)
    logger.info(
        "floaters: %d Gaussians that no view shows, %d in front of the few views that show them, "
        "%d that make the views worse", int(found.unseen.sum()), int(found.in_front.sum()),
        int(found.harmful.sum()))
    return _without(splats, found.all, "--drop-floaters")


def without_islands(
    splats: Splats, scene: Scene, similarity: Similarity, views: Sequence[TrainView] | None,
    ctx: StageContext,
) -> Splats:
    """Returns a scene without small groups of Gaussians far from all others.

    Args:
        splats: the scene, on the CPU.
        scene: says how far the room reaches, in the world of the training.
        similarity: from there to the world of `splats`.
        views: training views with cameras in that world; None where there are none.
        ctx: backend and device.
    """
    center = similarity.points(scene.center).tolist()
    near = splats.within(center, similarity.scale * scene.reach)
    seen = None
    if views is not None:
        there = splats.map(lambda tensor: tensor.to(ctx.device))
        seen = sightings(there, views, backend=ctx.backend).cpu() > 0
    return _without(splats, islands(splats, near, seen), "--drop-islands")


def _without(splats: Splats, goes: Tensor, option: str) -> Splats:
    stays = ~goes.cpu()
    if not torch.any(stays):
        raise ConfigError(
            f"{option} would leave nothing of {len(splats):,} Gaussians.",
            hint="Look whether the scene lies where the views look: `recon render --views train`.")
    return splats.select(stays)
