"""Builds the report of a workspace and writes it to a file, atomically."""

from __future__ import annotations

import base64
import hashlib
import os
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape

from recon_cli.config.stages import MODEL_LABELS
from recon_cli.errors import ConfigError, FormatError, WorkspaceError
from recon_cli.pipeline.execute import Job, last_sources
from recon_cli.progress import format_duration, format_megabytes
from recon_cli.report.gallery import MAX_FILE_BYTES, Gallery, GalleryView, build_gallery
from recon_cli.report.headline import build_headline, format_facts
from recon_cli.report.opening import build_opening
from recon_cli.report.records import read_metrics
from recon_cli.report.sections import SECTIONS
from recon_cli.report.stage_status import inspect_stages
from recon_cli.splats.html import ICON
from recon_cli.workspace import atomic
from recon_cli.workspace.layout import disk_errors
from recon_cli.workspace.records import name_photos

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
    opening = build_opening(stages, metrics, folder)
    values = {
        "stages": stages, "opening": opening, "damaged": damaged, "labels": MODEL_LABELS,
        "icon": ICON, "date": datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %z"),
        "headline": build_headline(stages, metrics, opening.trust),
        "sections": SECTIONS}
    for section in SECTIONS:
        values.update(section.gather(stages, metrics))
    rename = name_photos(stages["ingest"].folder)
    rename_marked = name_photos(stages["ingest"].folder, shown=lambda name: str(escape(name)))

    def name_in(value: Any) -> Any:
        if isinstance(value, Markup):  # a drawing with titles
            return Markup(rename_marked(value))
        return rename(value) if isinstance(value, str) and value[:5] != "data:" else value

    environment = _environment().overlay(finalize=name_in)

    script = (_HERE / "script.js").read_text(encoding="utf-8")
    # the hash in the content policy lets the browser run this script and no other
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()

    def render(gallery: Gallery) -> bytes:
        page = render_template(
            "report.html.j2", environment, **values, gallery=gallery, script=Markup(script),
            script_hash=digest,
            data=[_script_data(view, rename(view.name)) for view in gallery.views])
        return page.encode(errors="backslashreplace")  # file names need not be UTF-8

    views = sum(len(model.views) for model in metrics.models.values()) if metrics else 0
    if not views or metrics is None:
        return render(Gallery())
    # rendered once without pictures to know how much room the text leaves
    text = len(render(Gallery())) + _TEXT_PER_VIEW * views
    return render(build_gallery(
        stages["evaluate"].folder, metrics, MAX_FILE_BYTES - text, job.progress))


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(_HERE), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True)
    environment.filters.update(
        duration=format_duration, megabytes=format_megabytes, facts=format_facts)
    return environment


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
