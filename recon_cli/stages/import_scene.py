"""import: a scene that was made elsewhere takes the place of a trained one.

Writes splats.ply in the world of the workspace, config.json (as a training that ended with this
scene would have left it: size of the views, degree, validation) and import.json. If there are
views, the scene is compared with some of them first.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from recon_cli.config.stages import MIN_GAUSSIANS, ImportConfig, RunConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.errors import FormatError, InputError
from recon_cli.export.import_alignment import Alignment, align_to_views
from recon_cli.io.training_scene import PlacedCapture
from recon_cli.scene.similarity import Similarity
from recon_cli.scene.splats import Splats, transformed
from recon_cli.splats.axes import AXES
from recon_cli.splats.format import LoadedScene
from recon_cli.splats.ply import write_ply
from recon_cli.splats.registry import format_of, load_splats
from recon_cli.train.fit.train_data import write_config
from recon_cli.workspace.digests import digest_file
from recon_cli.workspace.records import ImportRecord
from recon_cli.workspace.summaries import ImportSummary


def run(config: ImportConfig, inputs: StageInputs, out: Path, ctx: StageContext) -> ImportSummary:
    """Writes the scene of the one source into `out`.

    Raises:
        FormatError: the file is of an unknown format, damaged or empty.
        InputError: several files were given.
    """
    if len(inputs.sources) != 1:
        raise InputError(
            f"{len(inputs.sources)} files were given, but a workspace holds one scene.",
            hint="Import each into a workspace of its own with -w.")
    path = inputs.sources[0]
    scene = load_splats(path, axes=config.axes if config.axes in AXES else None)
    splats = scene.splats
    if not len(splats):
        raise FormatError(f"{path} holds no Gaussians.")
    # to the frame of the file, away from which float32 took it
    origin = scene.origin.point if scene.origin else None
    moved = Similarity(translation=np.array(origin or (0.0, 0.0, 0.0)))
    alignment = _align(splats, moved, config, inputs, ctx)
    if alignment is not None:
        splats = transformed(splats, alignment.similarity.after(moved))
    up = {"z-up": "z", "y-down": "-y"}.get(config.axes or "", scene.up)
    record = ImportRecord(
        path.name, format_of(path).name, digest_file(path).sha256, len(splats), splats.sh_degree,
        up == "z", views=alignment is not None, doubt=alignment.doubt if alignment else "",
        y_up=up == "y", antialiased=scene.antialiased, origin=origin if alignment is None else None)
    write_ply(out / "splats.ply", splats)
    write_config(out, _equivalent_run_config(config, splats))
    record.write(out)
    notices = [*([record.doubt] if record.doubt else []), *_describe(path, scene, alignment)]
    for text in notices:
        ctx.notice(text)
    transform = alignment.similarity if alignment else moved.inverse()
    return _summarize(record, alignment, transform, notices)


def _align(
    splats: Splats, moved: Similarity, config: ImportConfig, inputs: StageInputs, ctx: StageContext
) -> Alignment | None:
    """Returns how the scene fits the training views; None if there are none.

    `moved` leads from the splats to the frame of the file.
    """
    if not {"ingest", "place"} <= inputs.folders.keys():
        return None
    capture = PlacedCapture.read(inputs.folders)
    return align_to_views(
        splats, capture.load_scene(validation=config.validation), capture.similarity,
        config.frame, config.max_size, ctx, moved=moved)


def _equivalent_run_config(config: ImportConfig, splats: Splats) -> RunConfig:
    """Returns the options of a training that would have ended with this scene."""
    return RunConfig(
        max_size=config.max_size, validation=config.validation, sh_degree=splats.sh_degree,
        max_gaussians=max(MIN_GAUSSIANS, len(splats)), images="original",
        **RunConfig.plain_values(late=False))


def _describe(path: Path, scene: LoadedScene, alignment: Alignment | None) -> list[str]:
    """Returns notices about the file."""
    notices = []
    if scene.antialiased:
        notices.append(
            f"{path.name} was trained for antialiased rendering (Mip-Splatting), which is not "
            "supported: details smaller than a pixel look too thick")
    if alignment is not None and alignment.doubt and path.suffix.lower() == ".spz":
        notices.append(
            f"{path.name} may have other axes than it states, or than a .ply has: --axes rub "
            "may be right")
    if scene.origin is not None and alignment is None:
        notices.append(
            f"{path.name}: {scene.origin.describe()}. Exported files have the new positions; "
            "--transform of export with that translation moves them back, rounded")
    return notices


def _summarize(
    record: ImportRecord, alignment: Alignment | None, transform: Similarity, notices: list[str]
) -> ImportSummary:
    return ImportSummary(
        imported_from=record.file, format=record.format, gaussians=record.gaussians,
        sh_degree=record.sh_degree, sha256=record.sha256[:12],
        views=alignment.views if alignment else 0,
        frame=alignment.frame if alignment else None,
        training_psnr_db=round(alignment.psnr_db[alignment.frame], 3) if alignment else None,
        flat_psnr_db=round(alignment.flat_db, 3) if alignment else None,
        tried_psnr_db={name: round(value, 3) for name, value in alignment.psnr_db.items()}
        if alignment else None,
        transform=None if transform.is_identity and not alignment else transform.to_json(),
        notices=tuple(notices) or None)
