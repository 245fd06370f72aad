"""The comparison in words and tables."""

from __future__ import annotations

import dataclasses
import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from recon_cli.context import StageContext, StageInputs
from recon_cli.errors import ConfigError, FormatError, InputError
from recon_cli.evaluation.intervals import Interval, paired_bootstrap
from recon_cli.evaluation.metrics import (
    MASK_CONVENTION,
    PSNR_8BIT_CONVENTION,
    PSNR_CONVENTION,
    SSIM_CONVENTION,
    SSIM_PADDED_CONVENTION,
)
from recon_cli.evaluation.reference_views import (
    LABELS,
    ReferenceView,
    load_held_out_views,
    load_scene,
    reference_digest,
    score_views,
)
from recon_cli.evaluation.scores import ModelScore, ViewScore, csv_table, model_table, paper_table
from recon_cli.evaluation.tables import Table
from recon_cli.io.splats.registry import read_splats
from recon_cli.scene.similarity import Similarity
from recon_cli.scene.splats import Splats, transformed
from recon_cli.workspace.atomic import read_json
from recon_cli.workspace.layout import Workspace

_TRANSFORM = "transform.json"  # of an export, see stages.export

logger = logging.getLogger("recon")


@dataclass(frozen=True)
class Entry:
    """One row.

    Attributes:
        group: the workspace, or the folder whose views a file is scored on, as tables call it.
        model: base, pruned, or the name of a file.
        score: on the held-out views.
        truth: digest of what it was held against; scores can be paired where it is equal.
    """

    group: str
    model: str
    score: ModelScore
    truth: str


def checked(items: Sequence[Path]) -> None:
    """Raises InputError or ConfigError unless each path is a workspace or a file, none twice."""
    seen = set()
    for path in items:
        if not path.exists():
            raise InputError(f"{path} does not exist.", hint="Check the path.")
        if path.is_dir() and not Workspace(path).holds_results:
            raise InputError(
                f"{path} is neither a workspace nor a file of Gaussians.",
                hint="Give folders that `recon train` was run in, or files of Gaussians.")
        if path.resolve() in seen:
            raise ConfigError(f"{path} is there twice.", hint="Leave one out.")
        seen.add(path.resolve())


def of_workspace(name: str, folder: Path) -> list[Entry]:
    """Returns the models of an evaluate folder.

    Args:
        name: of the workspace.
        folder: of the stage, fresh.

    Raises:
        FormatError: metrics.json is damaged.
    """
    path = folder / "metrics.json"
    try:
        record = read_json(path)
        return [Entry(name, model, _model_score(f"{name}, {LABELS[model]}", values),
                      record["truth_digest"])
                for model, values in record["models"].items()]
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(
            f"{path} does not hold scores: {error!r}.",
            hint="Run `recon eval --again` in that workspace.") from error


def _model_score(label: str, values: Mapping[str, Any]) -> ModelScore:
    views = tuple(ViewScore(**view) for view in values["views"])
    return ModelScore(label, views, values["gaussians"], values["bytes"], values["render_ms"],
                      values["train_seconds"])


@dataclass(frozen=True, eq=False)
class Benchmark:
    """Held-out views that files are scored on.

    Attributes:
        name: of the workspace they come from.
        views: at the size they are scored at.
        ctx: backend and device.
    """

    name: str
    views: Sequence[ReferenceView]
    ctx: StageContext


def benchmark_of(
    name: str, inputs: StageInputs, max_size: int, ctx: StageContext
) -> Benchmark:
    """Returns the held-out views of a workspace.

    Args:
        name: of the workspace.
        inputs: folders of ingest and sfm.
        max_size: longest side in pixels.
        ctx: backend and device.

    Raises:
        ReconstructionError: no held-out view has a camera.
    """
    scene = load_scene(inputs, validation=0.0)
    return Benchmark(name, load_held_out_views(scene, max_size, ctx), ctx)


def of_file(path: Path, name: str, against: Benchmark) -> Entry:
    """Returns a file of Gaussians, scored on the views of a workspace, in whose world it must lie.

    A file beside which an export left transform.json is brought back into that world.

    Args:
        path: of the file.
        name: for the tables.
        against: the views.

    Raises:
        FormatError: it holds no Gaussians that can be read.
    """
    splats = _brought_back(read_splats(path), path.with_name(_TRANSFORM))
    splats = splats.map(lambda tensor: tensor.to(against.ctx.device))
    found = score_views(splats, against.views, splats.sh_degree, against.ctx.backend)
    score = ModelScore(
        name, found.views, len(splats), path.stat().st_size, found.render_ms, None)
    return Entry(against.name, name, score, reference_digest(against.views))


