"""Trust in `recon eval`: measured, checked and drawn, with the poorly seen regions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.config.stages import RunConfig
from recon_cli.context import StageContext
from recon_cli.evaluation.reference_views import RenderedModel
from recon_cli.io.images import write_png
from recon_cli.io.views import ReferenceView, evenly_spread
from recon_cli.scene.scene import Scene
from recon_cli.trust.heat_map import heat_colors
from recon_cli.trust.poorly_seen import find_poorly_seen
from recon_cli.trust.records import FOLDER, TrustRecord
from recon_cli.trust.scene_trust import (
    measure_trust,
    model_trust,
    views_looked_at,
    why_none,
)
from recon_cli.trust.support import MAX_VIEWS
from recon_cli.trust.surface import find_cells, surface_shares
from recon_cli.workspace.records import ImportRecord
from recon_cli.workspace.summaries import WorldSummary


@dataclass(frozen=True, eq=False)
class TrustTask:
    """The models to assess, and the views."""

    model: str  # base, or pruned where that is what export takes
    rendered: RenderedModel  # the same, with images that scoring rendered
    config: RunConfig  # of the training
    scene: Scene
    held_out: Sequence[ReferenceView]
    max_size: int  # pixels, of the views that are compared
    import_record: ImportRecord | None
    world: WorldSummary | None


def assess(task: TrustTask, out: Path, ctx: StageContext) -> TrustRecord:
    """Writes trust/ into the folder of evaluate and returns its record."""
    metres = task.world is not None and task.world.evidence.metres
    reason = why_none(task.import_record)
    (out / FOLDER).mkdir(exist_ok=True)
    if reason:
        record = TrustRecord(models=(), reason=reason, metres=metres)
        record.write(out)
        return record
    views = views_looked_at(task.scene) + len(task.held_out)
    with ctx.progress.bar("trust", views, unit="view") as bar:
        trust = measure_trust(
            task.rendered, task.scene, task.config, task.max_size, ctx, bar.advance)
        trust.save(out, task.model)
        cells = find_cells(task.rendered.splats, trust.support)
        assessed = model_trust(
            trust, task.rendered, surface_shares(cells), task.held_out,
            gains=task.config.has_gains,
            on_view=_saver(out / FOLDER / task.model, bar.advance))
    frames = [view.name for view in evenly_spread(task.scene.train, MAX_VIEWS)]
    record = TrustRecord(
        models=(task.model,), base=assessed if task.model == "base" else None,
        pruned=assessed if task.model == "pruned" else None, metres=metres,
        poorly_seen=find_poorly_seen(cells, trust.support, frames))
    record.write(out)
    return record


def _saver(
    folder: Path, advance: Callable[[], None]
) -> Callable[[ReferenceView, NDArray[np.float32]], None]:
    """Returns the function that writes the heat map of a view."""
    folder.mkdir(exist_ok=True)

    def save(view: ReferenceView, expected: NDArray[np.float32]) -> None:
        write_png(folder / f"{Path(view.name).stem}.png", heat_colors(expected))
        advance()

    return save
