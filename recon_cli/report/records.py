"""Scores, logs and sweeps of a workspace, read into types.

The files of a stale stage may have been edited by hand, and no digest covers logs: content that is
not as expected becomes a FormatError, which the page shows in its place.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from recon_cli.errors import FormatError
from recon_cli.evaluation.intervals import Interval
from recon_cli.evaluation.scores import Table
from recon_cli.progress import format_megabytes
from recon_cli.workspace.atomic import read_json

BASE, PRUNED = MODELS = ("base", "pruned")


@dataclass(frozen=True)
class ViewRow:
    """The scores of one held-out view."""

    name: str
    psnr_db: float
    ssim: float


@dataclass(frozen=True)
class ModelRow:
    """The mean scores of one model; docs/workspace.md explains the keys."""

    psnr_db: float
    psnr_8bit_db: float
    ssim: float
    ssim_padded: float
    lpips: float | None
    gaussians: int
    bytes: int
    render_ms: float
    train_seconds: float | None
    gain_psnr_db: float | None
    seen_psnr_db: Mapping[str, float]
    views: tuple[ViewRow, ...]


@dataclass(frozen=True)
class Metrics:
    """The content of evaluate's metrics.json."""

    models: Mapping[str, ModelRow]
    paired: Mapping[str, Interval]  # pruned minus base, by score
    conventions: Mapping[str, str]  # by score
    unregistered: tuple[str, ...]  # held-out frames without a camera
    masked_out: tuple[str, ...]  # held-out frames of which masks leave too little


@dataclass(frozen=True)
class LogRow:
    """One line of log.jsonl; None where it holds no such value."""

    iteration: int
    seconds: float
    loss: float | None
    psnr_db: float | None
    gaussians: int | None
    goes_on_at: int | None


@dataclass(frozen=True)
class SweepTrial:
    """One way to prune, scored on validation views after recovery."""

    score: str
    ratio: float | None
    gaussians: int
    psnr_db: float


@dataclass(frozen=True)
class Sweep:
    """The content of sweep.json, which `recon prune --sweep` writes."""

    trials: tuple[SweepTrial, ...]
    score: str
    steps: int
    views: int
    of_train: str | None  # digest of the training it started from; None in files of older versions


def read_metrics(folder: Path) -> Metrics:
    """Returns the scores in evaluate's folder; FormatError if metrics.json does not hold them."""
    path = folder / "metrics.json"
    value = read_json(path)
    with _format_errors(path):
        return Metrics(
            {key: _model(value["models"][key]) for key in MODELS if key in value["models"]},
            {key: Interval(
                _number(paired["mean"]), _optional(paired["low"]), _optional(paired["high"]))
             for key, paired in value.get("pruned_minus_base", {}).items()},
            {key.removesuffix("_convention"): str(text) for key, text in value.items()
             if key.endswith("_convention")},
            tuple(map(str, value.get("unregistered_test", ()))),
            tuple(map(str, value.get("masked_out_test", ()))))


def read_log(path: Path) -> tuple[LogRow, ...]:
    """Returns the rows of a log.jsonl without an incomplete last line; FormatError if damaged."""
    with _format_errors(path):
        lines = path.read_text(encoding="utf-8").splitlines(True)
        rows = [json.loads(line) for line in lines if line.endswith("\n")]
        return tuple(LogRow(
            int(row["iteration"]), _number(row["seconds"]), _optional(row.get("loss")),
            _optional(row.get("validation_psnr_db")), _optional_int(row.get("gaussians")),
            _optional_int(row.get("goes_on_at"))) for row in rows)


def read_sweep(path: Path) -> Sweep:
    """Returns the trials of a sweep.json; FormatError if it does not hold them."""
    value = read_json(path)
    with _format_errors(path):
        return Sweep(
            tuple(SweepTrial(
                str(trial["score"]), _optional(trial["ratio"]), int(trial["gaussians"]),
                _number(trial["recovered"]["psnr_db"])) for trial in value["trials"]),
            str(value["equal_seconds_of"]), int(value["recovery_steps"]),
            int(value["validation_views"]), value.get("of_train"))


def _model(value: Any) -> ModelRow:
    views = tuple(ViewRow(str(view["name"]), _number(view["psnr_db"]), _number(view["ssim"]))
                  for view in value["views"])
    return ModelRow(
        _number(value["psnr_db"]), _number(value["psnr_8bit_db"]), _number(value["ssim"]),
        _number(value["ssim_padded"]), _optional(value.get("lpips")), int(value["gaussians"]),
        int(value["bytes"]), _number(value["render_ms"]), _optional(value["train_seconds"]),
        _optional(value.get("gain_psnr_db")),
        {str(key): _number(decibels) for key, decibels in value["seen_psnr_db"].items()}, views)


def _number(value: Any) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"{value} is not finite")
    return number


