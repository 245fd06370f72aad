"""The curves of training and pruning, from the logs that they keep."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from markupsafe import Markup

from recon_cli.errors import FormatError
from recon_cli.page.chart import Axis, Series, chart
from recon_cli.page.records import BASE, PRUNED, LogRow, Metrics, read_log
from recon_cli.page.standing import Standing

STEP = Axis("step")
_LABELS = {"train": "training", "prune": "after pruning"}
_COLORS = {"train": 0, "prune": 1}


@dataclass(frozen=True)
class Curves:
    """What the page shows of the training.

    Attributes:
        figures: the charts.
        notes: what must be known to read them, sentences.
        damaged: why a log is not shown.
    """

    figures: tuple[Markup, ...]
    notes: tuple[str, ...]
    damaged: tuple[str, ...]


def curves(stages: Mapping[str, Standing], metrics: Metrics | None) -> Curves:
    """Returns the charts of what train and prune logged.

    Args:
        stages: how they stand, by name.
        metrics: scores on the held-out views, which are marked beside the curves; None without.
    """
    logs, damaged = {}, []
    for name in _LABELS:
        if stages[name].there:
            try:
                logs[name] = read_log(stages[name].folder / "log.jsonl")
            except FormatError as error:
                damaged.append(f"The log of {name} is not shown: {error.message}")
    labels = {name: f"{_LABELS[name]}{'' if stages[name].fresh else ' (stale)'}" for name in logs}

    def series(value: Callable[[LogRow], float | None], *, over: str = "step") -> list[Series]:
        return [Series(labels[name], tuple(
            (row.iteration if over == "step" else row.seconds, found)
            for row in rows if (found := value(row)) is not None), color=_COLORS[name],
            mark="circle" if len(rows) < 60 else "", dashed=name == "prune")
            for name, rows in logs.items()]

    decibels = Axis("PSNR, dB")
    over_time = [*series(lambda row: row.psnr_db, over="seconds"),
                 *_held_out(metrics, stages["evaluate"])]
    figures = (
        chart("Speed against error: PSNR on validation views over wall time",
              Axis("seconds", log=True), decibels, over_time),
        chart("PSNR on validation views", STEP, decibels, series(lambda row: row.psnr_db)),
        chart("Loss of a step, which sees one view", STEP, Axis("loss", log=True),
              series(lambda row: row.loss)),
        chart("Number of Gaussians", STEP, Axis("Gaussians"), series(lambda row: row.gaussians)),
        chart("Wall time", STEP, Axis("seconds"), series(lambda row: row.seconds)),
    )
    return Curves(figures, tuple(_jumps(logs)), tuple(damaged))


def _held_out(metrics: Metrics | None, evaluate: Standing) -> list[Series]:
    """Returns where the finished models lie, by their seconds and the held-out views."""
    if metrics is None:
        return []
    names = {BASE: ("held out, base", 0, "diamond"), PRUNED: ("held out, pruned", 1, "triangle")}
    old = "" if evaluate.fresh else " (stale)"
    return [Series(label + old, ((model.train_seconds, model.psnr_db),), color, mark, line=False,
                   big=True)
            for key, (label, color, mark) in names.items()
            if (model := metrics.models.get(key)) and model.train_seconds]


def _jumps(logs: Mapping[str, tuple[LogRow, ...]]) -> list[str]:
    return [f"The validation views gained nothing more: {_LABELS[name]} stopped at step "
            f"{row.iteration:,} and went on at {row.goes_on_at:,} of the plan."
            for name, rows in logs.items() for row in rows if row.goes_on_at is not None]
