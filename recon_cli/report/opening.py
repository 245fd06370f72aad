"""What the page opens with: the room in a large picture, its quality in a word, its files."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from markupsafe import Markup

from recon_cli.errors import FormatError
from recon_cli.evaluation.scores import Metrics
from recon_cli.report.gallery import ENCODINGS, read_picture
from recon_cli.report.records import read_trust_record
from recon_cli.report.stage_status import StageReport, StageReports
from recon_cli.splats.html import find_title
from recon_cli.trust.quality import Quality, delivered_model, describe_quality, name_view
from recon_cli.trust.records import TrustRecord
from recon_cli.workspace.export_formats import EXPORT_FORMATS
from recon_cli.workspace.records import FOLDER, Frame, read_frame_list
from recon_cli.workspace.summaries import ExportedFile, ExportSummary, PlaceSummary


@dataclass(frozen=True)
class ExportLink:
    """A file of the export and where it is, as seen from the page."""

    file: str  # name
    href: str  # empty where the file is gone
    bytes: int | None  # None for a folder of unknown size
    share: float | None  # of the .ply's bytes
    psnr_change: str  # in words
    stale: str  # why; empty where it is up to date


@dataclass(frozen=True)
class Opening:
    """The top of the page beside its figures."""

    title: str
    picture: Markup | None  # data URI; None where there is nothing to show
    caption: str
    quality: Quality
    trust: TrustRecord | None  # that the quality is of; None if it was not measured
    stale: bool  # the quality is of a result that is not fresh
    files: tuple[ExportLink, ...]


def build_opening(stages: StageReports, metrics: Metrics | None, page: Path) -> Opening:
    """Returns the top of a page that is written into the folder `page`."""
    try:
        frames = read_frame_list(stages["ingest"].folder).frames
    except (FormatError, OSError):  # which the section on the capture says
        frames = ()
    try:
        trust = read_trust_record(stages)
    except FormatError:  # which the section on trust says
        trust = None
    picture, caption = _find_picture(stages, metrics, frames)
    quality = describe_quality(metrics, trust, stages["place"].read_summary(PlaceSummary), frames)
    return Opening(
        _find_name(stages), picture, caption, quality, trust, not stages["evaluate"].fresh,
        tuple(_link_files(stages["export"], page)))


def _find_name(stages: StageReports) -> str:
    """Returns the title of the page, as that of an exported one: given, or the capture's name."""
    ingest = stages["ingest"].manifest
    given = next((part.manifest.key.config.get("title") for part in stages["export"].parts
                  if part.name == "export.html" and part.manifest), None)
    sources = ingest.key.sources if ingest else ()
    return str(given) if given else find_title(Path(sources[0].path).name if sources else "")


def _find_picture(
    stages: StageReports, metrics: Metrics | None, frames: tuple[Frame, ...]
) -> tuple[Markup | None, str]:
    """Returns a render of the room, or else a frame of its capture, with its caption.

    Of the better half of the held-out views it is the one with most in it: the largest file.
    """
    model = delivered_model(metrics)
    if metrics is not None and model is not None:
        views = sorted(metrics.models[model].views, key=lambda view: -view.psnr_db)
        folder = stages["evaluate"].folder / "renders" / model
        better = [folder / f"{Path(view.name).stem}.png" for view in views[:-(-len(views) // 2)]]
        for path in sorted(filter(Path.is_file, better), key=lambda path: -path.stat().st_size):
            if (picture := _try_picture(path)) is not None:
                return picture, (f"Rendered by the scene where {name_view(path.name, frames)} was "
                                 "taken, a view that it was not trained on.")
    if frames:
        frame = frames[len(frames) // 2].name
        picture = _try_picture(stages["ingest"].folder / FOLDER / frame)
        return picture, f"{frame}, a frame of the capture." if picture else ""
    return None, ""


def _try_picture(path: Path) -> Markup | None:
    try:
        return read_picture(path, ENCODINGS[1])
    except (FormatError, OSError):
        return None


def _link_files(export: StageReport, page: Path) -> Iterator[ExportLink]:
    """Yields the files of the last export."""
    summary = export.read_summary(ExportSummary)
    if summary is None:
        return
    yield ExportLink(summary.file, _link(export.folder / summary.file, page), summary.bytes, 1.0,
                     "exact", "")
    for part in export.parts:
        file = part.read_summary(ExportedFile)
        if file is None:
            continue
        first = export.folder / EXPORT_FORMATS[part.name.partition(".")[2]].main_file
        yield ExportLink(
            file.file, _link(first, page), file.bytes,
            file.bytes / summary.bytes if file.bytes is not None and summary.bytes else None,
            _describe_change(file), "" if part.fresh else part.why)


def _describe_change(file: ExportedFile) -> str:
    """Returns the PSNR that a file of Gaussians gains, or how much of a mesh is inferred."""
    if file.inferred_share:
        return f"{file.inferred_share:.1%} inferred"
    return "-" if file.psnr_change_db is None else f"{file.psnr_change_db:+.2f} dB"


def _link(path: Path, page: Path) -> str:
    """Returns the address of a file relative to the folder of the page; empty if it is gone."""
    if not path.exists():
        return ""
    try:
        relative = os.path.relpath(path.absolute(), page)
    except ValueError:  # on another drive of Windows
        return path.absolute().as_uri()
    return quote(os.fsencode(relative.replace(os.sep, "/")))