def _brought_back(splats: Splats, record: Path) -> Splats:
    """Returns the Gaussians in the world that an export took them from, where it says so.

    Raises:
        FormatError: what it says cannot be read.
    """
    if not record.is_file():
        return splats
    try:
        similarity = Similarity.from_json(read_json(record)["similarity"])
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(
            f"{record} does not hold the frame of an export: {error!r}.",
            hint="Run `recon export --again`, or score a copy of the file in another folder.",
        ) from error
    if similarity.is_identity:
        return splats
    logger.info("%s: brought back into the world of the training", record)
    return transformed(splats, similarity.inverse())


def report(entries: Sequence[Entry], form: str) -> str:
    """Returns the entries, at least one, in one of `command.FORMS`."""
    if form == "json":
        return json.dumps(_record(entries), indent=1)
    if form == "csv":
        return csv_table({entry.score.label: entry.score for entry in entries}).rstrip()
    tables = [table for table in (
        model_table([entry.score for entry in entries]), difference_table(entries),
        _beside_the_paper(entries)) if table.rows]
    if form == "latex":
        return "\n".join(table.latex() for table in tables).rstrip()
    if form == "markdown":
        return "\n".join(table.markdown() for table in tables) + "\n" + _note()
    return "\n\n".join(table.text(rule=True) for table in tables) + "\n\n" + _note()


def pairs(entries: Sequence[Entry]) -> list[tuple[Entry, Entry]]:
    """Returns each entry with the first one that was held against the very same views."""
    found = []
    for place, entry in enumerate(entries):
        first = next(one for one in entries if one.truth == entry.truth)
        if entries.index(first) < place:
            found.append((entry, first))
    return found


def difference_table(entries: Sequence[Entry]) -> Table:
    """Returns how each entry differs from the first one with the same views, with intervals."""
    return Table(("difference, 95%", "PSNR dB", "SSIM"), tuple(
        (f"{ours.score.label} minus {theirs.score.label}",
         _paired(ours, theirs, "psnr_db").text("+.2f"),
         _paired(ours, theirs, "ssim").text("+.4f")) for ours, theirs in pairs(entries)))


def _beside_the_paper(entries: Sequence[Entry]) -> Table:
    """Returns 3DGS against ours for each workspace that has both."""
    models = {(entry.group, entry.model): entry.score for entry in entries}
    groups = dict.fromkeys(entry.group for entry in entries)
    return paper_table({
        group: (models[group, "base"], models[group, "pruned"]) for group in groups
        if (group, "base") in models and (group, "pruned") in models})


def _paired(ours: Entry, theirs: Entry, key: str) -> Interval:
    return paired_bootstrap(*([getattr(view, key) for view in entry.score.views]
                              for entry in (ours, theirs)))


def _record(entries: Sequence[Entry]) -> dict[str, Any]:
    return {
        "models": [{
            "workspace": entry.group, "model": entry.model, "truth_digest": entry.truth,
            **{key: getattr(entry.score, key) for key in (
                "psnr_db", "psnr_8bit_db", "ssim", "ssim_padded", "lpips")},
            **dataclasses.asdict(entry.score)} for entry in entries],
        "differences": [{
            "ours": ours.score.label, "theirs": theirs.score.label,
            **{key: dataclasses.asdict(_paired(ours, theirs, key)) for key in ("psnr_db", "ssim")}}
            for ours, theirs in pairs(entries)],
        "psnr_convention": PSNR_CONVENTION, "psnr_8bit_convention": PSNR_8BIT_CONVENTION,
        "ssim_convention": SSIM_CONVENTION, "ssim_padded_convention": SSIM_PADDED_CONVENTION,
        "mask_convention": MASK_CONVENTION}


def _note() -> str:
    return (f"PSNR: {PSNR_CONVENTION}\n8-bit: {PSNR_8BIT_CONVENTION}\nSSIM: {SSIM_CONVENTION}\n"
            f"SSIM 0-pad: {SSIM_PADDED_CONVENTION}\n"
            "Differences: paired, bootstrap over the views; only where both were held against the "
            "very same views.")
