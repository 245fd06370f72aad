"""evaluate: scores every model on the held-out views, against the original pixels.

The .ply is read back and rendered, so that what is handed out is what is measured. Writes
metrics.json, metrics.csv, metrics.md, metrics.tex, table.txt, and pictures: renders/<model>/,
truth/ and difference/<model>/ (absolute error times four). Pixels that a mask ignores are not
scored: they are painted in one colour in truth/ and black in difference/.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.config.stages import EvaluateConfig
from recon_cli.context import StageContext, StageInputs, Summary
from recon_cli.evaluation.intervals import Interval, paired_bootstrap
from recon_cli.evaluation.metrics import (
    LPIPS_CONVENTION,
    MASK_CONVENTION,
    PSNR_8BIT_CONVENTION,
    PSNR_CONVENTION,
    SSIM_CONVENTION,
    SSIM_PADDED_CONVENTION,
    load_lpips,
)
from recon_cli.evaluation.reference_views import (
    LABELS,
    ReferenceView,
    RenderScores,
    evenly_spread,
    load_held_out_views,
    load_reference_views,
    load_scene,
    mean_psnr,
    reference_digest,
    score_views,
    size_summary,
    sizes_of,
)
from recon_cli.evaluation.scores import ModelScore, csv_table, model_table, paper_table, view_table
from recon_cli.io.images import eight_bit, write_png
from recon_cli.io.import_record import Origin
from recon_cli.io.ply import read_ply
from recon_cli.scene.scene import Scene
from recon_cli.train.runner import LOG, read_config, seconds_at
from recon_cli.workspace.atomic import write_bytes, write_json

_GAIN = 4  # of the difference images
_EVER = 1 << 62  # an iteration beyond any
_SEEN_VIEWS = 20  # training and validation views that are scored beside, at most


@dataclass(frozen=True)
class _Model:
    """One model's scores.

    Attributes:
        score: on the held-out views.
        corrected_db: its mean PSNR there after the best gain per channel of each view.
        seen_db: mean PSNR on some training and validation views, by the name of the split, after
            the best gain where training had gains.
    """

    score: ModelScore
    corrected_db: float
    seen_db: Mapping[str, float]


def run(config: EvaluateConfig, inputs: StageInputs, out: Path, ctx: StageContext) -> Summary:
    """Renders and scores the held-out views and returns the means of each model."""
    train_config = read_config(inputs.folders["train"])
    origin = Origin.of(inputs.folders["train"])
    scene = load_scene(inputs, validation=train_config.validation)
    size = config.max_size or train_config.max_size
    held_out = load_held_out_views(scene, size, ctx)
    # where training refined its cameras, their images are no longer what these cameras show
    splits = {"training": scene.train if train_config.poses != "on" else (),
              "validation": scene.validation}
    seen = {name: views for name, split in splits.items() if (
        views := load_reference_views(evenly_spread(split, _SEEN_VIEWS), size))}
    stages = {"base": "train", "pruned": "prune"}
    folders = {model: inputs.folders[stage] for model, stage in stages.items()
               if stage in inputs.folders}
    for view in held_out:
        _save(out / "truth" / f"{Path(view.name).stem}.png", view.image)
    perceptual, lacking = load_lpips()
    lacking = lacking or "views with a mask have none"
    gains = train_config.exposure == "on"
    models: dict[str, _Model] = {}
    total = len(folders) * (len(held_out) + sum(map(len, seen.values())))
    with ctx.progress.bar("evaluate", total, unit="view") as bar:
        for model, folder in folders.items():
            splats = read_ply(folder / "splats.ply").map(lambda tensor: tensor.to(ctx.device))

            def save(
                view: ReferenceView, image: NDArray[np.float32], model: str = model
            ) -> None:
                _save_pictures(out, model, view, image)
                bar.advance()

            degree = train_config.sh_degree
            scores = score_views(
                splats, held_out, degree, ctx.backend, perceptual=perceptual, on_view=save)
            seen_db = {name: mean_psnr(
                splats, views, degree, ctx.backend, corrected=gains, on_view=bar.advance)
                for name, views in seen.items()}
            seconds = None if origin else seconds_at(folder / LOG, _EVER)
            models[model] = _Model(
                _model_score(model, folder, scores, len(splats), seconds), scores.corrected_db,
                seen_db)
    if scene.unregistered_test:
        ctx.notice(f"{len(scene.unregistered_test)} held-out views have no camera and are not "
                   f"scored: {', '.join(scene.unregistered_test)}")
    for text in origin.warnings() if origin else ():
        ctx.notice(text)
    _write(out, inputs, models, held_out, scene, gains=gains, lacking=lacking)
    return {
        **_counts(held_out, scene),
        **{f"{name}_{key}": round(getattr(model.score, key), 4)
           for name, model in models.items() for key in ("psnr_db", "ssim", "gaussians")},
        **{f"{name}_gain_psnr_db": round(model.corrected_db, 4)
           for name, model in models.items() if gains},
    }


def _model_score(
    model: str, folder: Path, scores: RenderScores, gaussians: int, train_seconds: float | None
) -> ModelScore:
    return ModelScore(
        LABELS[model], scores.views, gaussians, (folder / "splats.ply").stat().st_size,
        scores.render_ms, train_seconds)


def _save_pictures(
    out: Path, model: str, view: ReferenceView, image: NDArray[np.float32]
) -> None:
    """Saves the render of a held-out view, and its difference from the photo."""
    name, rendered = f"{Path(view.name).stem}.png", eight_bit(image)
    _save(out / "renders" / model / name, rendered)
    difference = np.abs(rendered.astype(np.int16) - view.image) * _GAIN
    if view.mask is not None:
        difference[~view.mask] = 0
    _save(out / "difference" / model / name, difference.clip(0, 255).astype(np.uint8))


def _save(path: Path, image: NDArray[np.uint8]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, image)


def _write(
    out: Path, inputs: StageInputs, models: Mapping[str, _Model], held_out: Sequence[ReferenceView],
    scene: Scene, *, gains: bool, lacking: str,
) -> None:
    """Writes the scores as JSON and as tables."""
    scores = {name: model.score for name, model in models.items()}
    measured = next(iter(scores.values())).lpips is not None
    masked = sum(view.mask is not None for view in held_out)
    origin = Origin.of(inputs.folders["train"])
    write_json(out / "metrics.json", {
        "models": {name: _record(model, gains=gains) for name, model in models.items()},
        **({"pruned_minus_base": {
            key: dataclasses.asdict(_difference(scores, key)) for key in ("psnr_db", "ssim")}}
           if len(scores) == 2 else {}),
        "psnr_convention": PSNR_CONVENTION, "psnr_8bit_convention": PSNR_8BIT_CONVENTION,
        "ssim_convention": SSIM_CONVENTION, "ssim_padded_convention": SSIM_PADDED_CONVENTION,
        "lpips_convention": LPIPS_CONVENTION if measured else f"not measured: {lacking}",
        **({"mask_convention": MASK_CONVENTION} if masked else {}),
        "truth_digest": reference_digest(held_out),
        **size_summary([view.camera for view in held_out]), **_counts(held_out, scene),
        **({"imported_from": origin.file} if origin else {}),
    })
    table = list(scores.values())
    note = _note(held_out, scene, masked, lacking=None if measured else lacking)
    note += "".join(f"{text}\n" for text in origin.warnings()) if origin else ""
    for name, model in models.items():
        if gains:
            note += (f"{LABELS[name]}, after the best gain per channel of each view: "
                     f"{model.corrected_db:.2f} dB\n")
        note += f"{LABELS[name]}, {_gap(model, gains=gains)}\n"
    if len(scores) == 2:
        note += (f"pruned minus base: PSNR {_difference(scores, 'psnr_db').text('+.2f')} dB, SSIM "
                 f"{_difference(scores, 'ssim').text('+.4f')} (95% by bootstrap over the views)\n")
    first = model_table(table)
    write_bytes(out / "table.txt", f"{first.text(rule=True)}\n{note}".encode())
    write_bytes(
        out / "metrics.md", f"{first.markdown()}\n{view_table(table).markdown()}\n{note}".encode())
    write_bytes(out / "metrics.csv", csv_table(scores).encode())
    tex = first.latex()
    if len(scores) == 2:
        name = inputs.folders["ingest"].parent.resolve().name
        tex += "\n" + paper_table({name: (scores["base"], scores["pruned"])}).latex()
    write_bytes(out / "metrics.tex", tex.encode())


def _record(model: _Model, *, gains: bool) -> Summary:
    """Returns what metrics.json holds of a model."""
    score = model.score
    return {
        "psnr_db": score.psnr_db, "psnr_8bit_db": score.psnr_8bit_db, "ssim": score.ssim,
        "ssim_padded": score.ssim_padded,
        **({"lpips": score.lpips} if score.lpips is not None else {}),
        "gaussians": score.gaussians, "bytes": score.bytes, "render_ms": score.render_ms,
        "train_seconds": score.train_seconds,
        **({"gain_psnr_db": model.corrected_db} if gains else {}),
        "seen_psnr_db": dict(model.seen_db),
        "views": [{key: value for key, value in dataclasses.asdict(view).items()
                   if value is not None} for view in score.views],
    }


def _difference(scores: Mapping[str, ModelScore], key: str) -> Interval:
    """Returns a score of pruned minus base, view by view, with an interval."""
    return paired_bootstrap(*([getattr(view, key) for view in scores[model].views]
                              for model in ("pruned", "base")))


def _gap(model: _Model, *, gains: bool) -> str:
    """Returns how much better the views are that training saw."""
    held_out = model.corrected_db if gains else model.score.psnr_db
    splits = {**model.seen_db, "held out": held_out}
    text = f"PSNR of {', '.join(f'{name} {value:.2f}' for name, value in splits.items())} dB"
    if "training" not in model.seen_db:
        return text
    return f"{text}: a gap of {model.seen_db['training'] - held_out:.2f} dB to the training views"


def _counts(held_out: Sequence[ReferenceView], scene: Scene) -> Summary:
    """Returns how many views are scored, and the names of those that are not."""
    hidden = {view.name for view in scene.test} - {view.name for view in held_out}
    return {
        "test_views": len(held_out), "unregistered_test": list(scene.unregistered_test),
        **({"masked_out_test": sorted(hidden)} if hidden else {}),
    }


def _note(
    held_out: Sequence[ReferenceView], scene: Scene, masked: int, *, lacking: str | None
) -> str:
    """Returns what the figures of the tables mean."""
    sizes = " and ".join(
        f"{width}x{height}" for width, height in sizes_of([view.camera for view in held_out]))
    note = (f"{len(held_out)} held-out views at {sizes}, "
            f"{len(scene.unregistered_test)} more without a camera\n"
            f"PSNR: {PSNR_CONVENTION}\n8-bit: {PSNR_8BIT_CONVENTION}\n"
            f"SSIM: {SSIM_CONVENTION}\nSSIM 0-pad: {SSIM_PADDED_CONVENTION}\n"
            f"LPIPS: {LPIPS_CONVENTION if lacking is None else f'not measured, {lacking}'}\n")
    if masked:
        note += f"Masks on {masked} of {len(held_out)} views: {MASK_CONVENTION}\n"
    return note
