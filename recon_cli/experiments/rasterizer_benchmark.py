"""`recon bench`: speed of the rasterizers against their error, as tables and as a picture."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from recon_cli import machine
from recon_cli.errors import ConfigError, FormatError
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
from recon_cli.experiments.outputs import OutputFiles, Result, drawing
from recon_cli.progress import Progress
from recon_cli.render import registry
from recon_cli.workspace import atomic

_ROUNDS, _QUICK_ROUNDS = 7, 2
_REFERENCE = "torch"  # the other backends are compared with it
_FLOOR = 1e-9  # for an error of zero on a logarithmic axis

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
    outputs: OutputFiles = field(default_factory=OutputFiles)
    compare: Path | None = None  # the figures of an earlier run

    def __post_init__(self) -> None:
        if self.size is not None:
            parse_size(self.size)
        self.outputs.check()

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
    benched = BenchResult(host, plan.rounds, {request.scene: measure(plan, host, progress)})
    result = Result(benched.record(), head(benched), tables(benched),
                    draw=lambda path: draw(benched, path))
    request.outputs.write(result)
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
    return (_figures(where, scene), _stages(where, scene), errors,
            _variants(where, scene))


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

    def pairs(i: int) -> Callable[[BackendResult], str]:
        return lambda backend: number(backend.pairs[i] / 1e6 if backend.pairs else None)

    several: list[tuple[str, Callable[[BackendResult], str]]] = [
        ("the same with 1 thread", speedup(_core)),
        (f"1 thread : {threads} threads, whole step", lambda backend: _ratio(
            _core(backend).times["step"].ms, backend.speed.times["step"].ms))]
    return [
        ("forward + backward, ms", lambda backend: number(backend.speed.both_ms)),
        ("whole step, ms", lambda backend: backend.speed.times["step"].text()),
        (f"{_REFERENCE} : this, forward + backward", speedup(lambda backend: backend.speed)),
        *(several if _has_several(scene) else []),
        ("Gpairs/s a core, forward", lambda backend: number(_core(backend).gpairs_per_s_forward)),
        ("Gpairs/s a core, backward", lambda backend: number(_core(backend).gpairs_per_s_backward)),
        ("of the core's peak, forward",
         lambda backend: percent(_core(backend).peak_fraction_forward)),
        ("of the core's peak, backward",
         lambda backend: percent(_core(backend).peak_fraction_backward)),
        ("evaluated Mpairs, forward", pairs(0)),
        ("evaluated Mpairs, backward", pairs(1)),
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
        rates = {"forward: composite": (core.gpairs_per_s_forward, core.peak_fraction_forward),
                 "backward: decompose": (core.gpairs_per_s_backward, core.peak_fraction_backward)}
        for part in speed.times:
            gpairs_per_s, fraction = rates.get(part, (None, None))
            rows.append((
                f"{name} {part}", *([core.times[part].text()] if several else []),
                speed.times[part].text(),
                *((number(gpairs_per_s), percent(fraction)) if part in rates else ("", ""))))
    threads = next(iter(scene.backends.values())).speed.threads
    columns = ("ms, 1 thread", f"ms, {threads} threads") if several else ("ms",)
    return Table(("stage", *columns, "Gpairs/s a core", "of peak"), rows, f"Stages ({where})")


_ERRORS = ("image max", "image RMS", "pixels > 1e-5", "gradient rel.", "worst", "gradient 1 - cos")


def _accuracy_cells(accuracy: Accuracy) -> tuple[str, ...]:
    """Returns the cells under `_ERRORS`."""
    return (number(accuracy.image_error_max), number(accuracy.image_error_rms),
            percent(accuracy.flipped_pixels), number(accuracy.gradient_relative_error),
            accuracy.gradient_worst, number(1 - accuracy.gradient_cosine, 2))


def _variants(where: str, scene: BenchedScene) -> Table:
    """Returns every approximation against the oracle, and the time it saves."""
    contract = scene.variants[0].time
    rows = [(variant.name, variant.time.text(), number(contract.ms - variant.time.ms, 2),
             *_accuracy_cells(variant.accuracy)) for variant in scene.variants]
    return Table(("what", "ms", "ms saved", *_ERRORS), rows,
                 f"Approximations on {scene.variants_of} ({where})")


@dataclass(frozen=True)
class SpeedErrorPoint:
    """One point of the picture."""

    name: str  # its label
    ms: float  # forward and backward
    image_error: float  # root mean square
    gradient_error: float  # relative


def list_points(scene: BenchedScene) -> list[SpeedErrorPoint]:
    """Returns every backend, then every approximation that has a time."""
    contract, *others = scene.variants
    times = {name: backend.speed.both_ms for name, backend in scene.backends.items()}
    times[scene.variants_of] = contract.time.ms  # taken in turn with the approximations
    timed = [*((name, times[name], backend.accuracy) for name, backend in scene.backends.items()),
             *((other.name, other.time.ms, other.accuracy) for other in others)]
    return [SpeedErrorPoint(name, ms, accuracy.image_error_rms, accuracy.gradient_relative_error)
            for name, ms, accuracy in timed]


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Returns the points (ms, error) that no other beats in both, by increasing milliseconds."""
    best, front = float("inf"), []
    for i in sorted(range(len(points)), key=lambda i: points[i]):
        if points[i][1] < best:
            best = points[i][1]
            front.append(i)
    return front


def draw(result: BenchResult, path: Path) -> None:
    """Draws speed against error of the first scene into a .png or .svg."""
    name, scene = next(iter(result.scenes.items()))
    points = list_points(scene)
    with drawing(path, 15, 6, dpi=130) as figure:
        left, right, names = figure.subplots(1, 3, width_ratios=(5, 5, 2))
        figure.suptitle(
            f"{name}: {scene.gaussians:,} Gaussians, {scene.width}x{scene.height}, "
            f"{result.host.cpu}, threads: {result.host.threads}", fontsize=10)
        count = len(scene.backends)
        _scatter(left, [(point.ms, point.image_error) for point in points], count)
        _scatter(right, [(point.ms, point.gradient_error) for point in points], count)
        left.set_ylabel("image error against float64, RMS")
        right.set_ylabel("gradient error against float64, relative")
        lines = [f"{i}  {point.name}" for i, point in enumerate(points, start=1)]
        names.text(0, 1, "\n".join(lines), va="top", fontsize=9, linespacing=1.6)
        names.axis("off")


def _scatter(axes: Any, places: Sequence[tuple[float, float]], backends: int) -> None:
    """Draws numbered points, backends first, and their Pareto front."""
    from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

    places = [(ms, max(error, _FLOOR)) for ms, error in places]
    axes.plot(*zip(*(places[i] for i in pareto_front(places)), strict=True), color="0.7", zorder=1)
    axes.scatter(*zip(*places, strict=True), zorder=2, s=16,
                 c=["C1" if i < backends else "C0" for i in range(len(places))])
    for index, place in enumerate(places, start=1):
        axes.annotate(str(index), place, xytext=(4, 3), textcoords="offset points", fontsize=8)
    axes.set(xscale="log", yscale="log", xlabel="forward + backward, ms")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 3, 5)))
    axes.xaxis.set_major_formatter(FormatStrFormatter("%g"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(color="0.92")


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
