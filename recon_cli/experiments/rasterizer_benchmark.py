"""`recon bench`: speed of the rasterizers and their error, as tables."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from recon_cli import machine
from recon_cli.errors import ConfigError, FormatError, InputError
from recon_cli.evaluation.scores import Table, number, percent
from recon_cli.experiments.bench_measure import (
    FIGURES,
    SCHEMA,
    VERSION,
    BackendResult,
    BenchedScene,
    BenchPlan,
    BenchResult,
    Speed,
    measure,
)
from recon_cli.experiments.bench_scene import QUICK, SIZES, Accuracy
from recon_cli.experiments.instruments import examine
from recon_cli.experiments.outputs import Result
from recon_cli.progress import Progress
from recon_cli.render import registry
from recon_cli.workspace import atomic

_ROUNDS, _QUICK_ROUNDS = 7, 2
_REFERENCE = "torch"  # the other backends are compared with it

logger = logging.getLogger("recon")


@dataclass(frozen=True)
class BenchRequest:
    """The options of `recon bench`; a ReconError where size or outputs cannot be used."""

    scene: str = "room"  # or "small"
    gaussians: int | None = None  # instead of the scene's own number
    size: str | None = None  # "WxH" in pixels, instead of the scene's own
    sh_degree: int = 3
    backends: tuple[str, ...] = ()  # empty for all that run on the device
    device: str = "auto"
    threads: int | None = None  # None for all cores
    rounds: int | None = None  # behind each median; None for the usual number
    quick: bool = False  # a tiny scene and few rounds
    out: Path | None = None  # the file of all figures
    compare: Path | None = None  # the figures of an earlier run

    def __post_init__(self) -> None:
        if self.size is not None:
            parse_size(self.size)
        if self.out is not None and not self.out.absolute().parent.is_dir():
            raise InputError(f"The folder of {self.out} does not exist.",
                             hint=f"mkdir -p {self.out.parent}")

    def plan(self) -> BenchPlan:
        """Returns the measurements to make; BackendError if a backend is not available."""
        if self.backends:
            resolved = [registry.resolve(name, self.device) for name in self.backends]
            backends, device = tuple(dict.fromkeys(name for name, _ in resolved)), resolved[0][1]
        else:
            _, device = registry.resolve("torch", self.device)
            backends = tuple(
                status.name for status in registry.available_backends()
                if device in status.devices and not status.missing)
        size = QUICK if self.quick else SIZES[self.scene]
        if self.gaussians is not None:
            size = replace(size, gaussians=self.gaussians)
        if self.size is not None:
            width, height = parse_size(self.size)
            size = replace(size, width=width, height=height)
        rounds = self.rounds or (_QUICK_ROUNDS if self.quick else _ROUNDS)
        return BenchPlan(size, self.sh_degree, backends, device,
                         self.threads or machine.usable_threads(), rounds)

    def earlier_record(self, plan: BenchPlan) -> Mapping[str, Any] | None:
        """Returns the record to compare with, if any; ReconError if it does not compare."""
        if self.compare is None:
            return None
        old = read_record(self.compare)
        settings = {**asdict(plan.size), "sh_degree": plan.sh_degree}
        check_comparable(old, self.scene, settings, plan.threads)
        return old


def parse_size(size: str) -> tuple[int, int]:
    """Returns width and height of "640x360"; ConfigError for another form, or a side of 0."""
    match = re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", size)
    if not match:
        raise ConfigError(
            f"--size is {size!r}, but it must be WIDTHxHEIGHT in pixels.",
            hint="Try --size 640x360.")
    return int(match[1]), int(match[2])


def run(request: BenchRequest, progress: Progress) -> Result:
    """Measures, writes the files, and returns the result."""
    plan = request.plan()
    old = request.earlier_record(plan)
    host = examine(plan.threads, plan.device)
    benched = BenchResult(host, plan.rounds, {request.scene: measure(plan, progress)})
    result = Result(benched.record(), head(benched), tables(benched))
    if request.out is not None:
        atomic.write_json(request.out, result.record)
    if old is None:
        return result
    if difference := machine_difference(old, result.record):
        logger.warning("the other file is of another machine: %s", difference)
    return replace(result, tables=[*result.tables, comparison_table(old, result.record)])


def tables(result: BenchResult) -> list[Table]:
    """Returns all tables of a result, in the order in which they are read."""
    return [table for name, scene in result.scenes.items() for table in _scene_tables(
        f"{name}: {scene.gaussians:,} Gaussians, {scene.width}x{scene.height}, "
        f"SH degree {scene.sh_degree}", scene)]


def _scene_tables(where: str, scene: BenchedScene) -> tuple[Table, ...]:
    errors = Table(
        ("backend", "ms", *_ERRORS),
        [(name, number(backend.speed.both_ms), *_accuracy_cells(backend.accuracy))
         for name, backend in scene.backends.items()], f"Error against float64 ({where})")
    return _figures(where, scene), _stages(where, scene), errors


def head(result: BenchResult) -> str:
    """Returns the line about machine and method above the tables."""
    return (f"{result.host.line}; medians of {result.rounds} alternated rounds, "
            "interquartile range in brackets")


def _ratio(old: float | None, new: float | None) -> str:
    return "-" if (value := ratio(old, new)) is None else f"{value:.2f}x"


def _figures(where: str, scene: BenchedScene) -> Table:
    """Returns the main figures, one row each, a column a backend."""
    backends = list(scene.backends.values())
    rows = [(name, *map(cell, backends)) for name, cell in _figure_rows(scene)]
    return Table(("what", *scene.backends), rows, f"Figures ({where})")


def _figure_rows(scene: BenchedScene) -> list[tuple[str, Callable[[BackendResult], str]]]:
    """Returns the names of the rows of `_figures`, and how a backend's cell is made."""
    reference = scene.backends.get(_REFERENCE)
    threads = next(iter(scene.backends.values())).speed.threads

    def speedup(speed: Callable[[BackendResult], Speed]) -> Callable[[BackendResult], str]:
        return lambda backend: _ratio(
            speed(reference).both_ms, speed(backend).both_ms) if reference else "-"

    several: list[tuple[str, Callable[[BackendResult], str]]] = [
        ("the same with 1 thread", speedup(_core)),
        (f"1 thread : {threads} threads, whole step", lambda backend: _ratio(
            _core(backend).times["step"].ms, backend.speed.times["step"].ms))]
    return [
        ("forward + backward, ms", lambda backend: number(backend.speed.both_ms)),
        ("whole step, ms", lambda backend: backend.speed.times["step"].text()),
        (f"{_REFERENCE} : this, forward + backward", speedup(lambda backend: backend.speed)),
        *(several if _has_several(scene) else []),
        ("memory added, MB", lambda backend: f"{backend.memory_bytes / 1e6:.0f}")]


