"""What removing Gaussians costs: the sweep, with the workspace's own models, and the rounds."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from markupsafe import Markup

from recon_cli.errors import FormatError
from recon_cli.report.chart import MARKS, Axis, Series, chart
from recon_cli.report.records import BASE, PRUNED, LogRow, Metrics, Sweep, read_log, read_sweep
from recon_cli.report.stage_status import Standing

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


SWEEP = "sweep.json"
_NONE = "none"  # the score of controls, which remove nothing


@dataclass(frozen=True)
class Curve:
    """The prune curve.

    Attributes:
        figure: the chart; None where no sweep was kept.
        stale: why it is not of the training that is there; empty where it is.
        damaged: why a sweep that is there is not shown; empty otherwise.
    """

    figure: Markup | None
    stale: str
    damaged: str


def curve(root: Path, stages: Mapping[str, Standing]) -> Curve:
    """Returns PSNR on validation views against Gaussians and megabytes.

    Args:
        root: of the workspace.
        stages: how they stand, by name.
    """
    path = root / SWEEP
    if not path.is_file():
        return Curve(None, "", "")
    try:
        sweep = read_sweep(path)
    except FormatError as error:
        return Curve(None, "", f"The sweep is not shown: {error.message}")
    found = [*_scores(sweep), *_models(stages), *_controls(sweep)]
    each = _bytes_each(stages)
    figure = chart(
        f"PSNR on {sweep.views} validation views after {sweep.steps} steps of recovery",
        Axis("Gaussians that are left"), Axis("PSNR, dB"), found,
        above=("megabytes of the .ply", each / 1e6) if each else None)
    return Curve(figure, _stale(path, sweep, stages["train"]), "")


def rounds(stage: Standing) -> Markup | None:
    """Returns what each round of the pruning cost; None where the stage told of none."""
    told = [one for one in stage.summary.get("rounds", ())
            if isinstance(one, Mapping) and one.get("validation_psnr_db") is not None]
    before = stage.summary.get("validation_psnr_db_before")
    start = [(float(stage.summary["gaussians_before"]), float(before))] if before else []
    if not told:
        return None

    def points(kept: bool) -> tuple[tuple[float, float], ...]:
        return tuple((float(one["gaussians"]), float(one["validation_psnr_db"]))
                     for one in told if bool(one["kept"]) is kept)

    return chart(
        "Rounds of removal: PSNR on validation views at the end of each",
        Axis("Gaussians that are left"), Axis("PSNR, dB"), [
            Series("rounds", points(kept=True), 1, "circle"),
            Series("taken back", points(kept=False), 3, "cross", line=False),
            Series("before the first removal", tuple(start), 0, "diamond", line=False, big=True)])


def _scores(sweep: Sweep) -> list[Series]:
    names = dict.fromkeys(one.score for one in sweep.trials if one.score != _NONE)
    ordered = sorted(names, key=lambda name: name == sweep.score)  # the one in use on top
    return [Series(
        name, tuple((float(one.gaussians), one.psnr_db) for one in sorted(
            sweep.trials, key=lambda one: one.gaussians) if one.score == name),
        color=1 if name == sweep.score else 2 + number % 6, mark=MARKS[number % 4],
        dashed=name == "random") for number, name in enumerate(ordered)]


def _controls(sweep: Sweep) -> list[Series]:
    """Returns what as many steps give without removing anything."""
    return [Series("no prune, as many steps", tuple(
        (float(one.gaussians), one.psnr_db) for one in sweep.trials
        if one.score == _NONE and one.ratio is None), 7, "bar", line=False, big=True)]


def _models(stages: Mapping[str, Standing]) -> list[Series]:
    """Returns the models of the workspace by their own validation PSNR."""
    found = []
    for name, label, color, mark in (("train", "base model", 0, "diamond"),
                                     ("prune", "pruned model", 1, "triangle")):
        summary, fresh = stages[name].summary, stages[name].fresh
        decibels = summary.get("validation_psnr_db")
        if decibels is not None and "gaussians" in summary:
            found.append(Series(
                label + ("" if fresh else " (stale)"),
                ((float(summary["gaussians"]), float(decibels)),), color, mark, line=False,
                big=True))
    return found


def _bytes_each(stages: Mapping[str, Standing]) -> float | None:
    """Returns the bytes of a Gaussian in the .ply of the training, whose rows are all as long."""
    path, count = stages["train"].folder / "splats.ply", stages["train"].summary.get("gaussians")
    return path.stat().st_size / count if count and path.is_file() else None


def _stale(path: Path, sweep: Sweep, train: Standing) -> str:
    """Returns why a sweep is not of the training that is there; empty where nothing says so."""
    if train.manifest is None:
        return "the training that it was made from is gone"
    if sweep.of_train is not None:
        if sweep.of_train != train.manifest.digest:
            return "it was made from another training"
    elif path.stat().st_mtime < datetime.fromisoformat(train.manifest.run.finished).timestamp():
        return "it is older than the training"
    return "" if train.fresh else f"the training that it was made from is stale: {train.why}"
