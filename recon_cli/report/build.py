"""Builds the report of a workspace and writes it to a file, atomically."""

from __future__ import annotations

import base64
import hashlib
import os
import shlex
from collections.abc import Mapping, Sequence
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape

from recon_cli.config.stages import MODEL_LABELS
from recon_cli.errors import ConfigError, FormatError, WorkspaceError
from recon_cli.evaluation.metrics import ERROR_GAIN
from recon_cli.evaluation.scores import Metrics
from recon_cli.pipeline.execute import Job, last_sources
from recon_cli.progress import format_duration, format_megabytes
from recon_cli.report.capture import read_capture
from recon_cli.report.curves import draw_rounds, draw_training_curves
from recon_cli.report.gallery import (
    MAX_FILE_BYTES,
    MOST_ERROR,
    Gallery,
    GalleryView,
    build_gallery,
    legend_stops,
)
from recon_cli.report.headline import build_headline, format_facts
from recon_cli.report.moving_section import read_moving
from recon_cli.report.opening import build_opening
from recon_cli.report.parts import read_parts
from recon_cli.report.records import build_scores, read_metrics
from recon_cli.report.room import read_room
from recon_cli.report.stage_status import (
    StageReports,
    inspect_stages,
    read_decisions,
    read_provenance,
)
from recon_cli.report.trust_section import read_trust
from recon_cli.splats.html import ICON
from recon_cli.trust.quality import delivered_model
from recon_cli.workspace import atomic
from recon_cli.workspace.layout import disk_errors
from recon_cli.workspace.records import name_photos
from recon_cli.workspace.summaries import ExportSummary

FILE = "report.html"
_SUFFIXES = (".html", ".htm")
_HERE = Path(__file__).parent
_TEXT_PER_VIEW = 1_000  # bytes around a view's pictures, at most


def write_report(job: Job, out: Path | None) -> Path:
    """Writes the report of a workspace, which is only read, and returns its path.

    `out` is report.html in the workspace by default. StageError if ingest has not run yet,
ManifestError if its manifest cannot be trusted; ConfigError if `out` is not an HTML file, or
    would change a result or an input; WorkspaceError if it cannot be written.
    """
    path = (job.workspace.root / FILE if out is None else out).absolute()
    _check_path(job, path)
    with disk_errors(job.workspace.root, "reading the workspace"):
        page = build_report(job, path.parent)
    try:
        with disk_errors(path.parent, "writing the report"):
            path.parent.mkdir(parents=True, exist_ok=True)
            atomic.write_bytes(path, page)
    except OSError as error:
        raise WorkspaceError(
            f"{path} cannot be written: {error.strerror}.",
            hint="Give another file with -o.") from error
    return path


def _check_path(job: Job, path: Path) -> None:
    """Raises ConfigError if a stage would take the file for its own or for an input."""
    if path.suffix.lower() not in _SUFFIXES or path.is_dir():
        raise ConfigError(
            f"{path} is not the name of an HTML file.",
            hint="Give a file that ends in .html with -o.")
    # Path.resolve raises for a link to itself, which the report replaces like any other link
    root, real = (Path(os.path.realpath(one)) for one in (job.workspace.root, path))
    for name in (".partial", ".old", *(row.name for row in job.table)):
        if real.is_relative_to(root / name):
            raise ConfigError(
                f"{path} is in the folder of a stage, where every file is checked.",
                hint="Give a file elsewhere with -o.")
    for source in last_sources(job, "ingest"):
        folder = Path(os.path.realpath(source.path))
        if real.is_relative_to(folder) and not real.is_relative_to(root):
            raise ConfigError(
                f"{path} is in {folder}, an input of ingest: it would count as a new input.",
                hint="Give a file elsewhere with -o.")


