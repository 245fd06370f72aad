"""`recon study`: the paper's experiment, repeated over seeds, at equal steps and equal seconds.

Shown beside Table I of the paper, "3D Reconstruction of Indoor Scenes Based on 3DGS Models".
"""

from __future__ import annotations

import logging
import statistics
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from recon_cli.config.stages import RunConfig
from recon_cli.evaluation.intervals import Interval, Spread, paired_t
from recon_cli.evaluation.metrics import PSNR_CONVENTION, SSIM_CONVENTION
from recon_cli.evaluation.scores import Table, or_dash
from recon_cli.experiments.clock import Host
from recon_cli.experiments.outputs import Result, add_legend, drawing
from recon_cli.experiments.paper_tables import (
    CAUTION,
    PublishedScores,
    published_gains,
    published_scores,
    table_i,
    table_ii,
)
from recon_cli.experiments.runner import (
    FIGURES,
    ExperimentRequest,
    Record,
    Runner,
    Runs,
    SceneRuns,
    key_of,
    open_records,
    shared_options,
)
from recon_cli.experiments.scenes import ExperimentScene, check_scenes
from recon_cli.experiments.variants import (
    BUDGET,
    BUDGET_PRUNED,
    PAPER,
    REFERENCE,
    TrainingRun,
    Variant,
)
from recon_cli.progress import Progress
from recon_cli.workspace import atomic
from recon_cli.workspace.json_record import sha256_json
from recon_cli.workspace.layout import disk_errors, hold_lock, make_folder
from recon_cli.workspace.steps import StepFolder

# The paper compares the first two; the others are `recon train` without and with --prune.
VARIANTS: tuple[Variant, ...] = (REFERENCE, PAPER, BUDGET, BUDGET_PRUNED)
BASELINE, DEFAULT = REFERENCE, BUDGET  # the others are compared with these
EQUAL_STEPS, EQUAL_SECONDS = COMPARISONS = ("equal steps", "equal seconds")


@dataclass(frozen=True)
class Design:
    """The variants of a study, and how they are compared."""

    variants: tuple[Variant, ...]
    comparisons: tuple[str, ...]
    paper_tables: bool = False  # Tables I and II of the paper, whole, come first

    @property
    def pairs(self) -> tuple[tuple[Variant, Variant], ...]:
        """The variants whose differences are shown."""
        others = [variant for variant in self.variants if variant is not BASELINE]
        return (*((variant, BASELINE) for variant in others),
                *((variant, DEFAULT) for variant in others if variant is not DEFAULT))


STUDY = Design(VARIANTS, COMPARISONS)
PAPER_TABLES = Design((REFERENCE, PAPER, BUDGET), (EQUAL_STEPS,), paper_tables=True)
PAIRS = STUDY.pairs
MEAN = "all scenes"  # in place of a scene's name: the mean over scenes
_NEAR = 0.05  # relative: the seconds of a repeated run differ by as much

SCORES = ("psnr_db", "ssim")  # the figures whose differences are shown
_SUFFIXES = {"latex": "tex", "csv": "csv"}
_OFFSET = 0.18  # between the lines of two variants, where two scenes are 1 apart

logger = logging.getLogger("recon")


@dataclass(frozen=True, kw_only=True)
class StudyRequest(ExperimentRequest):
    """The options of `recon study`."""

    iterations: int  # steps of every variant where steps are equal
    out: Path  # folder of records, tables and the workspaces of data sets
    clock: str = "wall"  # or "cpu": which seconds are made equal
    design: Design = STUDY


