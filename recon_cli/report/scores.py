"""The scores as tables: models, the gap to training views, pruned against base, every view."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from recon_cli.evaluation.intervals import Interval
from recon_cli.evaluation.tables import Table
from recon_cli.progress import format_megabytes
from recon_cli.report.records import BASE, MODELS, PRUNED, Metrics, ModelRow

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
