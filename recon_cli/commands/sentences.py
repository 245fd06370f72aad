"""What is said of results: a sentence about each stage, and the end of a run.

The end says what was made, where it lies, how good it is, and what to type next.
"""

from __future__ import annotations

import logging
import webbrowser
from collections.abc import Mapping, Sequence
from functools import singledispatch
from typing import Any

from recon_cli.commands.console import say
from recon_cli.config.stages import MODEL_LABELS
from recon_cli.errors import ManifestError, command_line, format_count
from recon_cli.pipeline.execute import Job, Outcome
from recon_cli.pipeline.plan import check_parts
from recon_cli.progress import format_duration, format_megabytes
from recon_cli.stages import IMPORT
from recon_cli.stages import stage as stage_row
from recon_cli.workspace.summaries import (
    DenoiseSummary,
    EvaluateSummary,
    ExportedFile,
    ExportSummary,
    ImportSummary,
    IngestSummary,
    JsonRecord,
    PlaceSummary,
    PruneSummary,
    SfmSummary,
    TrainSummary,
)

logger = logging.getLogger("recon")


def report_outcome(outcome: Outcome) -> None:
    """Prints one line about a stage: its result, or that it is up to date."""
    run = outcome.manifest.run
    known = {"outcome": outcome, "event": "done", "stage": outcome.stage, "seconds": run.seconds}
    if outcome.ran:
        sentence = describe_summary(outcome.stage, run.summary)
        logger.info("%s (%s)", ": ".join(filter(None, [outcome.stage, sentence])),
                    format_duration(run.seconds), extra=known)
        return
    logger.info("%s is up to date", outcome.stage, extra=known)
    for notice in run.summary.get("notices") or ():
        logger.warning("%s", notice)


def end_run(job: Job, *, open_page: bool = False) -> None:
    """Writes the report, and prints the results of a run that is complete."""
    from recon_cli.report.build import FILE, write_report
    from recon_cli.trust.quality import read_quality
    from recon_cli.workspace.records import name_photos, read_frame_list  # imports numpy

    workspace = job.workspace
    folder, ingest = workspace.folder("export"), workspace.folder("ingest")
    manifest, place = workspace.manifest("export"), workspace.manifest("place")
    assert manifest is not None, "the run has exported"
    page = next((folder / check.manifest.run.summary["file"]
                 for check in check_parts(job, "export")
                 if check.row.part == "html" and check.manifest and check.fresh), None)
    scene = folder / ExportSummary.from_json(manifest.run.summary).file
    write_report(job, None)
    quality = read_quality(
        workspace.folder("evaluate"), PlaceSummary.from_json(place.run.summary) if place else None,
        read_frame_list(ingest).frames)
    say("")
    for name, path in (("scene", scene), ("page", page), (
            "report", workspace.root / FILE)):
        if path is not None:
            say(f"{name + ':':9}{path} ({format_megabytes(path.stat().st_size)})")
    say(f"quality: {name_photos(ingest)(str(quality))}")
    say("next:    " + (command_line("view") if page is None else (
        f"open {page.name} in a browser or send it; "
        f"{command_line('render --tour --out walk.mp4')}")))
    if open_page:
        webbrowser.open((page or workspace.root / FILE).resolve().as_uri())


def describe_summary(stage: str, summary: Mapping[str, Any]) -> str:
    """Returns a sentence about a stage's summary; empty where another version of recon wrote it."""
    imported = stage == IMPORT.name and "sha256" in summary
    try:
        return describe((IMPORT if imported else stage_row(stage)).summary.from_json(summary))
    except ManifestError:  # the stage is stale then, and its reason is shown
        return ""


@singledispatch
def describe(record: JsonRecord) -> str:  # noqa: ARG001
    """Returns a sentence about a stage's summary; empty for a record that has none."""
    return ""