@dataclass(frozen=True)
class StudyResult:
    """The runs of a study, and the figures made of them."""

    host: Host  # where the tables were made
    seeds: int
    base: RunConfig
    clock: str
    scenes: Mapping[str, SceneRuns]
    digests: Mapping[str, str]  # of the scenes' files
    design: Design = STUDY

    @property
    def rows(self) -> tuple[str, ...]:
        """The scenes, and their mean where there are several."""
        return (*self.scenes, *((MEAN,) if len(self.scenes) > 1 else ()))

    def parts(self, scene: str) -> dict[str, str]:
        """Returns the optional parts in the model of each variant."""
        return {name: records[0].parts
                for name, records in self.scenes[scene].runs[EQUAL_STEPS].items()}

    @property
    def machines(self) -> tuple[str, ...]:
        """The machines that the runs were made on."""
        return tuple(dict.fromkeys(
            record.machine for scene in self.scenes.values() for runs in scene.runs.values()
            for records in runs.values() for record in records))

    def values(self, row: str, comparison: str, variant: Variant, figure: str) -> list[float]:
        """Returns a figure by seed, of a scene or of the mean over all."""
        scenes = self.scenes.values() if row == MEAN else (self.scenes[row],)
        by_scene = [
            [FIGURES[figure].value(record.last) for record in scene.runs[comparison][variant.name]]
            for scene in scenes]
        return [sum(values) / len(by_scene) for values in zip(*by_scene, strict=True)]

    def spread(self, row: str, comparison: str, variant: Variant, figure: str) -> Spread:
        """Returns mean and standard deviation over the seeds."""
        return Spread.from_values(self.values(row, comparison, variant, figure))

    def difference(
        self, row: str, comparison: str, pair: tuple[Variant, Variant], figure: str
    ) -> Interval:
        """Returns the paired difference of two variants over the seeds."""
        return paired_t(*(self.values(row, comparison, variant, figure) for variant in pair))

    def record(self) -> dict[str, Any]:
        """Returns the content of study.json."""
        return {
            "schema": "recon-study", "version": 1, "machine": asdict(self.host),
            "run_on": list(self.machines), "seeds": self.seeds,
            "base": shared_options(self.base), "clock": self.clock,
            "arms": [variant.record() | {"label": variant.label}
                     for variant in self.design.variants],
            "scenes": {name: {
                **scene.size_record(), "digest": self.digests[name], "parts": self.parts(name),
            } for name, scene in self.scenes.items()},
            "comparisons": {
                name: {row: self._comparison_record(row, name) for row in self.rows}
                for name in next(iter(self.scenes.values())).runs}}

    def _comparison_record(self, row: str, comparison: str) -> dict[str, Any]:
        def interval(pair: tuple[Variant, Variant], figure: str) -> dict[str, Any]:
            difference = self.difference(row, comparison, pair, figure)
            return {**asdict(difference), "shown": difference.verdict}

        return {
            "arms": {variant.name: {
                figure: {"by_seed": self.values(row, comparison, variant, figure),
                         **asdict(self.spread(row, comparison, variant, figure))}
                for figure in FIGURES} for variant in self.design.variants},
            "differences": {f"{pair[0].name} - {pair[1].name}": {
                figure: interval(pair, figure) for figure in SCORES}
                for pair in self.design.pairs}}


def run(request: StudyRequest, progress: Progress) -> Result:
    """Makes the missing runs, writes the files, and returns the result."""
    paths, out = check_scenes(request.scenes), request.out
    make_folder(out)
    with (disk_errors(out, "running study"),
          hold_lock(out, "study", other="another folder with --out")):
        records = open_records(out)
        host, loading = request.load(paths, out / "scenes", "test", progress)
        machine = f"{host.cpu}, {host.device}, {host.threads} threads"
        study = Study(request, records, progress, machine)
        scenes = study.load(loading, len(paths))
        studied = StudyResult(
            host, request.seeds, request.base, request.clock,
            {loaded.folders.name: study.run_scene(loaded) for loaded in scenes},
            {loaded.folders.name: loaded.folders.digest for loaded in scenes}, request.design)
        result = Result(studied.record(), head(studied), tables(studied), notes(studied),
                        lambda path: draw(studied, path))
        result.save(out, "study")
        for form in ("latex", "csv") if request.design.paper_tables else ():
            atomic.write_text(out / f"study.{_SUFFIXES[form]}", result.format(form) + "\n")
        atomic.write_text(out / "study.md", f"# The paper's experiment\n\n{result.markdown()}\n")
    return result


def equal_seconds(iterations: int, seconds: Mapping[str, float]) -> dict[str, int]:
    """Returns the steps of each variant that take as long as the slowest's, by a first guess."""
    slowest = max(seconds.values())
    return {name: max(iterations, round(iterations * slowest / own)) if own > 0 else iterations
            for name, own in seconds.items()}


def correct_steps(
    iterations: int, guess: int, seconds: float, guess_seconds: float, target: float
) -> int:
    """Returns the steps that take `target` seconds, on the line through two measured runs."""
    near = abs(guess_seconds - target) <= _NEAR * target
    if near or guess <= iterations or guess_seconds <= seconds:
        return guess
    steps = iterations + (target - seconds) * (guess - iterations) / (guess_seconds - seconds)
    return max(iterations, round(steps))


