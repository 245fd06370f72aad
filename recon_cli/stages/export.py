"""export: a .ply that other viewers open, read back and compared before it counts as written.

Each other format is a part of the stage, a result of its own beside the .ply, read back and scored.
Removals by options come first and are reported in Gaussians and dB. transform.json holds the
similarity from the trained scene to the exported one.
"""

from __future__ import annotations

from functools import cached_property, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.config.export import ExportConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.errors import Hint, StageError
from recon_cli.evaluation.reference_views import RenderedModel
from recon_cli.export.bounds import describe_bounds, describe_loss
from recon_cli.export.coordinate_frame import ExportFrame, choose_frame, find_room_frame
from recon_cli.export.format_writer import FormatWriter, measure_first
from recon_cli.export.reduce import ReducedScene, reduce_scene
from recon_cli.export.source import ExportSource
from recon_cli.export.verify import verify_ply
from recon_cli.io.training_scene import PlacedCapture
from recon_cli.scene.splats import Splats, transformed
from recon_cli.splats.axes import nearest_up
from recon_cli.splats.ply import describe_scene, read_ply, write_ply
from recon_cli.train.finished_model import FinishedModel
from recon_cli.trust.ply_property import PLY_PROPERTY, expected_errors, match_rows
from recon_cli.trust.scene_trust import measure_trust, refuse_without, views_looked_at
from recon_cli.workspace.atomic import write_json
from recon_cli.workspace.export_formats import EXPORT_FORMATS, PLAN, TRANSFORM
from recon_cli.workspace.records import ImportRecord, need_views
from recon_cli.workspace.summaries import ExportedFile, ExportSummary

_PLY = "splats.ply"


def run(
    config: ExportConfig, inputs: StageInputs, out: Path, ctx: StageContext
) -> ExportSummary | ExportedFile:
    """Writes splats.ply and transform.json, or the files of the format that is a part."""
    key = config, frozenset(inputs.folders.items()) - {("export", inputs.folders.get("export"))}
    if key not in ctx.shared:
        ctx.shared[key] = _Export(config, inputs, ctx)
    export: _Export = ctx.shared[key]
    if not inputs.part:
        return export.write_ply(out, ctx)
    with ctx.progress.bar(f"export.{inputs.part}", 1, unit="file") as bar:
        written = export.writer.write(
            EXPORT_FORMATS[inputs.part], out, inputs.folders["export"] / _PLY)
        bar.advance()
    return written


class _Export:
    """The scene of one export with its options, for all formats."""

    def __init__(self, config: ExportConfig, inputs: StageInputs, ctx: StageContext) -> None:
        self._config, self._folders = config, inputs.folders
        self._model = FinishedModel.read(inputs.folders["train"])
        self._record = record = self._model.import_record
        placed = {"ingest", "place"} <= inputs.folders.keys() and (record is None or record.views)
        capture = PlacedCapture.read(inputs.folders) if placed else None
        _refuse_without_views(config, record, has_views=placed)
        self._pruned = "prune" in inputs.folders and config.model != "base"
        if self._model.config.compact_only and not self._pruned:
            ctx.notice("the original is unfinished: its training ended where pruning begins")
        self._antialiased = bool(
            record and record.antialiased and not (self._pruned or self._model.trained))
        self._frame = choose_frame(config, capture, record.up() if record else None)
        # refused before anything is written
        room_frame = (find_room_frame(capture, self._frame)
                      if capture is not None and PLAN in config.formats else None)
        self._source = ExportSource(
            lambda: self._splats, self._model, capture, self._frame, ctx,
            antialiased=self._antialiased)
        self.writer = FormatWriter(lambda: self._reduced, config, self._source, room_frame)

    @cached_property
    def _trained(self) -> Splats:
        """The Gaussians in the world of the training."""
        return read_ply(self._folders["prune" if self._pruned else "train"] / _PLY)

    @cached_property
    def _splats(self) -> Splats:
        """The same in the frame of the files."""
        similarity = self._frame.similarity
        return self._trained if similarity.is_identity else transformed(self._trained, similarity)

    @cached_property
    def _reduced(self) -> ReducedScene:
        return reduce_scene(self._splats, self._config, self._source, partial(
            measure_first, config=self._config, source=self._source))

    def write_ply(self, out: Path, ctx: StageContext) -> ExportSummary:
        """Writes the scene and its frame, and reads it back."""
        frame, path = self._frame, out / _PLY
        if self._config.model == "pruned" and not self._pruned:
            raise StageError(
                "The pruned model was requested, but there is no fresh one.",
                hint=Hint("prune", then=" first, or export with --model base"))
        for text in frame.fused.describe() if frame.fused else ():
            ctx.notice(text)
        splats, changes = self._reduced.bounded, self._reduced.changes
        for text in filter(None, (describe_bounds(splats), describe_loss(changes))):
            ctx.notice(text)
        with ctx.progress.bar("export", 2, unit="file") as bar:
            write_ply(path, splats, self._expected_errors(splats, ctx), comments=describe_scene(
                nearest_up(frame.up), antialiased=self._antialiased))
            bar.advance()
            verify_ply(path, splats)
            bar.advance()
        _write_transform(
            out / TRANSFORM, frame, self._record.origin if self._record else None)
        return ExportSummary(
            model="pruned" if self._pruned else "base", file=path.name,
            gaussians=len(splats.with_sphere()), bytes=path.stat().st_size,
            transform=frame.similarity.to_json(), changes=changes or None)

    def _expected_errors(
        self, splats: Splats, ctx: StageContext
    ) -> dict[str, NDArray[np.float32]]:
        """Returns the properties that --trust adds to the .ply of `splats`."""
        if not self._config.trust:
            return {}
        refuse_without(self._record)
        trained, run_config, scene = self._trained, self._model.config, self._source.scene
        with ctx.progress.bar("trust", views_looked_at(scene), unit="view") as bar:
            errors = expected_errors(trained, measure_trust(
                RenderedModel(trained.map(lambda tensor: tensor.to(ctx.device)),
                              run_config.sh_degree, ctx.backend),
                scene, run_config, run_config.max_size, ctx, bar.advance))
        rows = match_rows(
            splats.means, self._frame.similarity.points(trained.means.double().numpy()))
        return {PLY_PROPERTY: np.where(rows < 0, errors.max(), errors[rows])}


def _refuse_without_views(
    config: ExportConfig, record: ImportRecord | None, *, has_views: bool
) -> None:
    """Raises StageError if an option needs views, and an imported scene has none that fit."""
    if record and record.doubt and config.drop_floaters:
        raise StageError(
            f"--drop-floaters needs views of the scene, but {record.doubt}.",
            hint=Hint("import", then=" with another --frame, or from a file in the right one"))
    if has_views:
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
            hint=need_views())


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
