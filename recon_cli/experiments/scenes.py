"""Scenes to train on: workspaces with cameras, and data sets with poses that are made into one."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from recon_cli.config.settings import Settings, build, merge
from recon_cli.config.stages import ComputeConfig, IngestConfig, RunConfig, SfmConfig
from recon_cli.context import StageContext
from recon_cli.datasets.layouts import recognise, refuse_incomplete
from recon_cli.errors import ConfigError, Hint, InputError, ReconstructionError
from recon_cli.evaluation.reference_views import load_reference_views
from recon_cli.experiments.variants import TrainingRun
from recon_cli.io.training_scene import PlacedCapture
from recon_cli.io.views import MASK_HINT, ReferenceView
from recon_cli.pipeline import plan
from recon_cli.pipeline.plan import Job, Target
from recon_cli.progress import Progress
from recon_cli.scene.scene import Scene
from recon_cli.train.fit.schedule import Schedule
from recon_cli.train.fit.task import Task
from recon_cli.train.fit.train_data import load_task
from recon_cli.train.parts.table import PARTS, model_parts
from recon_cli.train.plan import choose_parts
from recon_cli.workspace.digests import digest_file
from recon_cli.workspace.json_record import sha256_json
from recon_cli.workspace.layout import Workspace

_READ = ("images", "denoised", "masks", "sparse")  # the inputs of training, below place/undistorted


@dataclass(frozen=True, eq=False)
class SceneFolders:
    """The capture of a scene, and its name in tables and files."""

    name: str
    capture: PlacedCapture

    @cached_property
    def digest(self) -> str:
        """Digest of the scene's images, masks, cameras and split, not of its name."""
        undistorted = self.capture.place / "undistorted"
        files = [path for part in _READ for path in sorted((undistorted / part).rglob("*"))
                 if path.is_file()]
        return sha256_json({
            "files": {str(path.relative_to(undistorted)): digest_file(path).sha256
                      for path in files},
            "held_out": sorted(self.capture.frames.held_out)})


def check_scenes(paths: Sequence[Path]) -> dict[str, Path]:
    """Returns the paths by the names of their scenes.

    Raises:
        ConfigError: there is none, or two have the same name.
        InputError: a path is neither a workspace nor a data set with poses.
        StageError: a workspace has no fresh cameras.
    """
    if not paths:
        raise ConfigError(
            "No scene was given.",
            hint="Give workspaces with cameras or data sets with poses after --scenes.")
    scenes: dict[str, Path] = {}
    for path in paths:
        name = Path(os.path.abspath(path)).name  # a link has the name of the scene, not its target
        if name in scenes:
            raise ConfigError(
                f"{scenes[name]} and {path} are both called {name}.",
                hint="Rename one of the folders: tables tell scenes apart by their names.")
        scenes[name] = path
        if Workspace(path).holds_results:
            plan.require(
                Job(Workspace(path)).inspect(), ("ingest", "place"), f"a scene of {path}",
                fresh=True)
            continue
        if not path.exists():
            raise InputError(f"{path} does not exist.", hint="Check the path.")
        refuse_incomplete(path)
        if recognise(path) is None:
            raise InputError(
                f"{path} is neither a workspace with cameras nor a data set with poses.",
                hint=f"Find its cameras in a workspace, by `recon ingest {path}` and then sfm, "
                     "and give that workspace.")
    return scenes


def open_scene(
    name: str, path: Path, scratch: Path, settings: Settings, compute: ComputeConfig,
    progress: Progress,
) -> SceneFolders:
    """Returns the folders of a workspace, or of a data set that becomes one in `scratch`."""
    workspace = Workspace(path)
    if not workspace.holds_results:
        workspace = Workspace(scratch / name)
        values = merge([settings, {"sfm": {"poses": "keep"}}])
        stages = {part: values[part] for part in ("ingest", "denoise", "sfm")}
        plan.run(Job(workspace, stages, compute, progress), "ingest and sfm", [
            Target("ingest", build(IngestConfig, stages), (path,)),
            *(Target(name, build(SfmConfig, stages)) for name in ("sfm", "place"))])
    return SceneFolders(name, PlacedCapture.read({
        stage: workspace.folder(stage) for stage in ("ingest", "place")}))


@dataclass(frozen=True, eq=False)
class ExperimentScene:
    """A scene in memory, ready to be trained on by any variant."""

    folders: SceneFolders
    scene: Scene
    scored: Sequence[ReferenceView]
    base: RunConfig  # options that all variants share
    ctx: StageContext

    @cached_property
    def parts(self) -> dict[str, Any]:
        """The parts of the model that the scene needs, as `recon train` finds them by trials."""
        task = self._load_task(self.base)
        return model_parts(choose_parts(task, self.scene, self.ctx, harmonics=True).config)

    def release(self) -> None:
        """Frees the training images; the next task reads them again."""
        self.__dict__.pop("_tasks", None)

    def task(self, run: TrainingRun) -> Task:
        """Returns the task of a run, without validation views: training uses only what it fits."""
        config = run.config
        undecided = [part.name for part in PARTS if getattr(config, part.name) == "auto"]
        undecided += ["sh_degree"] if run.variant.tries_degree else []
        if undecided:  # `parts` may take trials
            config = dataclasses.replace(config, **{name: self.parts[name] for name in undecided})
        return dataclasses.replace(
            self._load_task(config), validation=[], schedule=Schedule(config))

    def _load_task(self, config: RunConfig) -> Task:
        images = "denoised" if config.images == "denoised" else "original"
        if images not in self._tasks:
            self._tasks[images] = load_task(self.scene, config, self.ctx)
        return dataclasses.replace(self._tasks[images], schedule=Schedule(config))

    @cached_property
    def _tasks(self) -> dict[str, Task]:
        return {}


def load_for_training(
    folders: SceneFolders, split: str, base: RunConfig, ctx: StageContext
) -> ExperimentScene:
    """Returns a scene with the views to score in memory, those of `split`: test or validation.

    Raises:
        ReconstructionError: no held-out view has a camera.
        ConfigError: there are no validation views, the views are too small, or masks leave none.
    """
    scene = folders.capture.load_scene(validation=base.validation)
    if split == "test" and not scene.test:
        raise ReconstructionError(
            f"No held-out view of {folders.name} has a camera.",
            hint=Hint("ingest", then=" with a --holdout such as every:8"))
    if split == "validation" and not scene.validation:
        raise ConfigError(
            f"{folders.name} has no validation views.",
            hint="Use --set train.validation=0.1, or give a scene with more views.")
    views = load_reference_views(
        scene.test if split == "test" else scene.validation, base.max_size, ctx)
    if not views:
        raise ConfigError(f"The masks of {folders.name} leave no view to score.", hint=MASK_HINT)
    return ExperimentScene(folders, scene, views, base, ctx)