class Study:
    """The runs of a study: recorded ones, and those still to be made."""

    def __init__(
        self, request: StudyRequest, records: StepFolder, progress: Progress, machine: str
    ) -> None:
        self._request, self._records, self._progress = request, records, progress
        self._runner = Runner(request.base, progress, machine, records)
        self._variants = request.design.variants

    def load(self, loading: Iterable[ExperimentScene], count: int) -> list[ExperimentScene]:
        """Returns all of `count` scenes, and says how many runs are missing.

        To make cameras for a scene takes minutes, so how long all will take is said as soon as the
        first scene with missing runs is there.
        """
        each = len(self._request.design.comparisons) * len(self._variants) * self._request.seeds
        logger.warning("at most %d runs of about %s steps; their time is estimated on the first "
                       "scene", count * each, f"{self._request.iterations:,}")
        scenes, missing, start = list[ExperimentScene](), 0, time.monotonic()
        for loaded in loading:
            scenes.append(loaded)
            counts = {variant.name: self._count_missing(loaded, variant)
                      for variant in self._variants}
            if any(counts.values()) and not missing:
                ahead = count - len(scenes)
                seconds = (ahead * (time.monotonic() - start) / len(scenes)
                           + (ahead + 1) * self._estimate_seconds(loaded, counts))
                logger.warning("about %s minutes for all, by short runs on %s",
                               f"{max(1, round(seconds / 60)):,}", loaded.folders.name)
            missing += sum(counts.values())
        recorded = count * each - missing
        if missing:
            logger.warning(
                "about %d runs are to be made, %d are kept from before", missing, recorded)
        else:
            logger.warning("all %d runs are kept from before", recorded)
        return scenes

    def _estimate_seconds(self, loaded: ExperimentScene, counts: Mapping[str, int]) -> float:
        """Returns how long so many runs of each variant take on a scene."""
        seeds, iterations = self._request.seeds, self._request.iterations
        steps = self._runner.pilot_seconds(loaded, self._variants, most=iterations)
        loaded.release()
        slowest = max(steps.values())
        return iterations * sum(
            steps[name] * min(count, seeds) + slowest * max(0, count - seeds)
            for name, count in counts.items())

    def _count_missing(self, loaded: ExperimentScene, variant: Variant) -> int:
        """Returns how many runs of a variant are missing; those of unknown steps are, too."""
        steps: list[Mapping[str, int] | None] = [{variant.name: self._request.iterations}]
        if EQUAL_SECONDS in self._request.design.comparisons:
            fixed = self._records.result(self._steps_key(loaded))
            steps.append(fixed and fixed["steps"])
        return sum(
            by_variant is None or self._runner.find_record(loaded, TrainingRun(
                variant, self._request.base, by_variant[variant.name], seed)) is None
            for by_variant in steps for seed in range(self._request.seeds))

    def run_scene(self, loaded: ExperimentScene) -> SceneRuns:
        """Returns all runs on a scene; the missing ones are made now."""
        steps = dict.fromkeys(
            (variant.name for variant in self._variants), self._request.iterations)
        runs = {EQUAL_STEPS: self._run_all(loaded, EQUAL_STEPS, steps)}
        if EQUAL_SECONDS in self._request.design.comparisons:
            runs[EQUAL_SECONDS] = self._run_all(
                loaded, EQUAL_SECONDS, self._steps(loaded, runs[EQUAL_STEPS]))
        loaded.release()
        return SceneRuns.from_loaded(loaded, runs)

    def _run_all(self, loaded: ExperimentScene, comparison: str, steps: Mapping[str, int]) -> Runs:
        return self._runner.run_all(
            loaded, self._variants, self._request.seeds, steps,
            label=f"{loaded.folders.name}, {comparison}")

    def _steps(self, loaded: ExperimentScene, equal: Runs) -> Mapping[str, int]:
        """Returns the steps at equal seconds: fixed ones, or a guess corrected by one run each."""
        key, count = self._steps_key(loaded), self._request.iterations
        if (fixed := self._records.result(key)) is not None:
            return dict(fixed["steps"])
        seconds = {name: statistics.median(self._seconds(record) for record in records)
                   for name, records in equal.items()}
        steps = equal_seconds(count, seconds)
        label = f"{loaded.folders.name}, finding {EQUAL_SECONDS}"
        with self._progress.bar(label, sum(steps.values()), unit="step") as bar:
            for name, variant in zip(steps, self._variants, strict=True):
                guess = TrainingRun(variant, self._request.base, steps[name], 0)
                record = self._runner.find_record(loaded, guess) or self._runner.make(
                    loaded, guess, (), bar.advance)
                steps[name] = correct_steps(
                    count, steps[name], seconds[name], self._seconds(record), max(seconds.values()))
        self._records.finish(key, {"steps": steps})
        return steps

    def _seconds(self, record: Record) -> float:
        clock = "cpu_seconds" if self._request.clock == "cpu" else "seconds"
        return FIGURES[clock].value(record.last)

    def _steps_key(self, loaded: ExperimentScene) -> str:
        """Returns the key of the steps at equal seconds, whatever the number of seeds."""
        request = self._request
        first = [key_of(loaded, TrainingRun(variant, request.base, request.iterations, 0))
                 for variant in self._variants]
        return sha256_json({"steps of": first, "clock": request.clock})


