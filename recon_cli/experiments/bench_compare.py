"""The part of a Markdown page that the benchmark writes; what people wrote around it stays."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from recon_cli.errors import ConfigError, FormatError
from recon_cli.evaluation.tables import TitledTable, number
from recon_cli.experiments.bench_result import FIGURES
from recon_cli.workspace import atomic

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


BEGIN, END = "<!-- recon bench: begin -->", "<!-- recon bench: end -->"


def replaced(page: str, text: str) -> str:
    """Returns the page with `text` between its two marks.

    Raises:
        ValueError: the page lacks a mark, or they are not in order.
    """
    lines = page.splitlines()
    begins = [i for i, line in enumerate(lines) if line.strip() == BEGIN]
    ends = [i for i, line in enumerate(lines) if line.strip() == END]
    if len(begins) != 1 or len(ends) != 1 or ends[0] < begins[0]:
        raise ValueError("the marks are missing, repeated or out of order")
    inner = ["", *text.strip("\n").splitlines(), ""]  # a table ends at a blank line
    kept = [*lines[: begins[0] + 1], *inner, *lines[ends[0] :]]
    return "\n".join(kept) + "\n"


def check_page(path: Path) -> None:
    """Raises FormatError unless `path` is a page with both marks."""
    _written(path, "")


def write_page(path: Path, text: str) -> None:
    """Puts `text` between the marks of the page.

    Raises:
        FormatError: the page cannot be read or has no marks.
    """
    atomic.write_bytes(path, _written(path, text).encode())


def _written(path: Path, text: str) -> str:
    try:
        return replaced(path.read_text(encoding="utf-8"), text)
    except OSError as error:
        raise FormatError(
            f"{path} cannot be read: {error.strerror}.",
            hint=f"Make it, with the lines {BEGIN} and {END}.") from error
    except ValueError as error:
        raise FormatError(
            f"{path} does not hold the lines {BEGIN} and {END}, once each and in this order.",
            hint="Add both lines where the tables should stand.") from error
