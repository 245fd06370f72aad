"""What can be done with an imported scene in a workspace that holds no views, and what cannot."""

from __future__ import annotations

from recon_cli.config import ExportConfig
from recon_cli.errors import StageError
from recon_cli.scene.scene import Scene
from recon_cli.scene.splats import Splats
from recon_cli.stages.context import StageInputs
from recon_cli.stages.made_up import made_up_scene
from recon_cli.stages.origin import Origin

HINT = ("Run `recon ingest CAPTURE` and `recon sfm` in this workspace, then `recon import` again.")
_OF_VIEWS = ("colmap", "transforms.json")  # formats that hold cameras and images


def has_views(inputs: StageInputs) -> bool:
    """Tells whether there are views that the scene was made of or held against."""
    origin = Origin.of(inputs.folders["train"])
    return (origin is None or origin.views) and "sfm" in inputs.folders


def viewless_scene(splats: Splats, inputs: StageInputs, max_size: int) -> Scene:
    """Returns made-up cameras for an imported scene, by what is known of its axes."""
    origin = Origin.of(inputs.folders["train"])
    assert origin is not None, "trained without views"
    return made_up_scene(splats, z_up=origin.z_up, max_size=max_size)


def refuse_without_views(config: ExportConfig, inputs: StageInputs) -> None:
    """Raises StageError where an export asks for what only views can tell, and there are none."""
    origin = Origin.of(inputs.folders["train"])
    if origin and origin.doubt and config.drop_floaters:
        raise StageError(
            f"--drop-floaters goes by the views, but {origin.doubt}.",
            hint="Run `recon import` with another --frame, or from a file in the right one.")
    if has_views(inputs):
        return
    asked = [f"--format {name}" for name in config.formats if name in _OF_VIEWS]
    if config.drop_floaters:
        asked.append("--drop-floaters")
    if config.max_mb is not None:  # which Gaussians matter
        asked.append("--max-mb")
    if config.scale_between is not None:  # points and frames
        asked.append("--scale-between")
    if asked:
        raise StageError(
            f"{' and '.join(asked)} cannot be had of a scene that was imported without views.",
            hint=HINT)