def tables(result: StudyResult) -> list[Table]:
    """Returns scores and differences of each comparison, and the paper's scores if they apply."""
    found = [make(result, comparison)
             for comparison in result.design.comparisons for make in (scores, differences)]
    if result.design.paper_tables:
        return [*paper_tables(result), *found]
    beside = beside_the_paper(result)
    return found if beside is None else [*found, beside]


def paper_tables(result: StudyResult) -> list[Table]:
    """Returns Tables I and II with the printed scores beside those of this study."""
    variants = {variant.label: variant for variant in result.design.variants}

    def here(scene: str, method: str) -> tuple[float, float] | None:
        row = next((name for name in result.scenes if name.lower() == scene.lower()), None)
        if row is None:
            return None
        psnr_db, ssim = (result.spread(row, EQUAL_STEPS, variants[method], figure).mean
                         for figure in SCORES)
        return psnr_db, ssim

    own = [scene for scene in result.scenes if published_scores(scene) is None]
    return [table_i(tuple(variants), here, "Table I: Replica, printed and here"),
            table_ii(own, tuple(variants), here, "Table II: own captures, printed and here")]


def head(result: StudyResult) -> str:
    """Returns a line on the runs and their machines."""
    scenes = "; ".join(
        f"{name}: {scene.views} test views at {scene.width}x{scene.height}"
        for name, scene in result.scenes.items())
    return (f"{result.seeds} seeds, at most {result.base.max_gaussians:,} Gaussians; {scenes}; "
            f"run on {' and '.join(result.machines)}")


def scores(result: StudyResult, comparison: str) -> Table:
    """Returns the table of means and standard deviations."""
    header = ("scene, arm", *(
        label for name, figure in FIGURES.items()
        for label in ((figure.label, "sd") if name in SCORES else (figure.label,))))

    def cells(row: str, variant: Variant) -> Iterator[str]:
        for name, figure in FIGURES.items():
            spread = result.spread(row, comparison, variant, name)
            yield f"{spread.mean:,.{figure.digits}f}"
            if name in SCORES:
                yield or_dash(spread.deviation, f".{figure.digits}f")

    return Table(header, [
        (f"{row}, {variant.label}", *cells(row, variant))
        for row in result.rows for variant in result.design.variants], f"Scores at {comparison}")


def differences(result: StudyResult, comparison: str) -> Table:
    """Returns the table of paired differences with their intervals."""
    def cells(row: str, pair: tuple[Variant, Variant]) -> Iterator[str]:
        for name in SCORES:
            interval = result.difference(row, comparison, pair, name)
            for value in (interval.mean, interval.low, interval.high):
                yield or_dash(value, f"+.{FIGURES[name].digits}f")
            yield interval.verdict

    header = ("scene, arm - arm", *(
        label for name in SCORES for label in (FIGURES[name].label, "95% from", "to", "so it is")))
    return Table(header, [
        (f"{row}, {pair[0].label} - {pair[1].label}", *cells(row, pair))
        for row in result.rows for pair in result.design.pairs], f"Differences at {comparison}")


def beside_the_paper(result: StudyResult) -> Table | None:
    """Returns the paper's scores beside ours, None where no scene has a name of theirs."""
    rows = [_row_beside_the_paper(result, scene, published)
            for scene in result.scenes if (published := published_scores(scene))]
    header = ("scene", "paper: 3DGS dB", "SSIM", "theirs dB", "SSIM", "gain dB", "SSIM",
              "here: 3DGS dB", "SSIM", "paper's prune dB", "SSIM", "gain dB", "SSIM")
    title = f"The paper's Table I beside this study, {EQUAL_STEPS}"
    return Table(header, rows, title) if rows else None


