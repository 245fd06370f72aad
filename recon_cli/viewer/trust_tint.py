"""The tint of trust in the browser: the error to expect of each Gaussian from where one stands."""

from __future__ import annotations

import threading
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from recon_cli.context import StageContext
from recon_cli.flythrough.model_trust import load_trust
from recon_cli.flythrough.trained_scene import open_trained_scene
from recon_cli.pipeline.execute import Job, render_context
from recon_cli.trust.heat_map import tint
from recon_cli.trust.scene_trust import Trust
from recon_cli.viewer.gaussians import PackedGaussians, finite_rows


class TrustTint:
    """Tints the models of a workspace; those that `recon eval` left out follow on demand."""

    def __init__(self, job: Job) -> None:
        self._job = job
        self._trusts: dict[str, tuple[Trust, NDArray[np.bool_]]] = {}
        self._lock = threading.Lock()

    def prepare(self, model: str) -> None:
        """Loads or measures the trust of a model. StageError where it has none."""
        with self._lock:
            if model in self._trusts:
                return
            trained = open_trained_scene(self._job, model, verb="view")
            ctx: StageContext = render_context(self._job.compute, self._job.progress)
            trust = load_trust(self._job, trained, ctx)
            rows = finite_rows(trained.splats).numpy()
            self._trusts[model] = (Trust(
                trust.support.to(trained.splats.means.device), trust.error, trust.sh_degree), rows)

    def colors(
        self, model: str, packed: PackedGaussians, colors: NDArray[np.uint8], place: Sequence[float]
    ) -> NDArray[np.uint8]:
        """Returns colours [N, 3] tinted by the trust of a prepared model as seen from a place."""
        trust, rows = self._trusts[model]
        if int(rows.sum()) != len(colors) or len(colors) != len(packed.splats):
            return colors  # the model on disk is another one by now
        means = packed.splats.means
        if not rows.all():
            full = means.new_zeros(len(rows), 3)
            full[rows] = means
            means = full
        sight = trust.support.seen_from(means, np.asarray(place, np.float64))
        return tint(colors, trust.expect_gaussians(sight)[rows])
