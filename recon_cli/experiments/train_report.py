"""What the curves say, as tables."""

from __future__ import annotations

from collections.abc import Sequence

from recon_cli.evaluation.tables import TitledTable, number
from recon_cli.experiments.host import timing_of
from recon_cli.experiments.train_result import ArmResult, Result, SceneResult


def head(result: Result) -> str:
    """Returns the lines about machine and method that stand above the tables."""
    return (f"{result.host.line}; medians of {result.seeds} seeds, interquartile range in "
            "brackets; scored on validation views, scoring not timed")


def tables(result: Result) -> list[TitledTable]:
    """Returns one table a scene."""
    return [_scene(name, scene, result) for name, scene in result.scenes.items()]


def middle(values: Sequence[float | None], digits: int = 3) -> str:
    """Returns median and interquartile range; "-" where half of the runs have no value."""
    known = [value for value in values if value is not None]
    if 2 * len(known) <= len(values):
        return "-"
    found = timing_of(known)
    shown = f"{number(found.ms, digits)} ({number(found.iqr_ms, 2)})"
    return shown if len(known) == len(values) else f"{shown}, {len(known)} of {len(values)}"


def _scene(name: str, scene: SceneResult, result: Result) -> TitledTable:
    targets = result.targets_of(scene)
    header = ("recipe", *(f"{kind} to {db:g} dB" for db in targets for kind in ("s", "CPU s")),
              "PSNR dB", "SSIM", "Gaussians", "MB", "steps", "s", "CPU s")
    title = (f"{name}: {scene.views} validation views at {scene.width}x{scene.height}, "
             f"at most {result.base.max_gaussians:,} Gaussians")
    return TitledTable(title, header, [_row(one, targets) for one in scene.arms.values()])


def _row(one: ArmResult, targets: Sequence[float]) -> tuple[str, ...]:
    reached = [middle(one.seconds_to(db, seconds)) for db in targets
               for seconds in (lambda p: p.seconds, lambda p: p.cpu_seconds)]
    return (
        one.arm.name, *reached, middle(one.last(lambda p: p.psnr_db), 4),
        middle(one.last(lambda p: p.ssim), 4), middle(one.last(lambda p: p.gaussians)),
        middle(one.last(lambda p: p.bytes / 1e6)), f"{one.iterations:,}",
        middle(one.last(lambda p: p.seconds)), middle(one.last(lambda p: p.cpu_seconds)))
