"""Reads the trained scene of a workspace: a model, its views, and the facts on the world."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon_cli.context import StageInputs
from recon_cli.errors import ManifestError, StageError, name_command
from recon_cli.export.synthetic_cameras import synthetic_scene
from recon_cli.io.training_scene import load_scene
from recon_cli.pipeline import plan
from recon_cli.pipeline.execute import Job
from recon_cli.pipeline.freshness import WorkspaceCheck
from recon_cli.scene.gravity import find_gravity, mean_up
from recon_cli.scene.scene import Scene
from recon_cli.scene.splats import Splats
from recon_cli.splats.ply import read_ply
from recon_cli.train.fit.train_data import read_config
from recon_cli.trust.scene_trust import digest_of
from recon_cli.workspace.manifest import Manifest
from recon_cli.workspace.records import ImportRecord, need_views
from recon_cli.workspace.summaries import PlaceSummary

_NEEDS = ("ingest", "train", "place")  # training runs place first where that is missing too

logger = logging.getLogger("recon")


@dataclass(frozen=True, eq=False)
class TrainedScene:
    """The trained scene of a workspace."""

    model: str  # base or pruned
    splats: Splats  # on the CPU
    digest: str  # SHA-256 of their parameters
    sh_degree: int  # of the training
    max_size: int  # longest side of a training image in pixels, at which `recon eval` scores
    scene: Scene
    z_up: bool  # the world's z axis is known to be up
    metres: bool  # one world unit is a metre
    # [3], of an import without views: those of `scene` are synthetic
    assumed_up: NDArray[np.float64] | None = None

    @property
    def has_views(self) -> bool:
        """Whether the views of `scene` are those of a capture."""
        return self.assumed_up is None

    def up(self) -> NDArray[np.float64]:
        """Returns the unit vector [3] that is up; if unknown the cameras' mean, with a warning."""
        if self.z_up:
            return np.array([0.0, 0.0, 1.0])
        if self.assumed_up is not None:
            return self.assumed_up
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
    manifests = plan.require(inspection, needs, verb)
    if viewless and model == "pruned":
        raise StageError(
            "This workspace has no compact (pruned) model: a scene without views cannot be pruned.",
            hint=need_views())
    pruned = not viewless and _use_pruned(inspection, model, verb)
    config = read_config(folder("train"))
    splats = read_ply(folder("prune" if pruned else "train") / "splats.ply")
    if origin is not None and viewless:
        scene = synthetic_scene(splats, up=origin.up(), max_size=config.max_size)
        z_up, metres = origin.z_up, False
    else:
        inputs = StageInputs({name: folder(name) for name in _NEEDS})
        scene = load_scene(inputs.folders, validation=config.validation)
        z_up, metres = _read_world(manifests["place"])
    return TrainedScene(
        "pruned" if pruned else "base", splats, digest_of(splats), config.sh_degree,
        config.max_size, scene, z_up, metres,
        assumed_up=origin.up() if origin is not None and viewless else None)


def _read_world(place: Manifest) -> tuple[bool, bool]:
    """Returns whether z is up and a unit is a metre; no, where another version's record differs."""
    try:
        evidence = PlaceSummary.from_json(place.run.summary).world.evidence
    except ManifestError:
        return False, False
    return evidence.up_found, evidence.metres


def _use_pruned(inspection: WorkspaceCheck, model: str, verb: str) -> bool:
    check = inspection.check("prune")
    if model == "pruned" and not check.usable:
        raise StageError(
            f"{verb} needs the compact (pruned) model, which is {check.describe()}.",
            hint=f"Run {name_command('prune')} first, or {name_command(f'{verb} --model base')}.")
    if model == "auto" and check.manifest and not check.usable:
        logger.warning("the compact (pruned) model is not used: it is %s", check.describe())
    return check.usable and model != "base"
