"""Scores and logs of a workspace, and the tables of scores on the page.

The files of a stale stage may have been edited by hand, and no digest covers logs: unexpected
content becomes a FormatError, which the page shows in its place.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from recon_cli.config.stages import MODEL_LABELS
from recon_cli.errors import FormatError, ManifestError
from recon_cli.evaluation.intervals import Interval
from recon_cli.evaluation.scores import (
    Metrics,
    ModelMetrics,
    Table,
    model_table,
    or_dash,
    view_table,
)
from recon_cli.trust.records import PoorlySeenRegion, TrustRecord
from recon_cli.workspace.summaries import LogRow

if TYPE_CHECKING:
    from recon_cli.report.stage_status import StageReports

BASE, PRUNED = MODELS = ("base", "pruned")
_TITLES = {"psnr": "PSNR", "psnr_8bit": "8-bit", "ssim": "SSIM", "ssim_padded": "SSIM 0-pad",
           "lpips": "LPIPS", "mask": "masks"}


def read_trust_record(stages: StageReports) -> TrustRecord | None:
    """Returns evaluate's record on trust; None without it. FormatError if it is damaged."""
    stage = stages["evaluate"]
    if not stage.there:
        return None
    try:
        return TrustRecord.read(stage.folder)
    except ManifestError as error:
        raise FormatError(error.message) from error


def read_regions(stages: StageReports) -> tuple[PoorlySeenRegion, ...]:
    """Returns the poorly seen regions, for the plan; none where nothing can be read."""
    try:
        record = read_trust_record(stages)
    except FormatError:  # which the section says
        return ()
    return record.poorly_seen if record else ()


def read_metrics(folder: Path) -> Metrics:
    """Returns the scores in evaluate's folder; FormatError if metrics.json does not hold them."""
    with _format_errors(folder / Metrics.FILE):
        metrics = Metrics.read(folder)
        json.dumps(metrics.to_json(), allow_nan=False)  # ValueError: the page cannot show these
        return metrics


def read_log(path: Path) -> tuple[LogRow, ...]:
    """Returns the rows of a log.jsonl; FormatError if it is gone or damaged."""
    with _format_errors(path):
        path.stat()  # OSError
        return LogRow.read_all(path)


@contextmanager
def _format_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise FormatError(f"{path.name} cannot be read: {error.strerror}.") from error
    except (ManifestError, ValueError) as error:
        raise FormatError(f"{path.name} was not written by recon, or is damaged.") from error


@dataclass(frozen=True)
class ScoreTables:
    """The tables of the page."""

    models: Table  # side by side
    gap: Table  # PSNR of the views that training used, by model
    paired: Table | None  # pruned minus base with its interval; None with one model
    views: Table  # every held-out view, worst first
    conventions: tuple[tuple[str, str], ...]  # (score, its definition)
    notes: tuple[str, ...]  # which held-out views are not scored, a sentence each


def build_scores(metrics: Metrics | None) -> ScoreTables | None:
    """Returns the tables of the scores of evaluate; None where no model was scored."""
    if metrics is None or not metrics.models:
        return None
    models = {key: metrics.models[key] for key in MODELS if key in metrics.models}
    notes = [f"{metrics.coverage[0].upper()}{metrics.coverage[1:]}."] if metrics.coverage else []
    if metrics.unregistered_test:
        notes.append(f"{len(metrics.unregistered_test)} held-out frames have no camera and are not "
                     f"scored: {', '.join(metrics.unregistered_test)}.")
    if metrics.masked_out_test:
        notes.append(f"Masks leave too little of {len(metrics.masked_out_test)} held-out views: "
                     f"{', '.join(metrics.masked_out_test)}.")
    notes += [f"{MODEL_LABELS[key].capitalize()}: {moving}." for key, model in models.items()
              if (moving := metrics.describe_moving(model))]
    conventions = {title: getattr(metrics, f"{key}_convention") for key, title in _TITLES.items()}
    by_label = {MODEL_LABELS[key]: model for key, model in models.items()}
    views = view_table(by_label)
    return ScoreTables(
        model_table(by_label), _gap_table(by_label),
        _difference_table(metrics.pruned_minus_base) if metrics.pruned_minus_base else None,
        replace(views, rows=sorted(views.rows, key=lambda row: float(row[1]))),
        tuple((title, text) for title, text in conventions.items() if text), tuple(notes))


def _gap_table(models: Mapping[str, ModelMetrics]) -> Table:
    """Returns PSNR by split; the last column shows how far the model overfits."""
    rows = []
    for label, model in models.items():
        held_out = model.gap_psnr_db
        training, validation = map(model.seen_psnr_db.get, ("training", "validation"))
        gap = None if training is None else training - held_out
        rows.append((label, or_dash(training, ".2f"), or_dash(validation, ".2f"),
                     f"{held_out:.2f}", or_dash(gap, "+.2f")))
    return Table(("model", "training, dB", "validation, dB", "held out, dB",
                  "training minus held out, dB"), rows)


def _difference_table(differences: Mapping[str, Interval]) -> Table:
    formats = {"psnr_db": ("PSNR, dB", "+.2f"), "ssim": ("SSIM", "+.4f")}
    rows = []
    for key, difference in differences.items():
        label, form = formats.get(key, (key, "+.4f"))
        low, high = difference.low, difference.high
        bounds = "one view, no interval" if low is None or high is None else (
            f"{low:{form}} to {high:{form}}")
        rows.append((label, f"{difference.mean:{form}}", bounds))
    return Table(("score", "mean difference", "95% interval"), rows)
