"""What `recon eval` finds out about trust: measured, checked, drawn, and where to film next."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.config.stages import RunConfig
from recon_cli.context import StageContext
from recon_cli.evaluation.reference_views import ReferenceView
from recon_cli.io.images import write_png
from recon_cli.io.ply import read_ply
from recon_cli.io.records import ImportRecord
from recon_cli.scene.gravity import find_gravity
from recon_cli.scene.scene import Scene
from recon_cli.scene.splats import Splats
from recon_cli.trust.film_next import MAX_PLACES, Suggestion, suggest
from recon_cli.trust.heat_map import heat_colors
from recon_cli.trust.scene_trust import (
    FOLDER,
    Trust,
    TrustRecord,
    measure_trust,
    model_trust,
    views_looked_at,
    why_none,
)
from recon_cli.trust.standing_places import StandingPlaces, find_places
from recon_cli.workspace.summaries import WorldSummary


@dataclass(frozen=True, eq=False)
class TrustTask:
    """What is assessed, and on which views."""

    model: str  # base, or pruned where that is what export takes
    folder: Path  # of its stage
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
        splats = read_ply(task.folder / "splats.ply").map(lambda tensor: tensor.to(ctx.device))
        trust = measure_trust(splats, task.scene, task.config, task.max_size, ctx, bar.advance)
        trust.save(out, task.model)
        assessed = model_trust(
            trust, splats, task.held_out, gains=task.config.exposure == "on",
            backend=ctx.backend, on_view=_saver(out / FOLDER / task.model, bar.advance))
        suggestions, no_places = film_next(splats, trust, task.scene, task.world, ctx)
    record = TrustRecord(
        models=(task.model,), base=assessed if task.model == "base" else None,
        pruned=assessed if task.model == "pruned" else None, metres=metres,
        film_next=tuple(suggestions), no_places=no_places)
    record.write(out)
    return record


def _saver(
    folder: Path, advance: Callable[[], None]
) -> Callable[[ReferenceView, NDArray[np.float32]], None]:
    """Returns what writes the heat map of a view."""
    folder.mkdir(exist_ok=True)

    def save(view: ReferenceView, expected: NDArray[np.float32]) -> None:
        write_png(folder / f"{Path(view.name).stem}.png", heat_colors(expected))
        advance()

    return save


def film_next(
    splats: Splats, trust: Trust, scene: Scene, world: WorldSummary | None, ctx: StageContext
) -> tuple[list[Suggestion], str]:
    """Returns where to film next, or none and why."""
    places, reason = standing_places(splats, trust, scene, world)
    if places is None:
        return [], reason
    suggestions = suggest(splats, trust.support, trust.error, places,
                          (*scene.train, *scene.validation), backend=ctx.backend)
    return suggestions, "" if suggestions else (
        "no place is suggested, as every free one looks at something too near")


def standing_places(
    splats: Splats, trust: Trust, scene: Scene, world: WorldSummary | None
) -> tuple[StandingPlaces | None, str]:
    """Returns where somebody could stand, or None and why."""
    views = (*scene.train, *scene.validation)
    gravity = find_gravity(scene.points, np.stack([view.camera.viewmat for view in views]))
    up, floor = gravity.up, gravity.floor.height if gravity.floor else None
    if world is not None and world.evidence.up_found:
        up = np.array([0.0, 0.0, 1.0])
        floor = 0.0 if world.evidence.floor_found else floor
    if up is None:
        return None, f"no place is suggested, as up is not known: {gravity.reason}"
    cameras = np.stack([view.camera.center for view in views])
    places = find_places(splats, trust.support, up, floor, cameras, most=MAX_PLACES)
    if not len(places.eyes):
        return None, "no place is suggested, as no free standing place was found near the cameras"
    return places, ""
