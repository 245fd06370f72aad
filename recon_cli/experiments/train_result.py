"""What `recon bench train` finds, and how its JSON file names it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from recon_cli.config.settings import Settings
from recon_cli.config.stages import ComputeConfig, RunConfig
from recon_cli.errors import ConfigError
from recon_cli.experiments import bench_compare
from recon_cli.experiments.bench_plot import check_picture
from recon_cli.experiments.bench_run import refuse_missing_folders
from recon_cli.experiments.host import Host
from recon_cli.experiments.trial import Point
from recon_cli.experiments.variants import Arm

LOOKS = 20  # along a run: each scores all validation views


def looks(iterations: int, count: int = LOOKS) -> tuple[int, ...]:
    """Returns the steps to look after: 0, and `count` evenly spread ones up to the last."""
    return tuple(sorted({round(i * iterations / count) for i in range(count + 1)}))


def seconds_to(
    points: Sequence[Point], target_db: float, seconds: Callable[[Point], float]
) -> float | None:
    """Returns when a curve first reaches a PSNR, on straight lines between its points.

    Args:
        points: of one run, in order.
        target_db: to reach.
        seconds: of a point: on the wall or of the CPU.

    Returns:
        Seconds; None where no point reaches the target.
    """
    before: Point | None = None
    for point in points:
        if point.psnr_db >= target_db:
            if before is None:
                return seconds(point)
            share = (target_db - before.psnr_db) / (point.psnr_db - before.psnr_db)
            return seconds(before) + share * (seconds(point) - seconds(before))
        before = point
    return None


def common_target(runs: Sequence[Sequence[Point]]) -> float:
    """Returns the PSNR that every run reaches, down to a tenth of a dB."""
    best = min(max(point.psnr_db for point in points) for points in runs)
    return math.floor(10 * best) / 10


# A run of this size takes about half a minute on two cores and tells recipes apart.
SIZE, STEPS, CAP = 600, 3000, 60_000
SECTIONS = ("ingest", "denoise", "sfm", "train")  # that --set may reach
# of training, that have options of their own here, or no effect
_OWN = {"iterations", "max_size", "max_gaussians", "seed", "densify", "mid", "checkpoint_every",
        "quality", "minutes", "early_stop", "sh_degree"}


@dataclass(frozen=True)
class Request:
    """The options of the verb.

    Attributes:
        scenes: workspaces or data sets with poses.
        arms: the recipes.
        iterations: steps of every run; None where seconds are given or neither is.
        seconds: of every run instead; None where steps are given or neither is.
        seeds: runs of each recipe.
        targets_db: PSNR to reach; empty for what all runs of a scene reach.
        base: options that all recipes share, size and cap included.
        settings: options of ingest, denoise and sfm for data sets.
        compute: device, backend and threads.
        json_file: where all figures go.
        plot: where the picture goes.
        markdown: the page that the tables go into.

    Raises:
        ConfigError: there is no recipe, or steps and seconds are both given.
        ReconError: an output cannot be written.
    """

    scenes: tuple[Path, ...]
    arms: tuple[Arm, ...]
    iterations: int | None
    seconds: float | None
    seeds: int
    targets_db: tuple[float, ...]
    base: RunConfig
    settings: Settings = field(default_factory=dict)
    compute: ComputeConfig = field(default_factory=ComputeConfig)
    json_file: Path | None = None
    plot: Path | None = None
    markdown: Path | None = None

    def __post_init__(self) -> None:
        if not self.arms:
            raise ConfigError("No recipe was given.", hint="Try --recipes reference,budget.")
        if self.iterations is not None and self.seconds is not None:
            raise ConfigError(
                "--iterations and --seconds exclude each other.", hint="Leave one out.")
        refuse_missing_folders(self.json_file, self.plot)
        if self.plot is not None:
            check_picture(self.plot)
        if self.markdown is not None:
            bench_compare.check_page(self.markdown)


def base_config(
    settings: Settings, *, max_size: int, max_gaussians: int, validation: float | None = None
) -> RunConfig:
    """Returns the options that all arms share.

    Args:
        settings: what --set set.
        max_size: longest side of the images in pixels.
        max_gaussians: cap of the count.
        validation: share of the views that is not trained on; None where --set may say so.

    Raises:
        ConfigError: --set reaches a stage that is not run, or what has an option of its own.
    """
    for section in settings.keys() - set(SECTIONS):
        if settings[section]:
            raise ConfigError(
                f"--set {section}.{next(iter(settings[section]))} has no effect here.",
                hint=f"Options of {', '.join(SECTIONS)} can be set.")
    values: dict[str, Any] = dict(settings.get("train", {}))
    own = _OWN if validation is None else _OWN | {"validation"}
    for name in sorted(own & values.keys()):
        raise ConfigError(
            f"--set train.{name} has no effect here.",
            hint="See --help for sizes, steps and seeds; recipes say how to densify.")
    if validation is not None:
        values["validation"] = validation
    return RunConfig(
        **values, iterations=STEPS, max_size=max_size, max_gaussians=max_gaussians,
        early_stop=False)  # every run takes the steps that it is said to take


def shared(base: RunConfig) -> dict[str, Any]:
    """Returns the options that all arms share, without those that each run has of its own."""
    return {name: value for name, value in base.hashed_fields().items()
            if name not in _OWN - {"max_size", "max_gaussians", "sh_degree"}}


SCHEMA, VERSION = "recon-bench-train", 1


@dataclass(frozen=True)
class SeedRun:
    """One run.

    Attributes:
        seed: that it started from.
        points: of its curve, in order.
    """

    seed: int
    points: tuple[Point, ...]

    @property
    def last(self) -> Point:
        """How it ended."""
        return self.points[-1]


@dataclass(frozen=True)
class ArmResult:
    """All runs of one recipe on one scene.

    Attributes:
        arm: the recipe.
        iterations: steps of each run.
        runs: by seed.
    """

    arm: Arm
    iterations: int
    runs: tuple[SeedRun, ...]

    def last(self, figure: Callable[[Point], float]) -> list[float]:
        """Returns a figure of the ends of all runs."""
        return [figure(run.last) for run in self.runs]

    def seconds_to(self, target_db: float, seconds: Callable[[Point], float]) -> list[float | None]:
        """Returns when each run reaches a PSNR; None for one that does not."""
        return [seconds_to(run.points, target_db, seconds) for run in self.runs]


@dataclass(frozen=True)
class SceneResult:
    """All recipes on one scene.

    Attributes:
        views: that were scored.
        width: of the first of them in pixels.
        height: of the first of them in pixels.
        arms: by the name of the recipe.
    """

    views: int
    width: int
    height: int
    arms: Mapping[str, ArmResult]


@dataclass(frozen=True)
class Result:
    """A run of the benchmark.

    Attributes:
        host: where it ran.
        seeds: runs of each recipe.
        base: options that all recipes share.
        targets_db: that were asked for.
        scenes: by name.
    """

    host: Host
    seeds: int
    base: RunConfig
    targets_db: tuple[float, ...]
    scenes: Mapping[str, SceneResult]

    def targets_of(self, scene: SceneResult) -> tuple[float, ...]:
        """Returns the targets of a scene: those asked for, or what all its runs reach."""
        return self.targets_db or (common_target(
            [run.points for one in scene.arms.values() for run in one.runs]),)

    def record(self) -> dict[str, Any]:
        """Returns what the JSON file holds."""
        return {
            "schema": SCHEMA, "version": VERSION, "machine": asdict(self.host),
            "seeds": self.seeds, "base": shared(self.base),
            "scenes": {name: self._scene(scene) for name, scene in self.scenes.items()},
        }

    def _scene(self, scene: SceneResult) -> dict[str, Any]:
        targets = self.targets_of(scene)
        return {
            "views": scene.views, "width": scene.width, "height": scene.height,
            "recipes": {name: {
                **one.arm.record(), "iterations": one.iterations,
                "seconds_to": {f"{db:g}": one.seconds_to(db, lambda p: p.seconds)
                               for db in targets},
                "cpu_seconds_to": {f"{db:g}": one.seconds_to(db, lambda p: p.cpu_seconds)
                                   for db in targets},
                "runs": [asdict(run) for run in one.runs],
            } for name, one in scene.arms.items()},
        }