def build_report(job: Job, folder: Path) -> bytes:
    """Returns the page of a workspace in UTF-8, at most MAX_FILE_BYTES long.

    `folder` is where it will be, which its links to files start from.
    """
    stages = inspect_stages(job)
    metrics, damaged = None, ""
    if stages["evaluate"].there:
        try:
            metrics = read_metrics(stages["evaluate"].folder)
        except FormatError as error:
            damaged = f"The scores are not shown: {error.message}"
    values = _template_values(job, stages, metrics, damaged, folder)
    rename = name_photos(stages["ingest"].folder)
    rename_marked = name_photos(stages["ingest"].folder, shown=lambda name: str(escape(name)))

    def name_in(value: Any) -> Any:
        if isinstance(value, Markup):  # a drawing with titles
            return Markup(rename_marked(value))
        return rename(value) if isinstance(value, str) and value[:5] != "data:" else value

    environment = _environment().overlay(finalize=name_in)

    def render(gallery: Gallery) -> bytes:
        data = [_script_data(view, rename(view.name)) for view in gallery.views]
        return _render_page(environment, values, gallery, data)

    views = sum(len(model.views) for model in metrics.models.values()) if metrics else 0
    if not views or metrics is None:
        return render(Gallery())
    # rendered once without pictures to know how much room the text leaves
    text = len(render(Gallery())) + _TEXT_PER_VIEW * views
    return render(build_gallery(
        stages["evaluate"].folder, metrics, MAX_FILE_BYTES - text, job.progress))


def _template_values(
    job: Job, stages: StageReports, metrics: Metrics | None, damaged: str, folder: Path
) -> dict[str, Any]:
    """Returns the template's values, except for the views."""
    root, opening = job.workspace.root, build_opening(stages, metrics, folder)
    runs = [stage.manifest.run for stage in stages.values() if stage.manifest]
    return {
        "stages": stages, "opening": opening,
        "date": datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %z"),
        "headline": build_headline(stages, metrics, opening.trust), "capture": read_capture(stages),
        "parts": read_parts(stages),
        "trust": read_trust(stages),
        "curves": draw_training_curves(stages, metrics),
        "moving": read_moving(stages),
        "decisions": read_decisions(stages["train"]), "damaged": damaged,
        "delivered": delivered_model(metrics),
        "scores": build_scores(metrics) if metrics and metrics.models else None,
        "rounds": draw_rounds(stages["prune"]),
        "part_command": f"recon sfm -w {shlex.quote(str(root))} --part",
        "provenance": read_provenance(stages), "labels": MODEL_LABELS,
        "export": stages["export"].read_summary(ExportSummary), "room": read_room(stages["export"]),
        "longest": max(run.seconds for run in runs),
        "largest": max(run.peak_memory_bytes for run in runs),
        "icon": ICON, "gain": ERROR_GAIN, "most_error": MOST_ERROR,
        "stops": ", ".join(legend_stops()),
    }


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(_HERE), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True)
    environment.filters.update(
        duration=format_duration, megabytes=format_megabytes, facts=format_facts)
    return environment


def _render_page(
    environment: Environment, values: Mapping[str, Any], gallery: Gallery,
    data: Sequence[Mapping[str, Any]],
) -> bytes:
    script = (_HERE / "script.js").read_text(encoding="utf-8")
    # the hash in the content policy lets the browser run this script and no other
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    page = render_template("report.html.j2", environment, **values, gallery=gallery, data=data,
                           script=Markup(script), script_hash=digest)
    return page.encode(errors="backslashreplace")  # file names need not be UTF-8


def render_template(name: str, environment: Environment | None = None, /, **values: Any) -> str:
    """Returns a page of this folder's templates, with the style of them all."""
    style = Markup((_HERE / "style.css").read_text(encoding="utf-8"))
    return (environment or _environment()).get_template(name).render(style=style, **values)


def _script_data(view: GalleryView, name: str) -> dict[str, Any]:
    return {
        "name": name, "width": view.width, "height": view.height, "masked": view.masked,
        "models": {key: {
            "render": view.renders[key], "difference": view.differences[key],
            "psnr": round(row.psnr_db, 2), "ssim": round(row.ssim, 4)}
            for key, row in view.scores.items()}}
