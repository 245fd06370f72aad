"""The trust of a trained scene: as `recon eval` left it, or measured now."""

from __future__ import annotations

import logging

from recon_cli.context import StageContext
from recon_cli.errors import name_command
from recon_cli.evaluation.reference_views import RenderedModel
from recon_cli.flythrough.trained_scene import TrainedScene
from recon_cli.pipeline.execute import Job
from recon_cli.trust.scene_trust import Trust, measure_trust, refuse_without, views_looked_at

logger = logging.getLogger("recon")


def load_trust(job: Job, trained: TrainedScene, ctx: StageContext) -> Trust:
    """Returns the trust of the model that was opened, on the device of `ctx`.

    StageError for an imported scene without views, or whose views do not fit.
    """
    refuse_without(trained.imported)
    trust, config = None, trained.config
    if job.inspect().check("evaluate").fresh:
        trust = Trust.load(job.workspace.folder("evaluate"), trained.model, trained.digest,
                           config.sh_degree)
    splats = trained.splats.map(lambda tensor: tensor.to(ctx.device))
    if trust is None:
        logger.info(
            "trust is measured on the training views now; %s keeps it", name_command("eval"))
        with ctx.progress.bar("trust", views_looked_at(trained.scene), unit="view") as bar:
            trust = measure_trust(
                RenderedModel(splats, config.sh_degree, ctx.backend), trained.scene, config,
                config.max_size, ctx, bar.advance)
    return Trust(trust.support.to(splats.means.device), trust.error, trust.sh_degree)
