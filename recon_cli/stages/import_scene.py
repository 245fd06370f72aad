"""import: a scene that was made elsewhere takes the place of a trained one.

Leaves splats.ply in the world of the workspace, config.json (what a run on this scene would have
been told: size of the views, degree, validation) and import.json. Where there are views, the scene
is held against some of them first.
"""

from __future__ import annotations

from pathlib import Path

from recon_cli.config.stages import MIN_GAUSSIANS, ImportConfig, RunConfig
from recon_cli.context import StageContext, StageInputs, Summary
from recon_cli.errors import FormatError, InputError
from recon_cli.evaluation.reference_views import load_scene
from recon_cli.export.import_alignment import Match, match, world_of
from recon_cli.io.import_record import Origin
from recon_cli.io.ply import write_ply
from recon_cli.io.splats.registry import format_of
from recon_cli.scene.splats import Splats, transformed
from recon_cli.train.runner import write_config
from recon_cli.workspace.digests import digest_file

_MIP = b"SplatRenderMode: mip"  # a comment of Brush and others
_HEAD_BYTES = 1 << 16


def run(config: ImportConfig, inputs: StageInputs, out: Path, ctx: StageContext) -> Summary:
    """Writes the scene of the one source into `out` and returns what it holds.

    Raises:
        FormatError: the file is of no known format, damaged or empty.
        InputError: several files were given.
    """
    if len(inputs.sources) != 1:
        raise InputError(
            f"{len(inputs.sources)} files were given, but a workspace holds one scene.",
            hint="Import each into a workspace of its own with -w.")
    path = inputs.sources[0]
    form = format_of(path)
    splats = form.read(path)
    if not len(splats):
        raise FormatError(f"{path} holds no Gaussians.")
    found = _matched(splats, config, inputs, ctx)
    if found is not None:
        splats = transformed(splats, found.similarity)
    z_up = form.name == "glb" if config.axes is None else config.axes == "z-up"
    origin = Origin(path.name, form.name, digest_file(path).sha256, len(splats), splats.sh_degree,
                    z_up, views=found is not None, doubt=found.doubt if found else "")
    write_ply(out / "splats.ply", splats)
    write_config(out, _run_config(config, splats))
    origin.write(out)
    notices = [*([origin.doubt] if origin.doubt else []), *_antialiased(path)]
    for text in notices:
        ctx.notice(text)
    return {
        "imported_from": origin.file, "format": origin.format, "gaussians": len(splats),
        "sh_degree": splats.sh_degree, "sha256": origin.sha256[:12], **_told(found),
        **({"notices": notices} if notices else {}),
    }


def _matched(
    splats: Splats, config: ImportConfig, inputs: StageInputs, ctx: StageContext
) -> Match | None:
    """Returns how the scene fits the training views; None where there are none."""
    if not {"ingest", "sfm"} <= inputs.folders.keys():
        return None
    scene = load_scene(inputs, validation=config.validation)
    return match(
        splats, scene, world_of(inputs.folders["sfm"]), config.frame, config.max_size, ctx)


def _run_config(config: ImportConfig, splats: Splats) -> RunConfig:
    """Returns the options of a run that would have ended with this scene, as far as they matter."""
    return RunConfig(
        max_size=config.max_size, validation=config.validation, sh_degree=splats.sh_degree,
        max_gaussians=max(MIN_GAUSSIANS, len(splats)), images="original", far="off",
        exposure="off", poses="off")


def _antialiased(path: Path) -> list[str]:
    """Returns a sentence where a .ply says that it is to be drawn as by Mip-Splatting."""
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES).partition(b"end_header")[0]
    if not head.startswith(b"ply") or _MIP not in head:
        return []
    return [f"{path.name} was trained to be drawn with antialiasing ({_MIP.decode()}), which is "
            "not done here: what is smaller than a pixel looks too thick"]


def _told(found: Match | None) -> Summary:
    if found is None:
        return {"views": 0}
    return {
        "views": found.views, "frame": found.frame,
        "training_psnr_db": round(found.psnr_db[found.frame], 3),
        "flat_psnr_db": round(found.flat_db, 3),
        "tried_psnr_db": {name: round(value, 3) for name, value in found.psnr_db.items()},
        "transform": found.similarity.to_json(),
    }
