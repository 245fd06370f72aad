"""Alignment of an imported scene with the cameras of the workspace.

A scene in another frame renders without complaint, and all its scores are wrong. So some training
views are rendered and compared with their images, and with flat images in their mean colours.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from recon_cli.context import StageContext
from recon_cli.errors import ReconstructionError, name_command
from recon_cli.evaluation.metrics import psnr
from recon_cli.evaluation.reference_views import load_reference_views, mean_psnr
from recon_cli.io.views import ReferenceView, evenly_spread
from recon_cli.scene.scene import Scene
from recon_cli.scene.similarity import Similarity
from recon_cli.scene.splats import Splats, transformed

SOURCE, WORKSPACE = "source", "workspace"
_VIEWS = 6  # rendered in each frame, at most
# dB above flat pictures: three scenes got 15 to 24 in place, 2.5 to 9 if turned by 3 degrees or a
# tenth too large, and less than 2 if further off. tests/bench/bench_import_frames.py
_EVIDENCE_DB = (2.0, 8.0)


@dataclass(frozen=True, eq=False)
class Alignment:
    """How well a scene fits the training views, in one or several candidate frames."""

    frame: str  # that was chosen
    similarity: Similarity  # from the file to the workspace
    psnr_db: Mapping[str, float]  # on the views, by frame that was tried
    flat_db: float  # of flat images in the mean colours of the views
    views: int  # count

    @property
    def doubt(self) -> str:
        """Why the frame may be wrong, as a sentence; empty if it fits."""
        above = self.psnr_db[self.frame] - self.flat_db
        if not above >= _EVIDENCE_DB[0]:  # a NaN too
            return (f"the imported scene does not match the views: {self}. It is in "
                    "another frame than the cameras, and its scores mean nothing")
        if above < _EVIDENCE_DB[1]:
            return (f"the imported scene hardly matches the views: {self}. It is a poor "
                    "one, or its frame differs a little from that of the cameras")
        return ""

    def __str__(self) -> str:
        tried = ", ".join(f"{value:.1f} dB in the frame of the {name}"
                          for name, value in self.psnr_db.items())
        return (f"{tried} on {self.views} training views; flat images in their mean colours get "
                f"{self.flat_db:.1f} dB")


def align_to_views(
    splats: Splats, scene: Scene, world: Similarity, frame: str, max_size: int, ctx: StageContext,
    *, moved: Similarity | None = None,
) -> Alignment:
    """Returns the frame in which a scene fits the training views best, and how well.

    `world` leads from the frame of the source to that of the workspace; `frame` is one of these, or
    auto. `max_size` is the longest side of the images in pixels; `moved` leads from the splats to
    the file, if they were moved. ReconstructionError if no view can be compared.
    """
    frames = {WORKSPACE: Similarity(), SOURCE: world}
    if frame != "auto":
        frames = {frame: frames[frame]}
    elif world.is_identity:
        del frames[SOURCE]
    views = load_reference_views(evenly_spread(scene.train, _VIEWS), max_size)
    if not views:
        raise ReconstructionError(
            "There is no training view to compare the imported scene with: none has a camera, or "
            "masks leave nothing of them.",
            hint=f"Run {name_command('ingest')} with other images or masks, then "
            f"{name_command('sfm')}.")
    psnr_db = {}
    for name, similarity in frames.items():
        there = transformed(splats, similarity.after(moved or Similarity())).map(
            lambda tensor: tensor.to(ctx.device))
        psnr_db[name] = mean_psnr(there, views, there.sh_degree, ctx.backend)
    best = max(psnr_db, key=lambda name: psnr_db[name])
    return Alignment(
        best, frames[best], psnr_db, statistics.fmean(map(_flat_psnr, views)), len(views))


def _flat_psnr(view: ReferenceView) -> float:
    """Returns the PSNR of an image in the view's mean colour."""
    pixels = view.image.reshape(-1, 3) if view.mask is None else view.image[view.mask]
    flat = np.broadcast_to((pixels.mean(axis=0) / 255).astype(np.float32), view.image.shape)
    return psnr(flat, view.image, view.mask)
