"""Whether an imported scene lies where the cameras of the workspace look.

A scene in another frame renders without complaint, and every figure behind it is wrong. So some
training views are rendered and held against their pictures, and against what a flat picture in
their mean colour gets.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from recon_cli.context import StageContext
from recon_cli.errors import FormatError, ReconstructionError
from recon_cli.evaluation.metrics import psnr
from recon_cli.evaluation.reference_views import (
    ReferenceView,
    evenly_spread,
    load_reference_views,
    mean_psnr,
)
from recon_cli.scene.scene import Scene
from recon_cli.scene.similarity import Similarity
from recon_cli.scene.splats import Splats, transformed
from recon_cli.workspace.summaries import WorldSummary

SOURCE, WORKSPACE = "source", "workspace"
_VIEWS = 6  # rendered in each frame, at most
# dB above flat pictures. Three scenes in place got 15 to 24; turned by 3 degrees or a tenth too
# large 2.5 to 9, and further off less than 2. docs/import.md
_DOUBTFUL, _EVIDENT = 8.0, 2.0


@dataclass(frozen=True, eq=False)
class Match:
    """What the views say of a scene in one frame or several.

    Attributes:
        frame: that is taken.
        similarity: from the file to the workspace.
        psnr_db: on the views, by frame that was tried.
        flat_db: of flat pictures in the mean colours of the views.
        views: how many.
    """

    frame: str
    similarity: Similarity
    psnr_db: Mapping[str, float]
    flat_db: float
    views: int

    @property
    def doubt(self) -> str:
        """What speaks against the frame, as a sentence; empty where nothing does."""
        above = self.psnr_db[self.frame] - self.flat_db
        if not above >= _EVIDENT:  # a NaN too
            return (f"the imported scene does not show what the views show: {self}. It lies in "
                    "another frame than the cameras, and no score of it means anything")
        if above < _DOUBTFUL:
            return (f"the imported scene hardly shows what the views show: {self}. It is a poor "
                    "one, or its frame differs a little from that of the cameras")
        return ""

    def __str__(self) -> str:
        tried = ", ".join(f"{value:.1f} dB in the frame of the {name}"
                          for name, value in self.psnr_db.items())
        return (f"{tried} on {self.views} training views; flat pictures in their mean colours get "
                f"{self.flat_db:.1f} dB")


def world_of(sfm: Path) -> Similarity:
    """Returns the similarity from the world of the capture's cameras to that of the workspace.

    Args:
        sfm: finished folder of the stage.

    Raises:
        FormatError: its record is damaged.
    """
    world = WorldSummary.read(sfm)
    try:
        return Similarity.from_json(world.similarity) if world else Similarity()
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(
            f"{sfm / WorldSummary.FILE} holds no similarity: {error}.",
            hint="Run `recon sfm --again`.") from error


def match(
    splats: Splats, scene: Scene, world: Similarity, frame: str, max_size: int, ctx: StageContext
) -> Match:
    """Returns in which frame a scene fits the training views, and how well.

    Args:
        splats: as they lie in the file.
        scene: the views of the workspace.
        world: from the frame of the source to that of the workspace.
        frame: source, workspace, or auto for the one that shows the views better.
        max_size: longest side of the pictures in pixels.
        ctx: backend and device.

    Raises:
        ConfigError: the views are too small to score.
        ReconstructionError: no training view is left to look at.
    """
    frames = {WORKSPACE: Similarity(), SOURCE: world}
    if frame != "auto":
        frames = {frame: frames[frame]}
    elif world.is_identity:
        del frames[SOURCE]
    views = load_reference_views(evenly_spread(scene.train, _VIEWS), max_size)
    if not views:
        raise ReconstructionError(
            "There is no training view to hold the imported scene against: none has a camera, or "
            "masks leave nothing of them.",
            hint="Run `recon ingest` with other images or masks, then `recon sfm`.")
    found = {}
    for name, similarity in frames.items():
        there = transformed(splats, similarity).map(lambda tensor: tensor.to(ctx.device))
        found[name] = mean_psnr(there, views, there.sh_degree, ctx.backend)
    best = max(found, key=lambda name: found[name])
    return Match(
        best, frames[best], found, statistics.fmean(map(_flat_psnr, views)), len(views))


def _flat_psnr(view: ReferenceView) -> float:
    """Returns the PSNR of a picture in the view's mean colour."""
    counted = view.image.reshape(-1, 3) if view.mask is None else view.image[view.mask]
    flat = np.broadcast_to(
        (counted.mean(axis=0) / 255).astype(np.float32), view.image.shape)
    return psnr(flat, view.image, view.mask)
