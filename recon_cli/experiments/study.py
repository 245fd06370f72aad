"""`recon study`: the paper's experiment, repeated over seeds, at equal steps and equal seconds."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from recon_cli.config.stages import RunConfig
from recon_cli.evaluation.intervals import Interval, Spread, paired_t
from recon_cli.experiments.instruments import Host
from recon_cli.experiments.runner import (
    ExperimentRequest,
    Record,
    Records,
    Runner,
    Runs,
    key_of,
    shared_options,
)
from recon_cli.experiments.trial import CurvePoint, LoadedScene, TrainingRun
from recon_cli.experiments.variants import BUDGET, BUDGET_PRUNED, PAPER, REFERENCE, Variant
from recon_cli.progress import Progress
from recon_cli.workspace.digests import sha256_json

# The paper compares the first two; the others are what `recon train` does without and with --prune.
VARIANTS: tuple[Variant, ...] = (REFERENCE, PAPER, BUDGET, BUDGET_PRUNED)
BASELINE, DEFAULT = REFERENCE, BUDGET  # what the others are compared with
PAIRS: tuple[tuple[Variant, Variant], ...] = (
    *((variant, BASELINE) for variant in VARIANTS if variant is not BASELINE),
    *((variant, DEFAULT) for variant in VARIANTS if variant not in (BASELINE, DEFAULT)))
EQUAL_STEPS, EQUAL_SECONDS = "equal steps", "equal seconds"
COMPARISONS = (EQUAL_STEPS, EQUAL_SECONDS)
MEAN = "all scenes"  # where tables name a scene: their mean
SCHEMA, VERSION = "recon-study", 1
FIGURES = {
    "psnr_db": lambda point: point.psnr_db, "ssim": lambda point: point.ssim,
    "gaussians": lambda point: point.gaussians, "megabytes": lambda point: point.bytes / 1e6,
    "seconds": lambda point: point.seconds, "cpu_seconds": lambda point: point.cpu_seconds,
    "steps": lambda point: point.iteration}
_NEAR = 0.05  # the same run takes seconds that differ by as much when it is repeated


@dataclass(frozen=True, kw_only=True)
class StudyRequest(ExperimentRequest):
    """The options of `recon study`."""

    iterations: int  # steps of every variant where steps are equal
    out: Path  # folder of records, tables and the workspaces of data sets
    clock: str = "wall"  # or "cpu": which seconds are made equal


@dataclass(frozen=True)
class StudiedScene:
    """All runs on one scene."""

    views: int  # test views that were scored
    width: int  # of the first of them in pixels
    height: int
    digest: str  # of what the scene holds
    runs: Mapping[str, Runs]  # by comparison

    def values(self, comparison: str, variant: Variant, figure: str) -> list[float]:
        """Returns a figure by seed."""
        return [FIGURES[figure](record.last) for record in self.runs[comparison][variant.name]]


@dataclass(frozen=True)
class StudyResult:
    """The study."""

    host: Host  # where the tables were made
    seeds: int
    base: RunConfig
    clock: str
    scenes: Mapping[str, StudiedScene]

    @property
    def rows(self) -> tuple[str, ...]:
        """The scenes, and their mean where there are several."""
        return (*self.scenes, *((MEAN,) if len(self.scenes) > 1 else ()))

    def parts(self, scene: str) -> dict[str, str]:
        """Returns the optional parts that the model of each variant was made of."""
        runs = next(iter(self.scenes[scene].runs.values()))
        return {name: records[0].parts for name, records in runs.items()}

    @property
    def machines(self) -> tuple[str, ...]:
        """The machines that the runs were made on."""
        return tuple(dict.fromkeys(
            record.machine for scene in self.scenes.values() for runs in scene.runs.values()
            for records in runs.values() for record in records))

    def values(self, row: str, comparison: str, variant: Variant, figure: str) -> list[float]:
        """Returns a figure by seed, of a scene or of the mean over all."""
        scenes = self.scenes.values() if row == MEAN else (self.scenes[row],)
        by_scene = [scene.values(comparison, variant, figure) for scene in scenes]
        return [sum(seed) / len(by_scene) for seed in zip(*by_scene, strict=True)]

    def spread(self, row: str, comparison: str, variant: Variant, figure: str) -> Spread:
        """Returns mean and standard deviation over the seeds."""
        return Spread.of(self.values(row, comparison, variant, figure))

    def difference(
        self, row: str, comparison: str, pair: tuple[Variant, Variant], figure: str
    ) -> Interval:
        """Returns the paired difference of two variants over the seeds."""
        return paired_t(*(self.values(row, comparison, variant, figure) for variant in pair))

    def record(self) -> dict[str, Any]:
        """Returns what the JSON file holds."""
        return {
            "schema": SCHEMA, "version": VERSION, "machine": asdict(self.host),
            "run_on": list(self.machines), "seeds": self.seeds,
            "base": shared_options(self.base), "clock": self.clock,
            "arms": [variant.record() | {"label": variant.label} for variant in VARIANTS],
            "scenes": {name: {
                "views": scene.views, "width": scene.width, "height": scene.height,
                "digest": scene.digest, "parts": self.parts(name),
            } for name, scene in self.scenes.items()},
            "comparisons": {
                name: {row: self._comparison_record(row, name) for row in self.rows}
                for name in next(iter(self.scenes.values())).runs},
        }

    def _comparison_record(self, row: str, comparison: str) -> dict[str, Any]:
        def interval(pair: tuple[Variant, Variant], figure: str) -> dict[str, Any]:
            difference = self.difference(row, comparison, pair, figure)
            return {**asdict(difference), "shown": difference.verdict}

        return {
            "arms": {variant.name: {
                figure: {"by_seed": self.values(row, comparison, variant, figure),
                         **asdict(self.spread(row, comparison, variant, figure))}
                for figure in FIGURES} for variant in VARIANTS},
            "differences": {f"{pair[0].name} - {pair[1].name}": {
                figure: interval(pair, figure) for figure in ("psnr_db", "ssim")}
                for pair in PAIRS},
        }


def equal_seconds(iterations: int, seconds: Mapping[str, float]) -> dict[str, int]:
    """Returns the steps of each variant that take as long as the slowest one's `iterations`.

    A first guess: steps of a longer run cost as much where the count has reached its cap in both.
    """
    slowest = max(seconds.values())
    return {name: max(iterations, round(iterations * slowest / own)) if own > 0 else iterations
            for name, own in seconds.items()}


def corrected_steps(
    iterations: int, guess: int, seconds: float, guess_seconds: float, target: float
) -> int:
    """Returns the steps that take `target` seconds, on the line through two measured runs.

    The runs took `iterations` steps in `seconds`, and more, `guess`, in `guess_seconds`.
    """
    near = abs(guess_seconds - target) <= _NEAR * target
    if near or guess <= iterations or guess_seconds <= seconds:
        return guess
    steps = iterations + (target - seconds) * (guess - iterations) / (guess_seconds - seconds)
    return max(iterations, round(steps))


class Study:
    """The runs of a study: those that are recorded, and those that are still to be made."""

    def __init__(
        self, request: StudyRequest, records: Records, progress: Progress, machine: str
    ) -> None:
        self._request, self._records, self._progress = request, records, progress
        self._runner = Runner(request.base, progress, machine, records)

    def announcement(self, scenes: Sequence[LoadedScene]) -> str:
        """Returns in words what is to be run and about how long it will take."""
        seconds, missing, done = 0.0, 0, 0
        seeds, iterations = self._request.seeds, self._request.iterations
        for loaded in scenes:
            counts = {variant.name: self._missing(loaded, variant) for variant in VARIANTS}
            missing += sum(counts.values())
            done += 2 * len(VARIANTS) * seeds - sum(counts.values())
            if any(counts.values()):
                costs = {name: iterations * step for name, step in
                         self._runner.pilot_seconds(loaded, VARIANTS).items()}
                seconds += sum(
                    costs[name] * min(count, seeds) + max(costs.values()) * max(0, count - seeds)
                    for name, count in counts.items())
        if not missing:
            return f"all {done} runs are kept from before"
        return (f"about {missing} runs are to be made, {done} are kept from before; about "
                f"{max(1, round(seconds / 60))} minutes")

    def _missing(self, loaded: LoadedScene, variant: Variant) -> int:
        """Returns how many runs of a variant are missing; those of unknown steps are, too."""
        steps = [{variant.name: self._request.iterations},
                 self._records.steps(self._steps_key(loaded))]
        return sum(
            by_variant is None or self._runner.find_record(
                loaded, self._run(variant, by_variant[variant.name], seed)) is None
            for by_variant in steps for seed in range(self._request.seeds))

    def run_scene(self, loaded: LoadedScene) -> StudiedScene:
        """Returns all runs on a scene, those that are missing made now."""
        steps = dict.fromkeys((variant.name for variant in VARIANTS), self._request.iterations)
        equal = self._run_all(loaded, EQUAL_STEPS, steps)
        runs = {EQUAL_STEPS: equal,
                EQUAL_SECONDS: self._run_all(loaded, EQUAL_SECONDS, self._steps(loaded, equal))}
        camera = loaded.scored[0].camera
        return StudiedScene(
            len(loaded.scored), camera.width, camera.height, loaded.folders.digest, runs)

    def _run_all(self, loaded: LoadedScene, comparison: str, steps: Mapping[str, int]) -> Runs:
        return self._runner.run_all(
            loaded, VARIANTS, self._request.seeds, steps,
            label=f"{loaded.folders.name}, {comparison}")

    def _steps(self, loaded: LoadedScene, equal: Runs) -> Mapping[str, int]:
        """Returns the steps at equal seconds; once computed they stay, whatever comes."""
        key = self._steps_key(loaded)
        steps = self._records.steps(key)
        if steps is None:
            seconds = {name: statistics.median(self._seconds(record) for record in records)
                       for name, records in equal.items()}
            steps = self._find_steps(loaded, seconds)
            self._records.add_steps(key, steps)
        return steps

    def _find_steps(self, loaded: LoadedScene, seconds: Mapping[str, float]) -> dict[str, int]:
        """Returns the steps of each variant at equal seconds, corrected by one run of its guess."""
        count, target = self._request.iterations, max(seconds.values())
        steps = equal_seconds(count, seconds)
        label = f"{loaded.folders.name}, finding {EQUAL_SECONDS}"
        with self._progress.bar(label, sum(steps.values()), unit="step") as bar:
            for variant in VARIANTS:
                guess = self._run(variant, steps[variant.name], 0)
                record = self._runner.find_record(loaded, guess) or self._runner.make(
                    loaded, guess, (), bar.advance)
                steps[variant.name] = corrected_steps(
                    count, guess.iterations, seconds[variant.name], self._seconds(record), target)
        return steps

    def _seconds(self, record: Record) -> float:
        point: CurvePoint = record.last
        return point.cpu_seconds if self._request.clock == "cpu" else point.seconds

    def _run(self, variant: Variant, iterations: int, seed: int) -> TrainingRun:
        return TrainingRun(variant, self._request.base, iterations, seed)

    def _steps_key(self, loaded: LoadedScene) -> str:
        """Returns the key of the steps at equal seconds, whatever the number of seeds."""
        first = [key_of(loaded, self._run(variant, self._request.iterations, 0))
                 for variant in VARIANTS]
        return sha256_json({"steps of": first, "clock": self._request.clock})