def _optional(value: Any) -> float | None:
    """Returns a number that may be missing; one that is not finite counts as missing."""
    return None if value is None or not math.isfinite(float(value)) else float(value)


def _optional_int(value: Any) -> int | None:
    return None if value is None else int(value)


@contextmanager
def _format_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise FormatError(f"{path.name} cannot be read: {error.strerror}.") from error
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise FormatError(f"{path.name} does not hold what recon writes.") from error


LABELS = {BASE: "base", PRUNED: "pruned"}


_TITLES = {"psnr": "PSNR", "psnr_8bit": "8-bit", "ssim": "SSIM", "ssim_padded": "SSIM 0-pad",
           "lpips": "LPIPS", "mask": "masks"}


@dataclass(frozen=True)
class Scores:
    """The tables of the page."""

    models: Table  # side by side
    gap: Table  # PSNR of the views that training used, by model
    paired: Table | None  # pruned minus base with its interval; None with one model
    views: Table  # every held-out view, worst first
    conventions: tuple[tuple[str, str], ...]  # (score, its definition)
    notes: tuple[str, ...]  # which held-out views are not scored, a sentence each


def build_scores(metrics: Metrics) -> Scores:
    """Returns the tables of what evaluate measured."""
    models = {key: metrics.models[key] for key in MODELS if key in metrics.models}
    notes = []
    if metrics.unregistered:
        notes.append(f"{len(metrics.unregistered)} held-out frames have no camera and are not "
                     f"scored: {', '.join(metrics.unregistered)}.")
    if metrics.masked_out:
        notes.append(f"Masks leave too little of {len(metrics.masked_out)} held-out views: "
                     f"{', '.join(metrics.masked_out)}.")
    return Scores(
        _model_table(models), _gap_table(models),
        _paired_table(metrics.paired) if metrics.paired else None, _view_table(models),
        tuple((_TITLES.get(key, key), text) for key, text in metrics.conventions.items()),
        tuple(notes))


def _model_table(models: Mapping[str, ModelRow]) -> Table:
    perceptual = any(model.lpips is not None for model in models.values())
    gains = any(model.gain_psnr_db is not None for model in models.values())
    return Table(
        ("model", "PSNR, dB", "8-bit, dB", *["PSNR after gains, dB"] * gains, "SSIM", "SSIM 0-pad",
         *["LPIPS"] * perceptual, "Gaussians", "size", "ms a view", "training, s"),
        tuple((
            LABELS[key], f"{model.psnr_db:.2f}", f"{model.psnr_8bit_db:.2f}",
            *[_or_dash(model.gain_psnr_db, ".2f")] * gains, f"{model.ssim:.4f}",
            f"{model.ssim_padded:.4f}", *[_or_dash(model.lpips, ".4f")] * perceptual,
            f"{model.gaussians:,}", format_megabytes(model.bytes), f"{model.render_ms:.0f}",
            _or_dash(model.train_seconds, ".0f")) for key, model in models.items()))


def _gap_table(models: Mapping[str, ModelRow]) -> Table:
    """Returns PSNR by split; the last column shows how far the model overfits."""
    rows = []
    for key, model in models.items():
        held_out = model.psnr_db if model.gain_psnr_db is None else model.gain_psnr_db
        training, validation = map(model.seen_psnr_db.get, ("training", "validation"))
        gap = None if training is None else training - held_out
        rows.append((LABELS[key], _or_dash(training, ".2f"), _or_dash(validation, ".2f"),
                     f"{held_out:.2f}", _or_dash(gap, "+.2f")))
    return Table(("model", "training, dB", "validation, dB", "held out, dB",
                  "training minus held out, dB"), tuple(rows))


def _paired_table(paired: Mapping[str, Interval]) -> Table:
    formats = {"psnr_db": ("PSNR, dB", "+.2f"), "ssim": ("SSIM", "+.4f")}
    rows = []
    for key, difference in paired.items():
        label, form = formats.get(key, (key, "+.4f"))
        low, high = difference.low, difference.high
        bounds = "one view, no interval" if low is None or high is None else (
            f"{low:{form}} to {high:{form}}")
        rows.append((label, f"{difference.mean:{form}}", bounds))
    return Table(("score", "mean difference", "95% interval"), tuple(rows))


def _view_table(models: Mapping[str, ModelRow]) -> Table:
    by_name = [{view.name: view for view in model.views} for model in models.values()]
    first = next(iter(models.values()), None)
    rows = []
    for view in sorted(first.views if first else (), key=lambda view: view.psnr_db):
        scores = [views.get(view.name) for views in by_name]
        rows.append((view.name, *(_or_dash(row.psnr_db if row else None, ".2f") for row in scores),
                     *(_or_dash(row.ssim if row else None, ".4f") for row in scores)))
    return Table(("view", *(f"PSNR {LABELS[key]}, dB" for key in models),
                  *(f"SSIM {LABELS[key]}" for key in models)), tuple(rows))


def _or_dash(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)
