"""What the study finds: figures by scene, arm and seed, and how its JSON file names them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from recon_cli.config.settings import Settings
from recon_cli.config.stages import ComputeConfig, RunConfig
from recon_cli.evaluation.intervals import Interval, Spread, paired_t
from recon_cli.experiments.host import Host
from recon_cli.experiments.records import Record
from recon_cli.experiments.train_result import shared
from recon_cli.experiments.trial import Point
from recon_cli.experiments.variants import BUDGET, BUDGET_PRUNED, PAPER, REFERENCE, Arm

# The paper compares the first two; the others are what `recon train` does without and with --prune.
ARMS: tuple[Arm, ...] = (REFERENCE, PAPER, BUDGET, BUDGET_PRUNED)
BASELINE, DEFAULT = REFERENCE, BUDGET  # what the others are held against
EQUAL_STEPS, EQUAL_SECONDS = "equal steps", "equal seconds"
COMPARISONS = (EQUAL_STEPS, EQUAL_SECONDS)


@dataclass(frozen=True)
class Request:
    """The options of the verb.

    Attributes:
        scenes: workspaces or data sets with poses.
        seeds: runs of each arm.
        iterations: steps of every arm where steps are equal.
        base: options that all arms share, size and cap included.
        out: folder of records, tables and the workspaces of data sets.
        settings: options of ingest, denoise and sfm for data sets.
        compute: device, backend and threads.
        clock: "wall" or "cpu": which seconds are made equal.
    """

    scenes: tuple[Path, ...]
    seeds: int
    iterations: int
    base: RunConfig
    out: Path
    settings: Settings = field(default_factory=dict)
    compute: ComputeConfig = field(default_factory=ComputeConfig)
    clock: str = "wall"


SCHEMA, VERSION = "recon-study", 1
MEAN = "all scenes"  # where tables name a scene: their mean

Figure = Callable[[Point], float]
FIGURES: Mapping[str, Figure] = {
    "psnr_db": lambda point: point.psnr_db, "ssim": lambda point: point.ssim,
    "gaussians": lambda point: point.gaussians, "megabytes": lambda point: point.bytes / 1e6,
    "seconds": lambda point: point.seconds, "cpu_seconds": lambda point: point.cpu_seconds,
    "steps": lambda point: point.iteration}
PAIRS: tuple[tuple[Arm, Arm], ...] = (
    *((arm, BASELINE) for arm in ARMS if arm is not BASELINE),
    *((arm, DEFAULT) for arm in ARMS if arm not in (BASELINE, DEFAULT)))


@dataclass(frozen=True)
class SceneResult:
    """All runs on one scene.

    Attributes:
        views: test views that were scored.
        width: of the first of them in pixels.
        height: of the first of them in pixels.
        digest: of what the scene holds.
        runs: by comparison, then arm, then seed.
    """

    views: int
    width: int
    height: int
    digest: str
    runs: Mapping[str, Mapping[str, tuple[Record, ...]]]

    def values(self, comparison: str, arm: Arm, figure: str) -> list[float]:
        """Returns a figure by seed."""
        return [FIGURES[figure](record.point) for record in self.runs[comparison][arm.name]]


@dataclass(frozen=True)
class Result:
    """The study.

    Attributes:
        host: where the tables were made.
        seeds: runs of each arm.
        base: options that all arms share.
        clock: which seconds were made equal.
        scenes: by name.
    """

    host: Host
    seeds: int
    base: RunConfig
    clock: str
    scenes: Mapping[str, SceneResult]

    @property
    def rows(self) -> tuple[str, ...]:
        """The scenes, and their mean where there are several."""
        return (*self.scenes, *((MEAN,) if len(self.scenes) > 1 else ()))

    def parts(self, scene: str) -> dict[str, str]:
        """Returns what the model of each arm was made of, by arm."""
        runs = next(iter(self.scenes[scene].runs.values()))
        return {name: records[0].parts for name, records in runs.items()}

    @property
    def machines(self) -> tuple[str, ...]:
        """The machines that the runs were made on."""
        return tuple(dict.fromkeys(
            record.machine for scene in self.scenes.values() for arms in scene.runs.values()
            for records in arms.values() for record in records))

    def values(self, row: str, comparison: str, arm: Arm, figure: str) -> list[float]:
        """Returns a figure by seed, of a scene or of the mean over all."""
        scenes = self.scenes.values() if row == MEAN else (self.scenes[row],)
        by_scene = [scene.values(comparison, arm, figure) for scene in scenes]
        return [sum(seed) / len(by_scene) for seed in zip(*by_scene, strict=True)]

    def spread(self, row: str, comparison: str, arm: Arm, figure: str) -> Spread:
        """Returns mean and standard deviation over the seeds."""
        return Spread.of(self.values(row, comparison, arm, figure))

    def difference(
        self, row: str, comparison: str, ours: Arm, theirs: Arm, figure: str
    ) -> Interval:
        """Returns the paired difference of two arms over the seeds."""
        return paired_t(self.values(row, comparison, ours, figure),
                        self.values(row, comparison, theirs, figure))

    def record(self) -> dict[str, Any]:
        """Returns what the JSON file holds."""
        return {
            "schema": SCHEMA, "version": VERSION, "machine": asdict(self.host),
            "run_on": list(self.machines), "seeds": self.seeds, "base": shared(self.base),
            "clock": self.clock, "arms": [arm.record() | {"label": arm.label} for arm in ARMS],
            "scenes": {name: {
                "views": scene.views, "width": scene.width, "height": scene.height,
                "digest": scene.digest, "parts": self.parts(name),
            } for name, scene in self.scenes.items()},
            "comparisons": {
                name: {row: self._compared(row, name) for row in self.rows}
                for name in next(iter(self.scenes.values())).runs},
        }

    def _compared(self, row: str, comparison: str) -> dict[str, Any]:
        return {
            "arms": {arm.name: {
                figure: {"by_seed": self.values(row, comparison, arm, figure),
                         **asdict(self.spread(row, comparison, arm, figure))}
                for figure in FIGURES} for arm in ARMS},
            "differences": {f"{ours.name} - {theirs.name}": {
                figure: self._difference(row, comparison, ours, theirs, figure)
                for figure in ("psnr_db", "ssim")} for ours, theirs in PAIRS},
        }

    def _difference(
        self, row: str, comparison: str, ours: Arm, theirs: Arm, figure: str
    ) -> dict[str, Any]:
        found = self.difference(row, comparison, ours, theirs, figure)
        return {**asdict(found), "shown": found.verdict}
