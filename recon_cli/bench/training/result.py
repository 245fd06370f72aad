"""What `recon bench train` finds, and how its JSON file names it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from recon_cli.bench.host import Host
from recon_cli.bench.training.arms import Arm
from recon_cli.bench.training.curve import common_target, seconds_to
from recon_cli.bench.training.request import shared
from recon_cli.bench.training.trial import Point
from recon_cli.config import RunConfig

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
