"""The charts of the page: training and pruning logs, pruning rounds, the prune curve."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from markupsafe import Markup

from recon_cli.errors import FormatError
from recon_cli.report.chart import MARKS, Axis, Series, draw_chart
from recon_cli.report.records import BASE, PRUNED, LogRow, Metrics, Sweep, read_log, read_sweep
from recon_cli.report.stage_status import StageStatus, Statuses

SWEEP = "sweep.json"  # of `recon prune --sweep`, in the workspace
_STEP, _DECIBELS, _LEFT = Axis("step"), Axis("PSNR, dB"), Axis("Gaussians left")
_LABELS = {"train": "training", "prune": "after pruning"}
_COLORS = {"train": 0, "prune": 1}
_CONTROL = "none"  # the score of control trials, which remove nothing


@dataclass(frozen=True)
class TrainingCurves:
    """The charts of training and pruning logs."""

    figures: tuple[Markup, ...]
    notes: tuple[str, ...]  # on how to read them, a sentence each
    damaged: tuple[str, ...]  # why a log is not shown


@dataclass(frozen=True)
class PruneCurve:
    """The chart of a prune sweep."""

    figure: Markup | None = None  # None without a sweep
    stale: str = ""  # why it does not belong to the present training
    damaged: str = ""  # why an existing sweep is not shown


def draw_training_curves(stages: Statuses, metrics: Metrics | None) -> TrainingCurves:
    """Returns the charts of the logs of train and prune, with held-out scores as marks."""
    logs, damaged = {}, []
    for name in _LABELS:
        if stages[name].there:
            try:
                logs[name] = read_log(stages[name].folder / "log.jsonl")
            except FormatError as error:
                damaged.append(f"The log of {name} is not shown: {error.message}")

    def series(value: Callable[[LogRow], float | None], *, over: str = "step") -> list[Series]:
        return [Series(
            _LABELS[name] + stages[name].stale_suffix,
            tuple((row.iteration if over == "step" else row.seconds, y)
                  for row in rows if (y := value(row)) is not None),
            color=_COLORS[name], mark="circle" if len(rows) < 60 else "", dashed=name == "prune")
            for name, rows in logs.items()]

    over_time = [*series(lambda row: row.psnr_db, over="seconds"),
                 *_mark_held_out(metrics, stages["evaluate"])]
    figures = (
        draw_chart("PSNR on validation views over wall time", Axis("seconds", log=True), _DECIBELS,
                   over_time),
        draw_chart("PSNR on validation views", _STEP, _DECIBELS, series(lambda row: row.psnr_db)),
        draw_chart("Training loss of one view at a time", _STEP, Axis("loss", log=True),
                   series(lambda row: row.loss)),
        draw_chart("Number of Gaussians", _STEP, Axis("Gaussians"),
                   series(lambda row: row.gaussians)),
        draw_chart("Wall time", _STEP, Axis("seconds"), series(lambda row: row.seconds)),
    )
    return TrainingCurves(figures, tuple(_note_jumps(logs)), tuple(damaged))


def _mark_held_out(metrics: Metrics | None, evaluate: StageStatus) -> list[Series]:
    """Returns one mark for each model: its training seconds and held-out PSNR."""
    if metrics is None:
        return []
    styles = {BASE: ("held out, base", 0, "diamond"), PRUNED: ("held out, pruned", 1, "triangle")}
    return [Series(label + evaluate.stale_suffix, ((model.train_seconds, model.psnr_db),), color,
                   mark, line=False, big=True)
            for key, (label, color, mark) in styles.items()
            if (model := metrics.models.get(key)) and model.train_seconds]


def _note_jumps(logs: Mapping[str, tuple[LogRow, ...]]) -> list[str]:
    return [f"Validation PSNR stopped improving: {_LABELS[name]} jumped from step "
            f"{row.iteration:,} to step {row.goes_on_at:,} of the schedule."
            for name, rows in logs.items() for row in rows if row.goes_on_at is not None]


def draw_rounds(prune: StageStatus) -> Markup | None:
    """Returns the PSNR after each round of pruning; None where the summary has no rounds."""
    rounds = [row for row in prune.summary.get("rounds", ())
              if isinstance(row, Mapping) and row.get("validation_psnr_db") is not None]
    if not rounds:
        return None
    before = prune.summary.get("validation_psnr_db_before")
    start = [(float(prune.summary["gaussians_before"]), float(before))] if before else []

    def points(*, kept: bool) -> tuple[tuple[float, float], ...]:
        return tuple((float(row["gaussians"]), float(row["validation_psnr_db"]))
                     for row in rounds if bool(row["kept"]) is kept)

    return draw_chart(
        "Rounds of removal: PSNR on validation views at the end of each", _LEFT, _DECIBELS, [
            Series("rounds", points(kept=True), 1, "circle"),
            Series("taken back", points(kept=False), 3, "cross", line=False),
            Series("before the first removal", tuple(start), 0, "diamond", line=False, big=True)])


def draw_prune_curve(root: Path, stages: Statuses) -> PruneCurve:
    """Returns PSNR on validation views against Gaussians and megabytes, from a workspace's sweep.

    The trained and pruned models of the workspace are marked by their own validation PSNR.
    """
    path = root / SWEEP
    if not path.is_file():
        return PruneCurve()
    try:
        sweep = read_sweep(path)
    except FormatError as error:
        return PruneCurve(damaged=f"The sweep is not shown: {error.message}")
    controls = tuple((float(trial.gaussians), trial.psnr_db) for trial in sweep.trials
                     if trial.score == _CONTROL and trial.ratio is None)
    size = _bytes_per_gaussian(stages["train"])
    figure = draw_chart(
        f"PSNR on {sweep.views} validation views after {sweep.steps} steps of recovery",
        _LEFT, _DECIBELS, [
            *_sweep_series(sweep), *_mark_models(stages),
            Series("no prune, as many steps", controls, 7, "bar", line=False, big=True)],
        above=("megabytes of the .ply", size / 1e6) if size else None)
    return PruneCurve(figure, _why_stale(path, sweep, stages["train"]))


def _sweep_series(sweep: Sweep) -> list[Series]:
    scores = dict.fromkeys(trial.score for trial in sweep.trials if trial.score != _CONTROL)
    trials = sorted(sweep.trials, key=lambda trial: trial.gaussians)
    return [Series(
        score,
        tuple((float(trial.gaussians), trial.psnr_db) for trial in trials if trial.score == score),
        color=1 if score == sweep.score else 2 + number % 6, mark=MARKS[number % 4],
        dashed=score == "random")
        # the score in use is drawn last, on top
        for number, score in enumerate(sorted(scores, key=lambda score: score == sweep.score))]


def _mark_models(stages: Statuses) -> list[Series]:
    series = []
    for name, label, color, mark in (("train", "base model", 0, "diamond"),
                                     ("prune", "pruned model", 1, "triangle")):
        summary = stages[name].summary
        decibels = summary.get("validation_psnr_db")
        if decibels is not None and "gaussians" in summary:
            series.append(Series(
                label + stages[name].stale_suffix,
                ((float(summary["gaussians"]), float(decibels)),), color, mark, line=False,
                big=True))
    return series


def _bytes_per_gaussian(train: StageStatus) -> float | None:
    """Returns the bytes of a Gaussian in the .ply of the training, whose rows are equally long."""
    path, count = train.folder / "splats.ply", train.summary.get("gaussians")
    return path.stat().st_size / count if count and path.is_file() else None


def _why_stale(path: Path, sweep: Sweep, train: StageStatus) -> str:
    """Returns why a sweep does not belong to the present training; empty if it does."""
    if train.manifest is None:
        return "the training that it started from is gone"
    if sweep.of_train is not None:
        if sweep.of_train != train.manifest.digest:
            return "it started from another training"
    elif path.stat().st_mtime < datetime.fromisoformat(train.manifest.run.finished).timestamp():
        return "it is older than the training"
    return "" if train.fresh else f"the training that it started from is stale: {train.why}"
