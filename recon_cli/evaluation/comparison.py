"""Scores of several models side by side, and differences of those scored on the same views."""

from __future__ import annotations

import dataclasses
import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from recon_cli.config.stages import MODEL_LABELS
from recon_cli.context import StageContext
from recon_cli.errors import FormatError, Hint, ManifestError
from recon_cli.evaluation.intervals import Interval, paired_bootstrap
from recon_cli.evaluation.metrics import CONVENTION_LINES, CONVENTIONS, MASK_CONVENTION
from recon_cli.evaluation.reference_views import reference_digest, score_views
from recon_cli.evaluation.scores import (
    Metrics,
    ModelMetrics,
    Table,
    csv_table,
    model_table,
    paper_table,
)
from recon_cli.io.views import ReferenceView
from recon_cli.scene.similarity import Similarity
from recon_cli.scene.splats import Splats, transformed
from recon_cli.splats.registry import read_splats
from recon_cli.workspace.atomic import read_json

_TRANSFORM = "transform.json"  # that an export leaves beside its files
_NOTE = (
    "Differences: paired, bootstrap over the views; only between models that were scored on the "
    "same views.")

logger = logging.getLogger("recon")


@dataclass(frozen=True)
class ScoredModel:
    """One model of a comparison."""

    group: str  # the workspace, or the folder whose views a file is scored on, as in tables
    model: str  # base, pruned, or the name of a file
    label: str  # in tables
    score: ModelMetrics  # on the held-out views
    digest: str  # of these views; scores can be paired where it is equal
    kind: str = ""  # of a model of a workspace, as in tables: original, compact or 3DGS


def read_workspace_scores(name: str, folder: Path) -> list[ScoredModel]:
    """Returns the models in the evaluate folder of workspace `name`; FormatError if damaged."""
    try:
        metrics = Metrics.read(folder)
    except ManifestError as error:
        raise FormatError(
            f"{folder / Metrics.FILE} does not hold scores: {error.message}.",
            hint=Hint("eval", again=True, then=" in that workspace")) from error
    return [
        ScoredModel(name, model, f"{name}, {metrics.label(model)}", score, metrics.truth_digest,
                    metrics.label(model))
        for model, score in metrics.models.items()]


def score_file(
    path: Path, name: str, group: str, views: Sequence[ReferenceView], ctx: StageContext
) -> ScoredModel:
    """Returns a file of Gaussians, scored on the views of the workspace `group`.

    It must lie in the world of that workspace, or beside the transform.json of an export of it.
    FormatError if it holds no Gaussians that can be read.
    """
    splats = _undo_export(read_splats(path), path.with_name(_TRANSFORM))
    splats = splats.map(lambda tensor: tensor.to(ctx.device))
    scores = score_views(splats, views, splats.sh_degree, ctx.backend)
    score = ModelMetrics.from_views(
        scores.views, gaussians=len(splats), bytes=path.stat().st_size, render_ms=scores.render_ms)
    return ScoredModel(group, name, name, score, reference_digest(views))


def _undo_export(splats: Splats, record: Path) -> Splats:
    """Returns the Gaussians in the world before the export; FormatError for a damaged record."""
    if not record.is_file():
        return splats
    try:
        similarity = Similarity.from_json(read_json(record, dict)["similarity"])
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(
            f"{record} does not hold the frame of an export: {error!r}.",
            hint=Hint("export", again=True, then=", or score a copy of the file in another folder"),
        ) from error
    if similarity.is_identity:
        return splats
    logger.info("%s: transformed back into the world of the training", record)
    return transformed(splats, similarity.inverse())


