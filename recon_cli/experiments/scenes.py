"""Scenes to train on: workspaces with cameras, and data sets with poses that are made into one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from recon_cli.config.settings import Settings, build, merge
from recon_cli.config.stages import ComputeConfig, IngestConfig, SfmConfig
from recon_cli.context import StageInputs
from recon_cli.errors import ConfigError, InputError
from recon_cli.evaluation.reference_views import held_out_names
from recon_cli.io.layouts import recognise, refuse_incomplete
from recon_cli.pipeline import plan
from recon_cli.pipeline.plan import Job, Target
from recon_cli.progress import Progress
from recon_cli.workspace.digests import digest_file, sha256_json
from recon_cli.workspace.layout import Workspace

_READ = ("images", "denoised", "masks", "sparse")  # below sfm/undistorted, what training reads


@dataclass(frozen=True, eq=False)
class SceneFolders:
    """The finished folders of ingest and sfm of a scene, under its name in tables and files."""

    name: str
    inputs: StageInputs

    @cached_property
    def digest(self) -> str:
        """What the scene holds, whatever its folder is called: images, masks, cameras, split."""
        undistorted = self.inputs.folders["sfm"] / "undistorted"
        files = [path for part in _READ for path in sorted((undistorted / part).rglob("*"))
                 if path.is_file()]
        return sha256_json({
            "files": {str(path.relative_to(undistorted)): digest_file(path).sha256
                      for path in files},
            "held_out": sorted(held_out_names(self.inputs.folders["ingest"]))})


def check_scenes(paths: Sequence[Path]) -> dict[str, Path]:
    """Returns the paths by the names of their scenes, once each can be one.

    Raises:
        ConfigError: there is none, or two have one name.
        InputError: a path is neither a workspace nor a data set with poses.
        StageError: a workspace has no fresh cameras.
    """
    if not paths:
        raise ConfigError(
            "No scene was given.",
            hint="Give workspaces with cameras or data sets with poses after --scenes.")
    scenes: dict[str, Path] = {}
    for path in paths:
        name = path.resolve().name
        if name in scenes:
            raise ConfigError(
                f"{scenes[name]} and {path} are both called {name}.",
                hint="Rename one of the folders: tables tell scenes apart by their names.")
        scenes[name] = path
        if Workspace(path).holds_results:
            plan.require_fresh(Job(Workspace(path)), ("ingest", "sfm"))
        else:
            _refuse_unposed(path)
    return scenes


def _refuse_unposed(path: Path) -> None:
    if not path.exists():
        raise InputError(f"{path} does not exist.", hint="Check the path.")
    refuse_incomplete(path)
    if recognise(path) is None:
        raise InputError(
            f"{path} is neither a workspace with cameras nor a data set with poses.",
            hint=f"Run `recon ingest {path} -w WORKSPACE` and `recon sfm -w WORKSPACE`, and give "
                 "that workspace.")


def open_scene(
    name: str, path: Path, scratch: Path, settings: Settings, compute: ComputeConfig,
    progress: Progress,
) -> SceneFolders:
    """Returns the folders of a scene; a data set is read and mapped with the poses it has.

    A workspace is only read. Those of data sets lie in `scratch`; what is fresh there is kept.

    Raises:
        ReconError: whatever the stages raise.
    """
    workspace = Workspace(path)
    if not workspace.holds_results:
        workspace = Workspace(scratch / name)
        values = merge([settings, {"sfm": {"poses": "keep"}}])
        stages = {part: values[part] for part in ("ingest", "denoise", "sfm")}
        plan.run(Job(workspace, stages, compute, progress), "ingest and sfm", [
            Target("ingest", build(IngestConfig, stages), (path,)),
            Target("sfm", build(SfmConfig, stages))])
    return SceneFolders(name, StageInputs({
        stage: workspace.folder(stage) for stage in ("ingest", "sfm")}))