def _core(backend: BackendResult) -> Speed:
    """Returns the speed of one thread, on a GPU that of the GPU."""
    return backend.one_thread or backend.speed


def _has_several(scene: BenchedScene) -> bool:
    """Returns whether one thread and all threads are different measurements."""
    return all(backend.one_thread and backend.speed.threads > 1
               for backend in scene.backends.values())


def _stages(where: str, scene: BenchedScene) -> Table:
    """Returns every stage of every backend, with one thread and with all."""
    several = _has_several(scene)
    rows: list[tuple[str, ...]] = []
    for name, backend in scene.backends.items():
        core, speed = _core(backend), backend.speed
        rows += [(f"{name} {part}", *([core.times[part].text()] if several else []),
                  speed.times[part].text()) for part in speed.times]
    threads = next(iter(scene.backends.values())).speed.threads
    columns = ("ms, 1 thread", f"ms, {threads} threads") if several else ("ms",)
    return Table(("stage", *columns), rows, f"Stages ({where})")


_ERRORS = ("image max", "image RMS", "pixels > 1e-5", "gradient rel.", "worst", "gradient 1 - cos")


def _accuracy_cells(accuracy: Accuracy) -> tuple[str, ...]:
    """Returns the cells under `_ERRORS`."""
    return (number(accuracy.image_error_max), number(accuracy.image_error_rms),
            percent(accuracy.flipped_pixels), number(accuracy.gradient_relative_error),
            accuracy.gradient_worst, number(1 - accuracy.gradient_cosine, 2))


def read_record(path: Path) -> Mapping[str, Any]:
    """Returns the JSON file of an earlier run; FormatError for a damaged one or another schema."""
    record = atomic.read_json(path)
    kind = (record.get("schema"), record.get("version")) if isinstance(record, dict) else None
    if kind != (SCHEMA, VERSION):
        schema = "none" if kind is None or kind[0] is None else f"{kind[0]} {kind[1]}"
        raise FormatError(
            f"{path} has the schema {schema}, but {SCHEMA} {VERSION} was needed.",
            hint="Write a new one with `recon bench --json FILE`.")
    assert isinstance(record, dict)
    return record


def check_comparable(
    old: Mapping[str, Any], scene: str, settings: Mapping[str, int], threads: int
) -> None:
    """Raises ConfigError unless an earlier run has this scene, these settings and threads."""
    scenes = old["scenes"]
    if scene not in scenes:
        raise ConfigError(
            f"The other file holds no scene {scene}, only {', '.join(scenes)}.",
            hint=f"Add --scene {next(iter(scenes), 'room')}.")
    was = {name: scenes[scene][name] for name in settings}
    was_threads = old["machine"]["threads"]
    if was != dict(settings) or was_threads != threads:
        raise ConfigError(
            f"The other file was measured with {_settings_text(was, was_threads)}, this run would "
            f"be with {_settings_text(settings, threads)}.",
            hint=f"Add --gaussians {was['gaussians']} --size {was['width']}x{was['height']} "
                 f"--sh-degree {was['sh_degree']} --threads {was_threads}.")


def _settings_text(settings: Mapping[str, int], threads: int) -> str:
    return (f"{settings['gaussians']} Gaussians at {settings['width']}x{settings['height']}, "
            f"SH degree {settings['sh_degree']}, {threads} threads")


def comparison_table(old: Mapping[str, Any], new: Mapping[str, Any]) -> Table:
    """Returns old, new and old / new for each scene, backend and figure that both records have."""
    rows = []
    for scene, record in new["scenes"].items():
        before = old["scenes"].get(scene, {"backends": {}})["backends"]
        for backend, figures in record["backends"].items():
            for figure in FIGURES if backend in before else ():
                was, now = before[backend][figure], figures[figure]
                rows.append((
                    f"{scene} {backend} {figure}", number(was), number(now),
                    number(ratio(was, now))))
    return Table(("figure", "old", "new", "old / new"), rows, "Old against new")


def ratio(old: float | None, new: float | None) -> float | None:
    """Returns old / new; None where one of them is not known or new is zero."""
    return None if old is None or not new else old / new


def machine_difference(old: Mapping[str, Any], new: Mapping[str, Any]) -> str:
    """Returns the differences between the machines of two records; empty if there are none."""
    was, now = old["machine"], new["machine"]
    return "; ".join(f"{key} {was[key]} there, {now[key]} here"
                     for key in ("cpu", "cores", "lanes", "device") if was[key] != now[key])
