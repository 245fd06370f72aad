"""The scores as tables: models, the gap to what training saw, pruned against base, every view."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from recon_cli.evaluation.tables import Table
from recon_cli.progress import format_megabytes
from recon_cli.report.records import BASE, MODELS, PRUNED, Interval, Metrics, ModelRow

LABELS = {BASE: "base", PRUNED: "pruned"}


@dataclass(frozen=True)
class Scores:
    """The tables of the page; None where there is nothing to say.

    Attributes:
        models: side by side.
        gap: PSNR of the views that training saw, by model.
        paired: pruned minus base with its interval.
        views: every held-out view, worst first.
        conventions: (score, what it means).
        notes: which held-out views are not scored, sentences.
    """

    models: Table
    gap: Table
    paired: Table | None
    views: Table
    conventions: tuple[tuple[str, str], ...]
    notes: tuple[str, ...]


def scores(metrics: Metrics) -> Scores:
    """Returns the tables of what evaluate measured."""
    models = {key: metrics.models[key] for key in MODELS if key in metrics.models}
    notes = []
    if metrics.unregistered:
        notes.append(f"{len(metrics.unregistered)} held-out frames have no camera and are not "
                     f"scored: {', '.join(metrics.unregistered)}.")
    if metrics.masked_out:
        notes.append(f"Masks leave too little of {len(metrics.masked_out)} held-out views: "
                     f"{', '.join(metrics.masked_out)}.")
    titles = {"psnr": "PSNR", "psnr_8bit": "8-bit", "ssim": "SSIM", "ssim_padded": "SSIM 0-pad",
              "lpips": "LPIPS", "mask": "masks"}
    return Scores(
        _models(models), _gap(models), _paired(metrics.paired) if metrics.paired else None,
        _views(models),
        tuple((titles.get(key, key), text) for key, text in metrics.conventions.items()),
        tuple(notes))


def _models(models: dict[str, ModelRow]) -> Table:
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


def _gap(models: dict[str, ModelRow]) -> Table:
    """Returns PSNR by what the views were used for; the last column says how much is memorised."""
    rows = []
    for key, model in models.items():
        held_out = model.psnr_db if model.gain_psnr_db is None else model.gain_psnr_db
        seen = [model.seen_psnr_db.get(name) for name in ("training", "validation")]
        gap = None if seen[0] is None else seen[0] - held_out
        rows.append((LABELS[key], *(_or_dash(one, ".2f") for one in seen), f"{held_out:.2f}",
                     _or_dash(gap, "+.2f")))
    return Table(("model", "training, dB", "validation, dB", "held out, dB",
                  "training minus held out, dB"), tuple(rows))


def _paired(paired: Mapping[str, Interval]) -> Table:
    forms = {"psnr_db": ("PSNR, dB", "+.2f"), "ssim": ("SSIM", "+.4f")}
    rows: list[tuple[str, ...]] = []
    for key, one in paired.items():
        label, form = forms.get(key, (key, "+.4f"))
        bounds = "one view, no interval" if one.low is None or one.high is None else (
            f"{one.low:{form}} to {one.high:{form}}")
        rows.append((label, f"{one.mean:{form}}", bounds))
    return Table(("score", "mean difference", "95% interval"), tuple(rows))


def _views(models: dict[str, ModelRow]) -> Table:
    keys: Sequence[str] = list(models)
    by_name = {key: {view.name: view for view in models[key].views} for key in keys}
    first = models[keys[0]] if keys else None
    rows = []
    for view in sorted(first.views if first else (), key=lambda view: view.psnr_db):
        found = [by_name[key].get(view.name) for key in keys]
        rows.append((view.name, *(_or_dash(one.psnr_db if one else None, ".2f") for one in found),
                     *(_or_dash(one.ssim if one else None, ".4f") for one in found)))
    return Table(("view", *(f"PSNR {LABELS[key]}, dB" for key in keys),
                  *(f"SSIM {LABELS[key]}" for key in keys)), tuple(rows))


def _or_dash(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)
