"""The charts of the page: training and pruning logs, and pruning rounds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from markupsafe import Markup

from recon_cli.errors import FormatError
from recon_cli.evaluation.scores import Metrics
from recon_cli.report.chart import Axis, Series, draw_chart
from recon_cli.report.records import BASE, PRUNED, read_log
from recon_cli.report.stage_status import StageReport, StageReports
from recon_cli.workspace.digests import digest_file
from recon_cli.workspace.summaries import LogRow, PruneSummary

_STEP, _DECIBELS, _LEFT = Axis("step"), Axis("PSNR, dB"), Axis("Gaussians left")
_LOG = "log.jsonl"
_STAGES = {"train": ("training", 0), "prune": ("after pruning", 1)}  # label and color


@dataclass(frozen=True)
class TrainingCurves:
    """The charts of training and pruning logs."""

    figures: tuple[Markup, ...]
    notes: tuple[str, ...]  # on how to read them, a sentence each
    damaged: tuple[str, ...]  # why a log is not shown


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
