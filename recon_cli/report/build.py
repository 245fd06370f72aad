"""Writes the page, whole or not at all, to where it harms nothing."""

from __future__ import annotations

import base64
import hashlib
import shlex
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from recon_cli.errors import ConfigError, FormatError, WorkspaceError
from recon_cli.pipeline.execute import Job, last_sources
from recon_cli.progress import format_duration, format_megabytes
from recon_cli.report.capture import capture
from recon_cli.report.curves import curve, curves, rounds
from recon_cli.report.headline import facts, headline
from recon_cli.report.images import GAIN, MAX_FILE_BYTES, MOST_ERROR, legend_stops
from recon_cli.report.provenance import provenance
from recon_cli.report.records import Metrics, read_metrics
from recon_cli.report.scores import LABELS, scores
from recon_cli.report.stage_status import Standing, standings
from recon_cli.report.views import Gallery, Shown, gallery
from recon_cli.workspace import atomic
from recon_cli.workspace.atomic import read_json
from recon_cli.workspace.layout import disk_errors

_HERE = Path(__file__).parent
_EACH_VIEW = 1_000  # bytes of text around a view's pictures, at most
_EMPTY = Gallery((), (0, 0), None, 0, ())


def compose(job: Job) -> bytes:
    """Returns the page of a workspace in UTF-8, at most MAX_FILE_BYTES long.

    Raises:
        StageError: nothing was read in yet.
        ManifestError: the manifest of ingest cannot be trusted.
        ConfigError: the settings hold a value that cannot be used.
    """
    stages = standings(job)
    metrics, damaged = _metrics(stages["evaluate"])
    values = _values(job, stages, metrics, damaged)
    views = sum(len(model.views) for model in metrics.models.values()) if metrics else 0
    if not views or metrics is None:
        return _rendered(values, _EMPTY)
    # the text is rendered once without pictures, to know exactly how much room it leaves
    text = len(_rendered(values, _EMPTY)) + _EACH_VIEW * views
    return _rendered(values, gallery(
        stages["evaluate"].folder, metrics, MAX_FILE_BYTES - text, job.progress))


def _metrics(evaluate: Standing) -> tuple[Metrics | None, str]:
    """Returns the scores, or None and why they cannot be read; no reason where there are none."""
    if not evaluate.there:
        return None, ""
    try:
        return read_metrics(evaluate.folder), ""
    except FormatError as error:
        return None, f"The scores are not shown: {error.message}"


def _values(
    job: Job, stages: Mapping[str, Standing], metrics: Metrics | None, damaged: str
) -> dict[str, Any]:
    """Returns what the template shows, but for the views."""
    return {
        "name": job.workspace.root.resolve().name, "stages": stages,
        "made": datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %z"),
        "headline": headline(stages, metrics), "capture": capture(stages),
        "curves": curves(stages, metrics), "decisions": _decisions(stages["train"]),
        "damaged": damaged, "scores": scores(metrics) if metrics and metrics.models else None,
        "sweep": curve(job.workspace.root, stages), "rounds": rounds(stages["prune"]),
        "sweep_command": f"recon prune --sweep -w {shlex.quote(str(job.workspace.root))}",
        "provenance": provenance(stages), "labels": LABELS,
        "longest": max(one.manifest.run.seconds for one in stages.values() if one.manifest),
        "largest": max(
            one.manifest.run.peak_memory_bytes for one in stages.values() if one.manifest),
        "gain": GAIN, "most_error": MOST_ERROR, "stops": ", ".join(legend_stops()),
    }


def _decisions(train: Standing) -> tuple[Mapping[str, Any], ...]:
    """Returns what was decided for this scene and why; nothing where plan.json cannot be read."""
    if not train.there:
        return ()
    try:
        needs = read_json(train.folder / "plan.json")["needs"]
        return tuple({"name": str(one["name"]), "on": bool(one["on"]), "reason": str(one["reason"])}
                     for one in needs)
    except (FormatError, KeyError, TypeError):
        return ()  # volatile: a log of what was tried, which nothing depends on


def _rendered(values: Mapping[str, Any], views: Gallery) -> bytes:
    environment = Environment(
        loader=FileSystemLoader(_HERE), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True)
    environment.filters.update(
        duration=format_duration, megabytes=format_megabytes,
        facts=facts)
    script = (_HERE / "script.js").read_text(encoding="utf-8")
    page = environment.get_template("report.html.j2").render(
        **values, gallery=views, data=[_for_script(one) for one in views.views],
        style=Markup((_HERE / "style.css").read_text(encoding="utf-8")),
        script=Markup(script), script_hash=_hash(script))
    return page.encode(errors="backslashreplace")  # file names need not be UTF-8


def _for_script(view: Shown) -> dict[str, Any]:
    return {
        "name": view.name, "width": view.width, "height": view.height, "masked": view.masked,
        "models": {key: {
            "render": view.renders[key], "difference": view.differences[key],
            "psnr": round(row.psnr_db, 2), "ssim": round(row.ssim, 4)}
            for key, row in view.scores.items()}}


def _hash(script: str) -> str:
    """Returns what lets a browser run this script and no other that may have got into the page."""
    return base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()


FILE = "report.html"
_ENDINGS = (".html", ".htm")


def write(job: Job, out: Path | None) -> str:
    """Writes the page of a workspace and returns where it is, in words.

    Args:
        job: whose workspace it is; nothing in it is run or changed.
        out: the file; None is report.html in the workspace.

    Raises:
        StageError: nothing was read in yet.
        ConfigError: the file would lie where it changes a result or an input, or is no page.
        ManifestError: the manifest of ingest cannot be trusted.
        WorkspaceError: the file cannot be written.
    """
    path = (job.workspace.root / FILE if out is None else out).absolute()
    _check(job, path)
    with disk_errors(job.workspace.root, "reading the workspace"):
        page = compose(job)
    try:
        with disk_errors(path.parent, "writing the report"):
            path.parent.mkdir(parents=True, exist_ok=True)
            atomic.write_bytes(path, page)
    except OSError as error:
        raise WorkspaceError(
            f"{path} cannot be written: {error.strerror}.",
            hint="Give another file with -o.") from error
    return f"{path}: {format_megabytes(len(page))}"


def _check(job: Job, path: Path) -> None:
    """Refuses a file that is no page, or that a stage would take for its own or for an input."""
    if path.suffix.lower() not in _ENDINGS or path.is_dir():
        raise ConfigError(
            f"{path} is no name of a page.", hint="Give a file that ends in .html with -o.")
    root, real = job.workspace.root.resolve(), path.resolve()
    taken = [root / name for name in (".partial", ".old", *(row.name for row in job.table))]
    sources = [Path(source.path).resolve() for source in last_sources(job, "ingest")]
    for folder in taken:
        if real.is_relative_to(folder):
            raise ConfigError(
                f"{path} lies in the folder of a stage, whose files are checked one by one.",
                hint="Give a file elsewhere with -o.")
    for folder in sources:
        if real.is_relative_to(folder) and not real.is_relative_to(root):
            raise ConfigError(
                f"{path} lies in {folder}, which was read in: it would count as a new input.",
                hint="Give a file elsewhere with -o.")
