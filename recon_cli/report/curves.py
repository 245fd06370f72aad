"""The charts of the page: training and pruning logs, pruning rounds, the prune curve."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from markupsafe import Markup

from recon_cli.errors import FormatError
from recon_cli.evaluation.scores import Metrics, Sweep
from recon_cli.report.chart import MARKS, Axis, Series, draw_chart
from recon_cli.report.records import BASE, PRUNED, read_log, read_sweep
from recon_cli.report.stage_status import StageReport, StageReports
from recon_cli.workspace.digests import digest_file
from recon_cli.workspace.summaries import LogRow, PruneSummary, TrainSummary

_STEP, _DECIBELS, _LEFT = Axis("step"), Axis("PSNR, dB"), Axis("Gaussians left")
_LOG = "log.jsonl"
_STAGES = {"train": ("training", 0), "prune": ("after pruning", 1)}  # label and color


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


def draw_training_curves(stages: StageReports, metrics: Metrics | None) -> TrainingCurves:
    """Returns the charts of the logs of train and prune, with held-out scores as marks."""
    logs, damaged, notes = {}, [], []
    for name, (label, _) in _STAGES.items():
        manifest = stages[name].manifest
        if manifest is not None and _LOG in manifest.outputs:  # an imported scene has none
            try:
                path = stages[name].folder / _LOG
                logs[name] = read_log(path)
                known = manifest.outputs[_LOG]
                if digest_file(path, known).sha256 != known.sha256:
                    notes.append(f"The log of {name} was changed since: its curves may be wrong.")
            except FormatError as error:
                damaged.append(f"The log of {name} is not shown: {error.message}")
        notes += [f"Validation PSNR stopped improving: {label} jumped from step {row.iteration:,} "
                  f"to step {row.skip_to_iteration:,} of the schedule."
                  for row in logs.get(name, ()) if row.skip_to_iteration is not None]

    def series(value: Callable[[LogRow], float | None], *, over: str = "iteration") -> list[Series]:
        return [Series(
            _STAGES[name][0] + stages[name].stale_suffix,
            tuple((getattr(row, over), y) for row in rows if (y := value(row)) is not None),
            color=_STAGES[name][1], mark="circle" if len(rows) < 60 else "",
            dashed=name == "prune") for name, rows in logs.items()]

    over_time = [*series(lambda row: row.validation_psnr_db, over="seconds"),
                 *_mark_held_out(metrics, stages["evaluate"])]
    figures = (
        draw_chart("PSNR on validation views over wall time", Axis("seconds", log=True), _DECIBELS,
                   over_time),
        draw_chart("PSNR on validation views", _STEP, _DECIBELS,
                   series(lambda row: row.validation_psnr_db)),
        draw_chart("Training loss of one view at a time", _STEP, Axis("loss", log=True),
                   series(lambda row: row.loss)),
        draw_chart("Number of Gaussians", _STEP, Axis("Gaussians"),
                   series(lambda row: row.gaussians)),
        draw_chart("Wall time", _STEP, Axis("seconds"), series(lambda row: row.seconds)),
    )
    return TrainingCurves(figures, tuple(notes), tuple(damaged))


def _mark_held_out(metrics: Metrics | None, evaluate: StageReport) -> list[Series]:
    """Returns one mark for each model: its training seconds and held-out PSNR."""
    styles = {BASE: ("held out, original", 0, "diamond"),
              PRUNED: ("held out, compact", 1, "triangle")}
    return [Series(label + evaluate.stale_suffix, ((model.train_seconds, model.psnr_db),), color,
                   mark, line=False, big=True)
            for key, (label, color, mark) in styles.items()
            if metrics and (model := metrics.models.get(key)) and model.train_seconds]


def draw_rounds(prune: StageReport) -> Markup | None:
    """Returns the PSNR after each round of pruning; None where no round was scored."""
    summary = prune.read_summary(PruneSummary)
    if summary is None or all(row.validation_psnr_db is None for row in summary.rounds):
        return None

    def points(*, kept: bool) -> tuple[tuple[float, float], ...]:
        return tuple((row.gaussians, row.validation_psnr_db) for row in summary.rounds
                     if row.kept is kept and row.validation_psnr_db is not None)

    before = summary.validation_psnr_db_before
    start = ((summary.gaussians_before, before),) if before else ()
    return draw_chart(
        "Rounds of removal: PSNR on validation views at the end of each", _LEFT, _DECIBELS, [
            Series("rounds", points(kept=True), 1, "circle"),
            Series("taken back", points(kept=False), 3, "cross", line=False),
            Series("before the first removal", start, 0, "diamond", line=False, big=True)])


def draw_prune_curve(root: Path, stages: StageReports) -> PruneCurve:
    """Returns validation PSNR against Gaussians and megabytes of a sweep, its models marked."""
    path = root / Sweep.FILE
    if not path.is_file():
        return PruneCurve()
    try:
        sweep = read_sweep(path)
    except FormatError as error:
        return PruneCurve(damaged=f"The sweep is not shown: {error.message}")
    controls = tuple((trial.gaussians, trial.recovered.psnr_db) for trial in sweep.trials
                     if trial.score == Sweep.CONTROL and trial.ratio is None)
    train = stages["train"].read_summary(TrainSummary)
    ply = stages["train"].folder / "splats.ply"  # all rows are equally long
    megabytes = ply.stat().st_size / train.gaussians / 1e6 if train and ply.is_file() else None
    figure = draw_chart(
        f"PSNR on {sweep.validation_views} validation views after {sweep.recovery_steps} steps of "
        "recovery", _LEFT, _DECIBELS, [
            *_sweep_series(sweep),
            *_mark_model(stages["train"], TrainSummary, "original model", 0, "diamond"),
            *_mark_model(stages["prune"], PruneSummary, "compact model", 1, "triangle"),
            Series("no prune, as many steps", controls, 7, "bar", line=False, big=True)],
        above=("megabytes of the .ply", megabytes) if megabytes else None)
    return PruneCurve(figure, _why_stale(path, sweep, stages["train"]))


def _sweep_series(sweep: Sweep) -> list[Series]:
    scores = dict.fromkeys(trial.score for trial in sweep.trials if trial.score != Sweep.CONTROL)
    trials = sorted(sweep.trials, key=lambda trial: trial.gaussians)
    used = sweep.equal_seconds_of  # drawn last, on top
    return [Series(
        score, tuple((trial.gaussians, trial.recovered.psnr_db)
                     for trial in trials if trial.score == score),
        color=1 if score == used else 2 + number % 6, mark=MARKS[number % 4],
        dashed=score == "random")
        for number, score in enumerate(sorted(scores, key=lambda score: score == used))]


def _mark_model(
    stage: StageReport, kind: type[TrainSummary] | type[PruneSummary], label: str, color: int,
    mark: str,
) -> list[Series]:
    summary = stage.read_summary(kind)
    if summary is None or summary.validation_psnr_db is None:
        return []
    return [Series(
        label + stage.stale_suffix, ((summary.gaussians, summary.validation_psnr_db),), color, mark,
        line=False, big=True)]


def _why_stale(path: Path, sweep: Sweep, train: StageReport) -> str:
    """Returns why a sweep does not belong to the present training; empty if it does."""
    if train.manifest is None:
        return "the training that it started from is gone"
    if sweep.of_train is not None:
        if sweep.of_train != train.manifest.digest:
            return "it started from another training"
    elif path.stat().st_mtime < datetime.fromisoformat(train.manifest.run.finished).timestamp():
        return "it is older than the training"
    return "" if train.fresh else f"the training that it started from is stale: {train.why}"
