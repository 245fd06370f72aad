"""export: a .ply that other viewers open, read back and compared before it counts as written.

Other formats are written beside it, each read back and scored. Removals by options come first and
are reported in Gaussians and dB. transform.json holds the similarity from the trained scene to the
exported one.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.config.export import ExportConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.errors import ReconError, ReconstructionError, StageError, WorkspaceError
from recon_cli.evaluation.reference_views import RenderedModel
from recon_cli.export.bounds import describe_bounds, describe_loss
from recon_cli.export.coordinate_frame import ExportFrame, choose_frame, find_room_frame
from recon_cli.export.format_writer import FormatWriter, measure_first
from recon_cli.export.kept_files import (
    KeptFiles,
    discard_files,
    find_fresh,
    keep_files,
    made_of,
    read_records,
)
from recon_cli.export.reduce import reduce_scene
from recon_cli.export.source import ExportSource
from recon_cli.export.verify import verify_ply
from recon_cli.io.training_scene import load_scene
from recon_cli.scene.splats import Splats, transformed
from recon_cli.splats.axes import nearest_up
from recon_cli.splats.ply import describe_scene, read_ply, write_ply
from recon_cli.train.finished_model import FINAL
from recon_cli.train.train_data import read_config
from recon_cli.trust.ply_property import PLY_PROPERTY, expected_errors, match_rows
from recon_cli.trust.scene_trust import measure_trust, refuse_without, views_looked_at
from recon_cli.workspace.atomic import write_json
from recon_cli.workspace.export_formats import EXPORT_FORMATS, PLAN
from recon_cli.workspace.export_record import (
    ExportedFile,
    ExportSummary,
    FailedFormat,
    limited_format,
    skip_options,
)
from recon_cli.workspace.records import NEEDS_VIEWS_HINT, ImportRecord, has_views

TRANSFORM = "transform.json"


def run(config: ExportConfig, inputs: StageInputs, out: Path, ctx: StageContext) -> ExportSummary:
    """Writes splats.ply, transform.json and the other formats; existing files are kept."""
    if config.model == "pruned" and "prune" not in inputs.folders:
        raise StageError(
            "The pruned model was requested, but there is no fresh one.",
            hint="Run `recon prune` first, or export with --model base.")
    _refuse_without_views(config, inputs)
    pruned = "prune" in inputs.folders and config.model != "base"
    frame = choose_frame(config, inputs)
    for text in frame.fused.describe() if frame.fused else ():
        ctx.notice(text)
    # refused before anything is written
    room_frame = find_room_frame(inputs, frame) if PLAN in config.formats else None
    splats = read_ply(inputs.folders["prune" if pruned else "train"] / "splats.ply")
    trained = splats
    if not frame.similarity.is_identity:
        splats = transformed(splats, frame.similarity)
    model = "pruned" if pruned else "base"
    records = read_records(config, inputs, model)
    fresh = find_fresh(config, inputs, records)
    antialiased = not pruned and _is_antialiased(inputs.folders["train"])
    source = ExportSource(splats, inputs, frame, ctx, antialiased=antialiased)
    reduced = reduce_scene(
        splats, config, source, partial(measure_first, config=config, source=source))
    splats = reduced.bounded
    for text in filter(None, (describe_bounds(splats), describe_loss(reduced.changes))):
        ctx.notice(text)
    path = out / "splats.ply"
    others = [name for name in config.formats if name != "ply" and name not in fresh]
    with ctx.progress.bar("export", 2 + len(others), unit="file") as bar:
        write_ply(path, splats, _expected_errors(config, inputs, frame, splats, trained, ctx),
                  comments=describe_scene(nearest_up(frame.up), antialiased=antialiased))
        bar.advance()
        verify_ply(path, splats)
        bar.advance()
        writer = FormatWriter(reduced, out, config, source, room_frame)
        files, failed = _write_formats(others, writer, out, config, bar.advance)
    record = ImportRecord.read(inputs.folders["train"])
    _write_transform(out / TRANSFORM, frame, record.origin if record else None)
    files = {name: dataclasses.replace(file, made_of=made_of(name, config, inputs, model))
             for name, file in files.items()}
    kept = keep_files(out, inputs.earlier, records, ["ply", *files])
    notices = _notices(kept, failed)
    for text in notices:
        ctx.notice(text)
    return ExportSummary(
        model=model, file=path.name, gaussians=len(splats.with_sphere()),
        bytes=path.stat().st_size, transform=frame.similarity.to_json(),
        changes=reduced.changes or None, files={**files, **kept.files} or None,
        limited=limited_format(dataclasses.asdict(config)), failed=failed or None,
        own_files=kept.own_files or None, notices=notices or None)


def _is_antialiased(train: Path) -> bool:
    """Returns whether a scene is that of an imported file that says so, and not trained here."""
    record = ImportRecord.read(train)
    return bool(record and record.antialiased) and not (train / FINAL).exists()


def _write_formats(
    names: Sequence[str], writer: FormatWriter, out: Path, config: ExportConfig,
    advance: Callable[[], None],
) -> tuple[dict[str, ExportedFile], dict[str, FailedFormat]]:
    """Writes the scene in each format; one that fails takes nothing from the others."""
    files: dict[str, ExportedFile] = {}
    failed: dict[str, FailedFormat] = {}
    for name in names:
        try:
            files[name] = writer.write(EXPORT_FORMATS[name])
        except WorkspaceError:
            raise
        except ReconError as error:
            discard_files(out, name, ["ply", *files])
            skipped = config.skip_lossy and isinstance(error, ReconstructionError)
            failed[name] = FailedFormat(
                message=error.message, hint=error.hint, skipped_with=skip_options(
                    name, dataclasses.asdict(config)) if skipped else None)
        advance()
    return files, failed


def _notices(kept: KeptFiles, failed: Mapping[str, FailedFormat]) -> tuple[str, ...]:
    """Returns notices about the formats that are left out, and the files that are kept."""
    return (
        *(f"{file.file} is stale: {file.stale}. It is kept; --format {name} writes it again."
          for name, file in kept.files.items() if file.stale),
        *(f"{EXPORT_FORMATS[name].file} was not written: {one.message} {one.hint}"
          for name, one in failed.items() if one.skipped_with is not None),
        *(f"{old} was not written by recon, or changed since: it is kept as {new}."
          for old, new in kept.renamed.items()))


def _expected_errors(
    config: ExportConfig, inputs: StageInputs, frame: ExportFrame, splats: Splats, trained: Splats,
    ctx: StageContext,
) -> dict[str, NDArray[np.float32]]:
    """Returns the properties that --trust adds to the .ply of `splats`; `trained` are all."""
    if not config.trust:
        return {}
    refuse_without(ImportRecord.read(inputs.folders["train"]))
    run_config = read_config(inputs.folders["train"])
    scene = load_scene(inputs.folders, validation=run_config.validation)
    with ctx.progress.bar("trust", views_looked_at(scene), unit="view") as bar:
        errors = expected_errors(trained, measure_trust(
            RenderedModel(trained.map(lambda tensor: tensor.to(ctx.device)), run_config.sh_degree,
                          ctx.backend), scene, run_config, run_config.max_size, ctx, bar.advance))
    rows = match_rows(splats.means, frame.similarity.points(trained.means.double().numpy()))
    return {PLY_PROPERTY: np.where(rows < 0, errors.max(), errors[rows])}


def _refuse_without_views(config: ExportConfig, inputs: StageInputs) -> None:
    """Raises StageError if an option needs views, and an imported scene has none that fit."""
    record = ImportRecord.read(inputs.folders["train"])
    if record and record.doubt and config.drop_floaters:
        raise StageError(
            f"--drop-floaters needs views of the scene, but {record.doubt}.",
            hint="Run `recon import` with another --frame, or from a file in the right one.")
    if has_views(inputs.folders):
        return
    refused = [f"--format {name}" for name in config.formats if EXPORT_FORMATS[name].needs_views]
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
        **({"scale": frame.fused.to_json()} if frame.fused else {}),
        # subtracted from the positions of the imported file before
        **({"origin": list(origin)} if origin else {})})