def format_comparison(
    models: Sequence[ScoredModel], form: str, *, caption: str = "", label: str = ""
) -> str:
    """Returns the models, at least one, as text, markdown, csv, latex or json.

    `caption` and `label` are those of the first table in LaTeX.
    """
    if form == "json":
        return json.dumps(_record(models), indent=1)
    scores, means = {scored.label: scored.score for scored in models}, scene_means(models)
    if form == "csv":
        return csv_table({**scores, **means}).rstrip()
    tables = [table for table in (
        model_table(scores, means), difference_table(models), _paper_rows(models)) if table.rows]
    if form == "latex":
        first, *others = tables
        return "\n".join([first.latex(caption, label), *(
            table.latex() for table in others)]).rstrip()
    if form == "markdown":
        return "\n".join(table.markdown() for table in tables) + f"\n{CONVENTION_LINES}{_NOTE}"
    return "\n\n".join(table.text(rule=True) for table in tables) + "\n\n" + _NOTE


def scene_means(models: Sequence[ScoredModel]) -> dict[str, ModelMetrics]:
    """Returns the means over scenes by label, of each kind of model that several scenes have.

    There is none of a kind that a scene has twice (the same views), nor of files.
    """
    by_kind: dict[str, list[ScoredModel]] = {}
    for scored in models:
        by_kind.setdefault(scored.kind, []).append(scored)
    return {
        f"mean of {len(group)} scenes, {kind}": ModelMetrics.mean([one.score for one in group])
        for kind, group in by_kind.items()
        if kind and len(group) > 1 and len({one.digest for one in group}) == len(group)}


def difference_table(models: Sequence[ScoredModel]) -> Table:
    """Returns how each model differs from the first one with the same views, with intervals."""
    return Table(("difference, 95%", "PSNR dB", "SSIM"), tuple(
        (f"{ours.label} minus {theirs.label}", _difference(ours, theirs, "psnr_db").text("+.2f"),
         _difference(ours, theirs, "ssim").text("+.4f"))
        for ours, theirs in _pairs(models)))


def _pairs(models: Sequence[ScoredModel]) -> list[tuple[ScoredModel, ScoredModel]]:
    """Returns each model with the first one that was scored on the same views."""
    first: dict[str, ScoredModel] = {}
    return [(scored, first[scored.digest]) for scored in models
            if first.setdefault(scored.digest, scored) is not scored]


def _difference(ours: ScoredModel, theirs: ScoredModel, key: str) -> Interval:
    return paired_bootstrap(*([getattr(view, key) for view in scored.score.views]
                              for scored in (ours, theirs)))


def _paper_rows(models: Sequence[ScoredModel]) -> Table:
    """Returns the base model against the pruned one for each workspace that has both."""
    scores = {(scored.group, scored.model): scored.score for scored in models}
    groups = [group for group in dict.fromkeys(scored.group for scored in models)
              if (group, "base") in scores and (group, "pruned") in scores]
    kinds = {scored.kind for scored in models if scored.model == "base" and scored.group in groups}
    return paper_table(
        {group: (scores[group, "base"], scores[group, "pruned"]) for group in groups},
        (kinds.pop() if len(kinds) == 1 else MODEL_LABELS["base"],
         MODEL_LABELS["pruned"]))


def _record(models: Sequence[ScoredModel]) -> dict[str, Any]:
    return {
        "models": [{
            "workspace": scored.group, "model": scored.model, "truth_digest": scored.digest,
            **{key: getattr(scored.score, key) for key in (
                "psnr_db", "psnr_8bit_db", "ssim", "ssim_padded", "lpips")},
            "label": scored.label,
            "views": [dataclasses.asdict(view) for view in scored.score.views],
            **{key: getattr(scored.score, key) for key in (
                "gaussians", "bytes", "render_ms", "train_seconds")}} for scored in models],
        "means": {label: {
            name: value for name, value in dataclasses.asdict(score).items()
            if name not in ("views", "seen_psnr_db", "gain_psnr_db")}
            for label, score in scene_means(models).items()},
        "differences": [{
            "ours": ours.label, "theirs": theirs.label,
            **{key: _difference(ours, theirs, key).to_json() for key in ("psnr_db", "ssim")}}
            for ours, theirs in _pairs(models)],
        **CONVENTIONS, "mask_convention": MASK_CONVENTION}
