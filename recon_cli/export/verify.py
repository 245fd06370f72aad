"""What a file of Gaussians loses against the scene that it was made of, on views of that scene."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

from recon_cli.context import StageContext
from recon_cli.errors import ReconstructionError
from recon_cli.evaluation.reference_views import (
    MASK_HINT,
    ReferenceView,
    evenly_spread,
    load_reference_views,
    mean_psnr,
)
from recon_cli.scene.scene import Scene
from recon_cli.scene.similarity import Similarity
from recon_cli.scene.splats import Splats

_VIEWS = 8  # rendered for each file, at most


@dataclass(frozen=True, eq=False)
class Fidelity:
    """Views that a scene and its files are held against. Test views are none of them.

    Attributes:
        views: with cameras in the world of the files.
        ctx: backend and device.
    """

    views: Sequence[ReferenceView]
    ctx: StageContext

    def described(self) -> str:
        """Returns what is looked at, as part of a sentence."""
        return f"{len(self.views)} views"

    def psnr_db(self, splats: Splats) -> float:
        """Returns the mean PSNR of a scene over the views in dB."""
        there = splats.map(lambda tensor: tensor.to(self.ctx.device))
        return mean_psnr(there, self.views, there.sh_degree, self.ctx.backend)


def fidelity(
    scene: Scene, similarity: Similarity, max_size: int, ctx: StageContext
) -> Fidelity:
    """Returns the validation views, or some training views where there are none.

    Args:
        scene: the views in the world of the training.
        similarity: from there to the world of the files.
        max_size: longest side of the pictures in pixels.
        ctx: backend and device.

    Raises:
        ReconstructionError: masks leave nothing of any of them.
    """
    chosen = evenly_spread(scene.validation or scene.train, _VIEWS)
    views = [dataclasses.replace(view, camera=similarity.camera(view.camera))
             for view in load_reference_views(chosen, max_size)]
    if not views:
        raise ReconstructionError(
            f"The masks leave nothing of {len(chosen)} views to check the export on.",
            hint=MASK_HINT)
    return Fidelity(views, ctx)
