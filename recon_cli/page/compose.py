"""The page: everything gathered, put into the template, pictures as large as the file allows."""

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

from recon_cli.atomic import read_json
from recon_cli.errors import FormatError
from recon_cli.execute import Job
from recon_cli.page.capture import capture
from recon_cli.page.facts import facts
from recon_cli.page.headline import headline
from recon_cli.page.pictures import GAIN, MAX_FILE_BYTES, MOST_ERROR, legend_stops
from recon_cli.page.provenance import provenance
from recon_cli.page.pruning import curve, rounds
from recon_cli.page.records import Metrics, read_metrics
from recon_cli.page.scores import LABELS, scores
from recon_cli.page.standing import Standing, standings
from recon_cli.page.training import curves
from recon_cli.page.views import Gallery, Shown, gallery
from recon_cli.report import duration, megabytes

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
        duration=duration, megabytes=megabytes,
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
