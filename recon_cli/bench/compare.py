"""A run beside an earlier one: the ratio of every figure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from recon_cli.bench.result import FIGURES
from recon_cli.bench.tables import TitledTable, number
from recon_cli.errors import ConfigError

_SETTINGS = ("gaussians", "width", "height", "sh_degree")


def check_comparable(
    old: Mapping[str, Any], scene: str, settings: Mapping[str, int], threads: int
) -> None:
    """Raises ConfigError unless the earlier run timed the same scene with as many threads."""
    scenes = old["scenes"]
    if scene not in scenes:
        raise ConfigError(
            f"The other file holds no scene {scene}, only {', '.join(scenes)}.",
            hint=f"Add --scene {next(iter(scenes), 'room')}.")
    was = {name: scenes[scene][name] for name in _SETTINGS}
    was_threads = old["machine"]["threads"]
    if was != dict(settings) or was_threads != threads:
        raise ConfigError(
            f"The other file was measured with {_told(was, was_threads)}, this run would be with "
            f"{_told(settings, threads)}.",
            hint=f"Add --gaussians {was['gaussians']} --size {was['width']}x{was['height']} "
                 f"--sh-degree {was['sh_degree']} --threads {was_threads}.")


def _told(settings: Mapping[str, int], threads: int) -> str:
    return (f"{settings['gaussians']} Gaussians at {settings['width']}x{settings['height']}, "
            f"SH degree {settings['sh_degree']}, {threads} threads")


def compared(old: Mapping[str, Any], new: Mapping[str, Any]) -> TitledTable:
    """Returns the table of old, new and old/new for each scene, backend and figure of both.

    Args:
        old: the record of the earlier run.
        new: the record of this one.
    """
    rows = []
    for scene, found in new["scenes"].items():
        before = old["scenes"].get(scene, {"backends": {}})["backends"]
        for backend, figures in found["backends"].items():
            for figure in FIGURES if backend in before else ():
                was, now = before[backend][figure], figures[figure]
                rows.append((
                    f"{scene} {backend} {figure}", number(was), number(now),
                    number(ratio(was, now))))
    return TitledTable("Old against new", ("figure", "old", "new", "old / new"), rows)


def ratio(old: float | None, new: float | None) -> float | None:
    """Returns old / new; None where one of them is not known or new is zero."""
    return None if old is None or not new else old / new


def other_machine(old: Mapping[str, Any], new: Mapping[str, Any]) -> str:
    """Returns what differs between the machines of two records; empty where nothing does."""
    was, now = old["machine"], new["machine"]
    parts = [f"{key} {was[key]} there, {now[key]} here"
             for key in ("cpu", "cores", "lanes", "device") if was[key] != now[key]]
    return "; ".join(parts)