@describe.register
def _(ingest: IngestSummary) -> str:
    source = {"mixed": "videos and photos"}.get(ingest.kind, ingest.kind)
    of = f" of {ingest.decoded_frames:,}" if ingest.decoded_frames else ""
    return _join([
        f"{ingest.frames:,}{of} frames ({source}, {ingest.width}x{ingest.height}), "
        f"{ingest.held_out:,} held out for the score",
        f"{ingest.dropped_blurred:,} too blurred, clipped or flat" if ingest.dropped_blurred
        else "",
        f"{ingest.lost_frames:,} damaged or missing" if ingest.lost_frames else "",
        f"{format_count(len(ingest.skipped), 'file')} skipped" if ingest.skipped else ""])


@describe.register
def _(denoise: DenoiseSummary) -> str:
    return (f"noise {denoise.median_sigma_255:.1f} of 255, {denoise.denoised:,} of "
            f"{denoise.frames:,} frames filtered")


@describe.register
def _(sfm: SfmSummary) -> str:
    mapped = sum(len(part.names) for part in sfm.parts)
    return f"{mapped:,} of {sfm.frames:,} frames mapped"


@describe.register
def _(cameras: PlaceSummary) -> str:
    if cameras.trusted is None:
        trust = "the poses of the data set are used" if cameras.poses else ""
    else:
        trust = f"the model is {'' if cameras.trusted else 'NOT '}trusted"
    return _join([
        f"{cameras.registered:,} of {cameras.frames:,} frames placed",
        f"this is part {cameras.part} of {len(cameras.parts)}" if cameras.part is not None else "",
        f"{len(cameras.left_out):,} left out" if cameras.left_out else "", trust])


@describe.register
def _(train: TrainSummary) -> str:
    early = train.stopped_early_at is not None
    return _join([
        f"{train.gaussians:,} Gaussians after {train.iterations:,} iterations"
        f"{f' in {train.blocks} blocks' if train.blocks else ''}"
        f"{_validation(train.validation_psnr_db)}",
        f"stopped early, {train.planned_iterations:,} were planned" if early else "",
        f"continued from {train.imported_from}" if train.imported_from else "",
        f"{train.moving.share:.1%} of the pixels masked, as they move" if train.moving else "",
        f"{format_count(train.skipped_steps, 'step')} skipped" if train.skipped_steps else ""])


@describe.register
def _(imported: ImportSummary) -> str:
    views = format_count(imported.views, "training view")
    score = ("" if imported.training_psnr_db is None else
             f", {imported.training_psnr_db:.2f} dB on {views}")
    return f"{imported.gaussians:,} Gaussians from {imported.imported_from}{score}"


@describe.register
def _(prune: PruneSummary) -> str:
    before = prune.validation_psnr_db_before
    return (f"{prune.gaussians:,} of {prune.gaussians_before:,} Gaussians kept"
            f"{_validation(prune.validation_psnr_db)}"
            f"{'' if before is None else f' ({before:.2f} dB before)'}")


@describe.register
def _(scores: EvaluateSummary) -> str:
    found = (("", scores.base_psnr_db, scores.base_ssim),
             ("the compact model ", scores.pruned_psnr_db, scores.pruned_ssim))
    models = [f"{model}{psnr:.2f} dB (SSIM {ssim:.3f})"
              for model, psnr, ssim in found if psnr is not None and ssim is not None]
    missing = len(scores.unregistered_test)
    return _join([
        f"{', '.join(models)} on {format_count(scores.test_views, 'held-out view')}",
        f"{format_count(missing, 'held-out view')} without a camera" if missing else ""])


@describe.register
def _(export: ExportSummary) -> str:
    model = MODEL_LABELS.get(export.model, export.model)
    return (f"{export.file} ({model} model, {export.gaussians:,} Gaussians, "
            f"{format_megabytes(export.bytes)})")


@describe.register
def _(exported: ExportedFile) -> str:
    facts = [
        "" if exported.bytes is None else format_megabytes(exported.bytes),
        "" if exported.smaller is None else f"{exported.smaller:.1f}x smaller",
        "" if exported.psnr_change_db is None else f"{exported.psnr_change_db:+.2f} dB"]
    text = ", ".join(filter(None, facts))
    return f"{exported.file} ({text})" if text else exported.file


def _validation(psnr_db: float | None) -> str:
    return "" if psnr_db is None else f", {psnr_db:.2f} dB on validation views"


def _join(parts: Sequence[str]) -> str:
    return "; ".join(filter(None, parts))
