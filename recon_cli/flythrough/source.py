"""What is rendered: the model of a workspace, its views, and what is known of the world."""

from __future__ import annotations

import hashlib
import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon_cli.context import StageInputs
from recon_cli.errors import StageError
from recon_cli.evaluation.reference_views import load_scene
from recon_cli.export.synthetic_cameras import HINT, made_up_scene
from recon_cli.io.import_record import Origin
from recon_cli.io.ply import read_ply
from recon_cli.pipeline import plan
from recon_cli.pipeline.execute import Job
from recon_cli.pipeline.freshness import Inspection
from recon_cli.scene.gravity import camera_up, find_gravity
from recon_cli.scene.scene import Scene
from recon_cli.scene.splats import Splats
from recon_cli.train.runner import read_config
from recon_cli.workspace.manifest import Manifest
from recon_cli.workspace.summaries import SfmSummary

_NEEDS = ("ingest", "train", "sfm")  # training runs sfm first where that is missing too

logger = logging.getLogger("recon")


@dataclass(frozen=True, eq=False)
class Source:
    """A trained scene.

    Attributes:
        model: base or pruned.
        splats: its Gaussians, on the CPU.
        digest: SHA-256 of their parameters.
        sh_degree: that it was trained with.
        max_size: longest side of a training image in pixels; what `recon eval` renders at.
        scene: views and points.
        z_up: the world's z axis is known to be up.
        metres: one world unit is a metre.
        has_views: False where an imported scene came without; those of `scene` are made up then.
    """

    model: str
    splats: Splats
    digest: str
    sh_degree: int
    max_size: int
    scene: Scene
    z_up: bool
    metres: bool
    has_views: bool = True

    def up(self) -> NDArray[np.float64]:
        """Returns the unit vector [3] that is up, at worst that of the cameras, with a warning."""
        if self.z_up:
            return np.array([0.0, 0.0, 1.0])
        if not self.has_views:
            return np.array([0.0, -1.0, 0.0])
        viewmats = np.stack([view.camera.viewmat for view in self.scene.train])
        found = find_gravity(self.scene.points, viewmats)
        if found.up is not None:
            return found.up
        logger.warning("up is not known, so the mean up of the cameras is taken: %s", found.reason)
        return camera_up(viewmats).up


def open_source(job: Job, model: str, *, verb: str = "render") -> Source:
    """Returns the trained scene of a workspace.

    Args:
        job: whose workspace it is.
        model: auto, base or pruned; auto takes the pruned one where there is a fresh one.
        verb: that asks, for messages.

    Raises:
        StageError: there is no such model that is fresh.
        FormatError: a file of the workspace is damaged.
    """
    look = job.inspect()
    origin = Origin.of(job.workspace.folder("train"))
    if origin and not origin.views:
        _fresh(look, "train", verb)
        return _viewless(job, model, origin)
    manifests = {name: _fresh(look, name, verb) for name in _NEEDS}
    pruned = _take_pruned(look, model, verb)
    folders = {name: job.workspace.folder(name) for name in _NEEDS}
    config = read_config(folders["train"])
    splats = read_ply(job.workspace.folder("prune" if pruned else "train") / "splats.ply")
    world = SfmSummary.from_json(manifests["sfm"].run.summary).world
    return Source(
        "pruned" if pruned else "base", splats, _digest(splats), config.sh_degree, config.max_size,
        load_scene(StageInputs(folders), validation=config.validation),
        world.evidence.up_found, world.evidence.metres)


def _viewless(job: Job, model: str, origin: Origin) -> Source:
    """Returns an imported scene with made-up cameras."""
    if model == "pruned":
        raise StageError(
            "The pruned model was asked for, but a scene without views cannot be pruned.",
            hint=HINT)
    folder = job.workspace.folder("train")
    config, splats = read_config(folder), read_ply(folder / "splats.ply")
    return Source(
        "base", splats, _digest(splats), config.sh_degree, config.max_size,
        made_up_scene(splats, z_up=origin.z_up, max_size=config.max_size), origin.z_up, False,
        has_views=False)


def _fresh(look: Inspection, name: str, verb: str) -> Manifest:
    check = look.check(name)
    if check.manifest is None or not check.fresh:
        raise StageError(
            f"{verb} needs {name}, which is {check.described()}.",
            hint=f"Run `{plan.command(look, check)}` first.")
    return check.manifest


def _take_pruned(look: Inspection, model: str, verb: str) -> bool:
    check = look.check("prune")
    if model == "pruned" and not check.fresh:
        raise StageError(
            f"The pruned model was asked for, but it is {check.described()}.",
            hint=f"Run `recon prune` first, or `recon {verb} --model base`.")
    if model == "auto" and check.manifest and not check.fresh:
        logger.warning("the pruned model is left out: it is %s", check.described())
    return check.fresh and model != "base"


def _digest(splats: Splats) -> str:
    """Returns the digest of what was read; the file itself may have been replaced since."""
    digest = hashlib.sha256()
    for name, value in splats.parameters().items():
        digest.update(f"{name}{tuple(value.shape)}".encode())
        digest.update(value.numpy().tobytes())
    return digest.hexdigest()