def _row_beside_the_paper(
    result: StudyResult, scene: str, published: PublishedScores
) -> tuple[str, ...]:
    def pair(psnr_db: float, ssim: float, *, sign: str = "") -> tuple[str, str]:
        return f"{psnr_db:{sign}.2f}", f"{ssim:{sign}.3f}"

    base, paper = (
        [result.spread(scene, EQUAL_STEPS, variant, figure).mean for figure in SCORES]
        for variant in (BASELINE, PAPER))
    return (
        scene, *pair(*published[:2]), *pair(*published[2:]),
        *pair(*published_gains(published).values(), sign="+"),
        *pair(base[0], base[1]), *pair(paper[0], paper[1]),
        *pair(paper[0] - base[0], paper[1] - base[1], sign="+"))


def notes(result: StudyResult) -> list[str]:
    """Returns how the figures are to be read."""
    def list_parts(scene: str) -> str:  # variants of the same parts together
        labels: dict[str, list[str]] = {}
        for variant in result.design.variants:
            labels.setdefault(result.parts(scene)[variant.name], []).append(variant.label)
        return ", ".join(f"{parts} ({' and '.join(names)})" for parts, names in labels.items())

    design, clock = result.design, {"wall": "on the wall", "cpu": "of the CPU"}[result.clock]
    count = len(result.rows) * len(design.pairs) * len(SCORES) * len(design.comparisons)
    lines = [*[
        f"Equal seconds: each arm takes as many steps as fit into the seconds {clock} that the "
        "slowest arm's take at equal steps, as measured first; the steps are "
        "then fixed. Seconds are of training, pruning included, without scoring."
        ] * (EQUAL_SECONDS in design.comparisons),
        "Each arm is trained on " + "; ".join(
            f"{scene}: {list_parts(scene)}" for scene in result.scenes)
        + ". The trials that decide so are not timed.",
        "Intervals: 95% by Student's t over the differences seed by seed. They cover other seeds "
        f"on these scenes, not other scenes. Of {count} intervals about "
        f"{max(1, round(0.05 * count))} would leave out 0 by chance if no arm differed.",
        f"PSNR: {PSNR_CONVENTION}. SSIM: {SSIM_CONVENTION}. Scored on held-out test views, which "
        "nothing was tuned on."]
    if design.paper_tables or beside_the_paper(result) is not None:
        lines.insert(0, CAUTION)
    if result.seeds < 5:
        lines.append(f"{result.seeds} seeds are few: a claim needs 5.")
    if len(result.machines) > 1:
        lines.append("The runs are of several machines: their seconds do not compare.")
    return lines


def draw(result: StudyResult, path: Path) -> None:
    """Draws means and intervals into a .png or .svg; a cross is the gain in the paper."""
    with drawing(path, 13, 2 + 1.4 * len(result.rows)) as figure:
        comparisons = result.design.comparisons
        panels = figure.subplots(len(SCORES), len(comparisons), squeeze=False, sharey=True)
        for line, name in zip(panels, SCORES, strict=True):
            for axes, comparison in zip(line, comparisons, strict=True):
                _draw_panel(axes, result, comparison, name)
                axes.set(xlabel=f"{FIGURES[name].label} against 3DGS", title=comparison)
        add_legend(figure, panels[0][0])
        figure.suptitle(f"{result.seeds} seeds, 95% intervals", fontsize=10)


def _draw_panel(axes: Any, result: StudyResult, comparison: str, figure: str) -> None:
    others = [variant for variant in result.design.variants if variant is not BASELINE]
    for number, variant in enumerate(others):
        intervals = [result.difference(row, comparison, (variant, BASELINE), figure)
                     for row in result.rows]
        axes.errorbar(
            [interval.mean for interval in intervals],
            [row + _OFFSET * (number - 1) for row in range(len(intervals))],
            xerr=[0.0 if interval.high is None else interval.high - interval.mean
                  for interval in intervals],
            fmt="o", markersize=4, capsize=3, label=variant.label, color=f"C{number}")
    for number, row in enumerate(result.rows):
        if (published := published_scores(row)) is not None:
            axes.plot(published_gains(published)[figure], number - _OFFSET, "x", color="black")
    axes.axvline(0, color="0.6", linewidth=0.8, zorder=0)
    axes.set_yticks(range(len(result.rows)), result.rows)
    axes.set_ylim(len(result.rows) - 0.5, -0.5)
    axes.grid(axis="x", color="0.92")
