"""evaluate: scores every model on the held-out views, against the original pixels.

The .ply is read back and rendered, so that the written file itself is measured. Writes
metrics.json, metrics.csv, metrics.md, metrics.tex, table.txt, and pictures: renders/<model>/,
truth/ and difference/<model>/ (absolute error times four). Pixels that a mask ignores are not
scored: they are painted in one colour in truth/ and black in difference/.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.config.protocols import PROTOCOLS, SPLIT_WORDS
from recon_cli.config.stages import EvaluateConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.errors import list_names
from recon_cli.evaluation.intervals import Interval, paired_bootstrap
from recon_cli.evaluation.metrics import (
    CONVENTION_LINES,
    CONVENTIONS,
    FACES_CONVENTION,
    LPIPS_CONVENTION,
    MASK_CONVENTION,
    VIGNETTE_CONVENTION,
    Perceptual,
    load_lpips,
    psnr,
)
from recon_cli.evaluation.panoramas import PanoramaPictures
from recon_cli.evaluation.reference_views import (
    Images,
    RenderedModel,
    load_held_out_views,
    load_reference_views,
    mean_psnr,
    reference_digest,
    score_views,
)
from recon_cli.evaluation.scores import (
    ERROR_GAIN,
    REFERENCE,
    Metrics,
    ModelMetrics,
    csv_table,
    model_table,
    paper_table,
    view_table,
)
from recon_cli.io.images import to_uint8, write_png
from recon_cli.io.training_scene import PlacedCapture
from recon_cli.io.views import ReferenceView, evenly_spread, size_summary, sizes_of
from recon_cli.render.response import LensFalloffs
from recon_cli.scene.scene import Scene
from recon_cli.scene.train_view import TrainView, leaves_enough
from recon_cli.splats.ply import read_ply
from recon_cli.train.finished_model import FinishedModel
from recon_cli.train.fit.runner import seconds_at
from recon_cli.train.masks import with_masks
from recon_cli.train.parts.moving import FINER, ViewComparer, find_in_held_out
from recon_cli.train.parts.part import SEARCH_SIDE
from recon_cli.train.parts.photometry import read_falloffs
from recon_cli.trust.assess import TrustTask, assess
from recon_cli.workspace.atomic import write_json, write_text
from recon_cli.workspace.records import describe_stretches
from recon_cli.workspace.summaries import EvaluateSummary, LogRow

_SEEN_VIEWS = 20  # training and validation views that are also scored, at most
_STAGES = {"base": "train", "pruned": "prune"}  # by model
_ROOM = 512 << 20  # bytes of images that trust need not render again: 130 views of 600x340


@dataclass(frozen=True)
class _Evaluation:
    """The models to score and the views."""

    out: Path
    trained: FinishedModel
    folders: Mapping[str, Path]  # of train and prune, by model
    falloffs: Mapping[str, LensFalloffs | None]  # the vignettes that each was trained with
    capture: PlacedCapture
    scene: Scene
    held_out: Sequence[ReferenceView]
    training_views: Mapping[str, Sequence[ReferenceView]]  # some views of training, by split
    ctx: StageContext
    protocol: str | None = None  # that training and scores follow
    # [H, W] where held-out views show what moves, by name; only where training masked such things
    moving: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict)

    @property
    def gains(self) -> bool:
        """Whether training had a gain for each view."""
        return self.trained.config.has_gains

    def open(self, model: str, *, room: int) -> RenderedModel:
        """Reads one model; it keeps so many bytes of images that `score` renders."""
        splats = read_ply(self.folders[model] / "splats.ply")
        return RenderedModel(splats.map(lambda tensor: tensor.to(self.ctx.device)),
                             self.trained.config.sh_degree, self.ctx.backend, room)

    def score(
        self, model: str, rendered: RenderedModel, perceptual: Perceptual | None,
        on_view: Callable[[], None],
    ) -> ModelMetrics:
        """Renders and scores one model, and saves its pictures."""
        splats, degree, backend = rendered.splats, rendered.sh_degree, rendered.backend
        threads, falloffs = self.ctx.threads, self.falloffs[model]

        def seen(view: TrainView, images: Images) -> None:
            if falloffs is None:  # trust is that of the scene, without a lens
                rendered.keep(view.camera, images)
            on_view()

        pictures = PanoramaPictures(self.held_out)

        static: list[float] = []

        def save(view: ReferenceView, images: Images) -> None:
            if self.moving:
                static.append(psnr(images.rgb, view.image, self._static(view)))
            for name, image, photo, mask in pictures.take(view, images.rgb):
                _save_pictures(self.out, model, name, image, photo, mask)
            seen(view, images)

        scores = score_views(
            splats, self.held_out, degree, backend, perceptual=perceptual, threads=threads,
            falloffs=falloffs, on_view=save)
        seen_db = {
            name: mean_psnr(splats, views, degree, backend, corrected=self.gains, threads=threads,
                            falloffs=falloffs, on_view=seen)
            for name, views in self.training_views.items()}
        log = self.folders[model] / LogRow.FILE
        seconds = None if self.trained.import_record else seconds_at(log, sys.maxsize)
        return ModelMetrics.from_views(
            scores.views, gaussians=len(splats),
            bytes=(self.folders[model] / "splats.ply").stat().st_size,
            render_ms=scores.render_ms, train_seconds=seconds,
            seen_after_gains=self.gains, seen_psnr_db=seen_db,
            static_psnr_db=float(np.mean(static)) if static else None)

    def _static(self, view: ReferenceView) -> NDArray[np.bool_] | None:
        """Returns the pixels of a held-out view that are scored and do not move, None for all."""
        region = self.moving.get(view.name)
        if region is None:
            return view.mask
        return ~region if view.mask is None else view.mask & ~region

    def counts(self) -> dict[str, Any]:
        """Returns how many views are scored, and the names of those that are not, for records."""
        scored = {view.face_of or view.name for view in self.held_out}
        hidden = {view.frame for view in self.scene.test} - scored
        return {
            "test_views": len(scored),
            "unregistered_test": tuple(self.scene.unregistered_test),
            "masked_out_test": tuple(sorted(hidden)) or None}

    def coverage(self) -> dict[str, Any]:
        """Returns how many frames there are and were trained on, and which have no camera."""
        scene = self.scene
        frames = self.capture.frames.frames
        registered = {view.frame for view in (*scene.train, *scene.validation, *scene.test)}
        trained = {view.frame for view in scene.train}
        return {
            "frames": len(frames),
            "training_views": None if self.trained.import_record else len(trained),
            "unregistered": tuple(
                frame.name for frame in frames if frame.name not in registered)}

    def note(self, lacking: str) -> str:
        """Returns a note on the figures of the tables; `lacking` is why LPIPS is missing."""
        sizes = " and ".join(f"{width}x{height}" for width, height in sizes_of(
            [view.camera for view in self.held_out]))
        masked = sum(view.mask is not None for view in self.held_out)
        faces = sum(view.face_of is not None for view in self.held_out)
        note = (f"{len(self.held_out)} held-out views at {sizes}, "
                f"{len(self.scene.unregistered_test)} more without a camera\n")
        if lacking:
            note += f"LPIPS: not measured, {lacking}\n"
        if masked:
            note += f"Masks on {masked} of {len(self.held_out)} views: {MASK_CONVENTION}\n"
        if self.protocol:
            note += f"Protocol {self.protocol}: {PROTOCOLS[self.protocol].words}; {SPLIT_WORDS}\n"
        if any(self.falloffs.values()):
            note += f"{VIGNETTE_CONVENTION}\n"
        if faces:
            note += f"{faces} of these views are {FACES_CONVENTION}\n"
        return note + "".join(
            f"{text}\n" for text in self.trained.warnings)


def run(
    config: EvaluateConfig, inputs: StageInputs, out: Path, ctx: StageContext
) -> EvaluateSummary:
    """Renders and scores the held-out views and returns the means of each model."""
    evaluation = _load(config, inputs, out, ctx)
    trained = evaluation.trained
    pictures = PanoramaPictures(evaluation.held_out)
    for view in evaluation.held_out:
        for name, _, photo, _ in pictures.take(view, view.image.astype(np.float32)):
            _save(out / "truth" / f"{Path(name).stem}.png", photo)
    perceptual, lacking = load_lpips()
    views = len(evaluation.held_out) + sum(map(len, evaluation.training_views.values()))
    models: dict[str, ModelMetrics] = {}
    with ctx.progress.bar("evaluate", len(evaluation.folders) * views, unit="view") as bar:
        for name in evaluation.folders:  # the last one is exported: the pruned one if there is one
            rendered = evaluation.open(name, room=_ROOM if config.trust else 0)
            models[name] = evaluation.score(name, rendered, perceptual, bar.advance)
    unregistered = evaluation.scene.unregistered_test
    if unregistered:
        ctx.notice(f"{len(unregistered)} held-out views have no camera and are not scored: "
                   f"{', '.join(unregistered)}")
    for text in trained.warnings:
        ctx.notice(text)
    _write(evaluation, models, evaluation.capture.ingest.parent.resolve().name, lacking)
    means = evaluation.counts()
    for name, model in models.items():
        for key in ("psnr_db", "ssim", "gaussians"):
            means[f"{name}_{key}"] = round(getattr(model, key), 4)
        if evaluation.gains and model.gain_psnr_db is not None:
            means[f"{name}_gain_psnr_db"] = round(model.gain_psnr_db, 4)
    trust = assess(TrustTask(
        name, rendered, trained.config, evaluation.scene, evaluation.held_out,
        config.max_size or trained.config.max_size, trained.import_record,
        evaluation.capture.world), out, ctx) if config.trust else None
    return EvaluateSummary(**means, poorly_seen=tuple(trust.lines()) if trust else None)


def _load(config: EvaluateConfig, inputs: StageInputs, out: Path, ctx: StageContext) -> _Evaluation:
    trained, capture = (
        FinishedModel.read(inputs.folders["train"]), PlacedCapture.read(inputs.folders))
    scene = capture.load_scene(validation=trained.config.validation)
    size = config.max_size or trained.config.max_size
    held_out = load_held_out_views(scene, size, ctx)
    splits = {"training": scene.train, "validation": scene.validation}
    training_views = {name: views for name, split in splits.items() if (
        views := load_reference_views(
            evenly_spread(split, _SEEN_VIEWS), size, threads=ctx.threads))}
    folders = {model: inputs.folders[stage] for model, stage in _STAGES.items()
               if stage in inputs.folders}
    if trained.config.compact_only and len(folders) > 1:
        del folders["base"]  # its training ended where pruning began
    followed = trained.import_record is None and size == trained.config.max_size
    return _Evaluation(
        out, trained, folders, {model: read_falloffs(folder) for model, folder in folders.items()},
        capture, scene, held_out, training_views, ctx,
        trained.config.protocol if followed else None,
        _find_moving(trained, scene, held_out, ctx))


def _find_moving(
    trained: FinishedModel, scene: Scene, held_out: Sequence[ReferenceView], ctx: StageContext
) -> dict[str, NDArray[np.bool_]]:
    """Returns where held-out views show what moves, [H, W] by name, if training masked any.

    Faces of panoramas are scored together, and not looked at.
    """
    if trained.moving is None or any(view.face_of for view in held_out):
        return {}
    splats = trained.read_splats().map(lambda tensor: tensor.to(ctx.device))
    training = load_reference_views(
        with_masks(scene, trained.folder).train, FINER * SEARCH_SIDE, threads=ctx.threads)
    regions = find_in_held_out(
        splats, held_out, training, ViewComparer(trained.config.sh_degree, ctx.backend))
    return {view.name: region for view, region in zip(held_out, regions, strict=True)
            if region.any() and leaves_enough(~region)}


def _save_pictures(
    out: Path, model: str, frame: str, image: NDArray[np.float32], photo: NDArray[np.uint8],
    mask: NDArray[np.bool_] | None,
) -> None:
    """Saves the render of a held-out view, and its difference from the photo."""
    name, rendered = f"{Path(frame).stem}.png", to_uint8(image)
    _save(out / "renders" / model / name, rendered)
    difference = np.abs(rendered.astype(np.int16) - photo) * ERROR_GAIN
    if mask is not None:
        difference[~mask] = 0
    _save(out / "difference" / model / name, difference.clip(0, 255).astype(np.uint8))


def _save(path: Path, image: NDArray[np.uint8]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, image)


def _write(
    evaluation: _Evaluation, models: Mapping[str, ModelMetrics], workspace: str, lacking: str
) -> None:
    """Writes the scores as JSON and as tables; `lacking` is why LPIPS cannot be measured."""
    out, held_out = evaluation.out, evaluation.held_out
    record = evaluation.trained.import_record
    measured = next(iter(models.values())).lpips is not None
    lacking = "" if measured else lacking or "views with a mask have none"
    differences = {key: _difference(models, key) for key in ("psnr_db", "ssim")} if len(
        models) == 2 else {}
    masked = any(view.mask is not None for view in held_out)
    metrics = Metrics(
        models=models,
        pruned_minus_base=differences or None,
        **CONVENTIONS,
        lpips_convention=f"not measured: {lacking}" if lacking else LPIPS_CONVENTION,
        mask_convention=MASK_CONVENTION if masked else None,
        truth_digest=reference_digest(held_out),
        **size_summary([view.camera for view in held_out]), **evaluation.counts(),
        imported_from=record.file if record else None,
        base_recipe=REFERENCE if evaluation.trained.config.is_reference and not record else None,
        protocol=evaluation.protocol, **evaluation.coverage(),
        moving={name: round(float(region.mean()), 4) for name, region in sorted(
            evaluation.moving.items())} or None)
    write_json(out / Metrics.FILE, metrics.to_json())
    by_label = {metrics.label(name): model for name, model in models.items()}
    note = evaluation.note(lacking)
    if metrics.coverage:
        stretches = describe_stretches(
            evaluation.capture.frames.frames, metrics.unregistered or ())
        note += f"{metrics.coverage}: {list_names(stretches)}\n"
    for label, model in by_label.items():
        note += f"{label}, {_gap(model)}\n"
        if moving := metrics.describe_moving(model):
            note += f"{label}, {moving}\n"
    if differences:
        note += (f"compact minus original: PSNR {differences['psnr_db'].text('+.2f')} dB, SSIM "
                 f"{differences['ssim'].text('+.4f')} (95% by bootstrap over the views)\n")
    first = model_table(by_label)
    rename = evaluation.ctx.name_photos
    write_text(out / "table.txt", rename(f"{first.text(rule=True)}\n{note}"))
    views = view_table(by_label)
    write_text(out / "metrics.md", rename(
        f"{first.markdown()}\n{views.markdown()}\n{CONVENTION_LINES}{note}"))
    write_text(out / "metrics.csv", csv_table(models))
    tex = first.latex()
    if len(models) == 2:
        tex += "\n" + paper_table(
            {workspace: (models["base"], models["pruned"])},
            (metrics.label("base"), metrics.label("pruned"))).latex()
    write_text(out / "metrics.tex", tex)


def _difference(models: Mapping[str, ModelMetrics], key: str) -> Interval:
    """Returns a score of pruned minus base, view by view, with an interval."""
    return paired_bootstrap(*([getattr(view, key) for view in models[model].views]
                              for model in ("pruned", "base")))


def _gap(model: ModelMetrics) -> str:
    """Returns how much better the views are that training saw."""
    held_out = model.gap_psnr_db
    splits = {**model.seen_psnr_db, "held out": held_out}
    text = f"PSNR of {', '.join(f'{name} {value:.2f}' for name, value in splits.items())} dB"
    if "training" not in model.seen_psnr_db:
        return text
    gap = model.seen_psnr_db["training"] - held_out
    return f"{text}: a gap of {gap:.2f} dB to the training views"
