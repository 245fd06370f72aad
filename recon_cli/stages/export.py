"""export: a .ply that other viewers open, read back and compared before it counts as written.

Other formats are written beside it, each read back and scored. What options remove first is
reported in Gaussians and dB. transform.json holds the similarity from the trained scene to the
exported one.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.config.stages import MESH_FORMATS, PLAN, ExportConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.errors import StageError
from recon_cli.evaluation.reference_views import load_scene
from recon_cli.export.coordinate_frame import ExportFrame, choose_frame, find_room_frame
from recon_cli.export.exporter import Exporter
from recon_cli.export.verify import verify_ply
from recon_cli.io.ply import read_ply, write_ply
from recon_cli.io.records import NEEDS_VIEWS_HINT, ImportRecord, has_views
from recon_cli.scene.splats import Splats, transformed
from recon_cli.train.train_data import read_config
from recon_cli.trust.ply_property import PLY_PROPERTY, expected_errors, match_rows
from recon_cli.trust.scene_trust import measure_trust, refuse_without, views_looked_at
from recon_cli.workspace.atomic import write_json
from recon_cli.workspace.summaries import ExportSummary

TRANSFORM = "transform.json"
_VIEW_FORMATS = ("colmap", "transforms.json", *MESH_FORMATS)  # made of views


def run(config: ExportConfig, inputs: StageInputs, out: Path, ctx: StageContext) -> ExportSummary:
    """Writes splats.ply, the other formats and transform.json."""
    if config.model == "pruned" and "prune" not in inputs.folders:
        raise StageError(
            "The pruned model was requested, but there is no fresh one.",
            hint="Run `recon prune` first, or export with --model base.")
    _refuse_without_views(config, inputs)
    pruned = "prune" in inputs.folders and config.model != "base"
    frame = choose_frame(config, inputs)
    if PLAN in config.formats:
        find_room_frame(inputs, frame)  # refused before anything is written
    splats = read_ply(inputs.folders["prune" if pruned else "train"] / "splats.ply")
    trained = splats
    if not frame.similarity.is_identity:
        splats = transformed(splats, frame.similarity)
    exporter = Exporter(config, inputs, out, frame, ctx)
    splats, changes = exporter.reduce(splats)
    path = out / "splats.ply"
    others = [name for name in config.formats if name != "ply"]
    with ctx.progress.bar("export", 2 + len(others), unit="file") as bar:
        write_ply(path, splats, _expected_errors(config, inputs, frame, splats, trained, ctx),
                  comments=exporter.comments)
        bar.advance()
        verify_ply(path, splats)
        bar.advance()
        files = {}
        for name in others:
            files[name] = exporter.write(name, splats)
            bar.advance()
    record = ImportRecord.read(inputs.folders["train"])
    _write_transform(out / TRANSFORM, frame, record.origin if record else None)
    return ExportSummary(
        model="pruned" if pruned else "base", file=path.name, gaussians=len(splats),
        bytes=path.stat().st_size, transform=frame.similarity.to_json(),
        changes=tuple(changes) or None, files=files or None)


def _expected_errors(
    config: ExportConfig, inputs: StageInputs, frame: ExportFrame, splats: Splats, trained: Splats,
    ctx: StageContext,
) -> dict[str, NDArray[np.float32]]:
    """Returns the properties that --trust adds to the .ply of `splats`; `trained` are all."""
    if not config.trust:
        return {}
    refuse_without(ImportRecord.read(inputs.folders["train"]))
    run_config = read_config(inputs.folders["train"])
    scene = load_scene(inputs, validation=run_config.validation)
    with ctx.progress.bar("trust", views_looked_at(scene), unit="view") as bar:
        errors = expected_errors(trained, measure_trust(
            trained.map(lambda tensor: tensor.to(ctx.device)), scene, run_config,
            run_config.max_size, ctx, bar.advance))
    rows = match_rows(splats.means, frame.similarity.points(trained.means.double().numpy()))
    return {PLY_PROPERTY: errors[rows]}


def _refuse_without_views(config: ExportConfig, inputs: StageInputs) -> None:
    """Raises StageError if an option needs views, and an imported scene has none that fit."""
    record = ImportRecord.read(inputs.folders["train"])
    if record and record.doubt and config.drop_floaters:
        raise StageError(
            f"--drop-floaters needs views of the scene, but {record.doubt}.",
            hint="Run `recon import` with another --frame, or from a file in the right one.")
    if has_views(inputs.folders):
        return
    refused = [f"--format {name}" for name in config.formats if name in _VIEW_FORMATS]
    if config.drop_floaters:
        refused.append("--drop-floaters")
    if config.max_mb is not None:
        refused.append("--max-mb")
    if config.scale_between is not None:
        refused.append("--scale-between")
    if refused:
        raise StageError(
            f"{' and '.join(refused)} cannot be used: the scene was imported without views.",
            hint=NEEDS_VIEWS_HINT)


def _write_transform(
    path: Path, frame: ExportFrame, origin: tuple[float, ...] | None
) -> None:
    write_json(path, {
        "from": "the world of sfm, in which the scene was trained; without views, that of the file "
        "that was imported",
        "to": "splats.ply beside this file",
        "similarity": frame.similarity.to_json(),
        "measurement": frame.measurement.to_json() if frame.measurement else None,
        # subtracted from the positions of the imported file before
        **({"origin": list(origin)} if origin else {})})
