"""Reads the trained scene of a workspace: a model, its views, and the facts on the world."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon_cli.config.stages import RunConfig
from recon_cli.errors import StageError, name_command
from recon_cli.export.synthetic_cameras import synthetic_scene
from recon_cli.io.training_scene import PlacedCapture
from recon_cli.pipeline import plan
from recon_cli.pipeline.execute import Job
from recon_cli.pipeline.freshness import WorkspaceCheck
from recon_cli.scene.gravity import find_gravity, mean_up
from recon_cli.scene.scene import Scene
from recon_cli.scene.splats import Splats
from recon_cli.splats.ply import read_ply
from recon_cli.train.fit.train_data import read_config
from recon_cli.trust.scene_trust import digest_of
from recon_cli.workspace.manifest import SCENE
from recon_cli.workspace.records import FrameList, ImportRecord, need_views

_NEEDS = ("ingest", "train", "place")  # training runs place first where that is missing too

logger = logging.getLogger("recon")


@dataclass(frozen=True, eq=False)
class TrainedScene:
    """The trained scene of a workspace."""

    model: str  # base or pruned
    splats: Splats  # on the CPU
    digest: str  # SHA-256 of their parameters
    config: RunConfig  # of the training
    scene: Scene
    z_up: bool  # the world's z axis is known to be up
    metres: bool  # one world unit is a metre
    imported: ImportRecord | None = None  # of the scene that was imported
    frames: FrameList | None = None  # of ingest; None of an import without views

    @property
    def has_views(self) -> bool:
        """Whether the views of `scene` are those of a capture."""
        return self.imported is None or self.imported.views

    def up(self) -> NDArray[np.float64]:
        """Returns the unit vector [3] that is up; if unknown the cameras' mean, with a warning."""
        if self.z_up:
            return np.array([0.0, 0.0, 1.0])
        if self.imported is not None and not self.imported.views:  # the cameras are synthetic
            return self.imported.up()
        viewmats = np.stack([view.camera.viewmat for view in self.scene.train])
        gravity = find_gravity(self.scene.points, viewmats)
        if gravity.up is not None:
            return gravity.up
        logger.warning("up is not known; the mean up of the cameras is used: %s", gravity.reason)
        return mean_up(viewmats)


def open_trained_scene(job: Job, model: str, *, verb: str = "render") -> TrainedScene:
    """Returns the trained scene of a workspace; StageError if the model is missing or stale.

    `model` is auto (the pruned one if it is not stale), base or pruned; `verb` is for messages.
    """
    inspection, folder = job.inspect(), job.workspace.folder
    origin = ImportRecord.read(folder("train"))
    viewless = origin is not None and not origin.views
    needs = ("train",) if viewless else _NEEDS
    plan.require(inspection, needs, verb)
    if viewless and model == "pruned":
        raise StageError(
            "This workspace has no compact (pruned) model: a scene without views cannot be pruned.",
            hint=need_views())
    pruned = not viewless and _use_pruned(inspection, model, verb)
    config = read_config(folder("train"))
    splats = read_ply(folder("prune" if pruned else "train") / SCENE)
    name, digest = "pruned" if pruned else "base", digest_of(splats)
    if origin is not None and viewless:
        scene = synthetic_scene(splats, up=origin.up(), max_size=config.max_size)
        return TrainedScene(name, splats, digest, config, scene, origin.z_up, False, origin)
    capture = PlacedCapture.read({stage: folder(stage) for stage in _NEEDS})
    return TrainedScene(
        name, splats, digest, config, capture.load_scene(validation=config.validation),
        capture.z_up, capture.world is not None and capture.world.evidence.metres, origin,
        capture.frames)


def _use_pruned(inspection: WorkspaceCheck, model: str, verb: str) -> bool:
    check = inspection.check("prune")
    if model == "pruned" and not check.usable:
        raise StageError(
            f"{verb} needs the compact (pruned) model, which is {check.describe()}.",
            hint=f"Run {name_command('prune')} first, or {name_command(f'{verb} --model base')}.")
    if model == "auto" and check.manifest and not check.usable:
        logger.warning("the compact (pruned) model is not used: it is %s", check.describe())
    return check.usable and model != "base"
