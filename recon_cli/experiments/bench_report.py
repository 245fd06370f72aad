"""What a result says, table by table."""

from __future__ import annotations

from collections.abc import Callable

from recon_cli.evaluation.tables import TitledTable, number, percent
from recon_cli.experiments.accuracy import Accuracy
from recon_cli.experiments.bench_result import BackendResult, Result, SceneResult, Speed
from recon_cli.experiments.host import Timing

_REFERENCE = "torch"  # what the other backends and losses are compared with
_RATED = {"forward: composite": "forward", "backward: decompose": "backward"}


def tables(result: Result) -> list[TitledTable]:
    """Returns all tables of a result, in the order in which they are read."""
    found = []
    for name, scene in result.scenes.items():
        where = (f"{name}: {scene.gaussians:,} Gaussians, {scene.width}x{scene.height}, "
                 f"SH degree {scene.sh_degree}")
        found += [
            _figures(where, scene, result.warm_start), _stages(where, scene), _errors(where, scene),
            _variants(where, scene)]
    return found


def head(result: Result) -> str:
    """Returns the line about machine and method that stands above the tables."""
    return (f"{result.host.line}; medians of {result.rounds} alternated rounds, "
            "interquartile range in brackets")


def timed(timing: Timing | None) -> str:
    """Returns median and spread in milliseconds."""
    return "-" if timing is None else f"{number(timing.ms)} ({number(timing.iqr_ms, 2)})"


def _ratio(old: float | None, new: float | None) -> str:
    return "-" if old is None or not new else f"{old / new:.2f}x"


def _both(speed: Speed) -> float:
    return speed.forward.ms + speed.backward.ms


def _figures(where: str, scene: SceneResult, warm_start: Timing | None) -> TitledTable:
    """The figures that are quoted, one row each, a column a backend."""
    backends = scene.backends
    rows = [(what, *(figure(one) for one in backends.values()))
            for what, figure in _quoted(scene)]
    width = len(backends) - 1
    if warm_start is not None:
        rows.append(("kernels ready in a fresh process, ms", timed(warm_start), *[""] * width))
    fused = scene.losses.get("fused")
    for name, timing in scene.losses.items():
        rows.append((f"loss {name}, ms", timed(timing), *[""] * width))
        if fused and timing is not fused:
            rows.append((f"loss {name} : fused", _ratio(timing.ms, fused.ms), *[""] * width))
    return TitledTable(f"Figures ({where})", ("what", *backends), rows)


def _quoted(scene: SceneResult) -> list[tuple[str, Callable[[BackendResult], str]]]:
    """Returns what the rows of `_figures` say, and how a backend's cell is made."""
    reference = scene.backends.get(_REFERENCE)
    threads = next(iter(scene.backends.values())).speed.threads

    def against(one: BackendResult) -> str:
        return _ratio(_both(reference.speed), _both(one.speed)) if reference else "-"

    def alone(one: BackendResult) -> str:
        return _ratio(_both(_core(reference)), _both(_core(one))) if reference else "-"

    several: list[tuple[str, Callable[[BackendResult], str]]] = [
        ("the same with 1 thread", alone),
        (f"1 thread : {threads} threads, whole step",
         lambda one: _ratio(_core(one).step.ms, one.speed.step.ms)),
    ]
    return [
        ("forward + backward, ms", lambda one: number(_both(one.speed))),
        ("whole step, ms", lambda one: timed(one.speed.step)),
        (f"{_REFERENCE} : this, forward + backward", against),
        *(several if threads > 1 and _has_core(scene) else []),
        ("Gpairs/s a core, forward", lambda one: number(_core(one).gpairs_per_s_forward)),
        ("Gpairs/s a core, backward", lambda one: number(_core(one).gpairs_per_s_backward)),
        ("of the core's peak, forward", lambda one: percent(_core(one).peak_fraction_forward)),
        ("of the core's peak, backward", lambda one: percent(_core(one).peak_fraction_backward)),
        ("evaluated Mpairs, forward", lambda one: _millions(one.pairs, 0)),
        ("evaluated Mpairs, backward", lambda one: _millions(one.pairs, 1)),
        ("memory added, MB", lambda one: f"{one.memory_bytes / 1e6:.0f}"),
    ]


def _core(one: BackendResult) -> Speed:
    """Returns the speed of one thread, on a GPU that of the GPU."""
    return one.one_thread or one.speed


def _has_core(scene: SceneResult) -> bool:
    return all(one.one_thread for one in scene.backends.values())


def _millions(pairs: tuple[int, int] | None, which: int) -> str:
    return number(pairs[which] / 1e6 if pairs else None)


def _stages(where: str, scene: SceneResult) -> TitledTable:
    """Every stage of every backend, with one thread and with all."""
    threads = next(iter(scene.backends.values())).speed.threads
    several = threads > 1 and _has_core(scene)  # otherwise both columns would say the same
    rows: list[tuple[str, ...]] = []
    for name, one in scene.backends.items():
        speeds = (_core(one), one.speed) if several else (one.speed,)
        for label in ("forward", "backward", "step"):
            parts = [part for part in one.speed.stages if part.startswith(f"{label}: ")]
            rows += [
                (f"{name} {part}", *(timed(_time(speed, part)) for speed in speeds),
                 *_rates(_core(one), part)) for part in (label, *parts)]
    columns = ("ms, 1 thread", f"ms, {threads} threads") if several else ("ms",)
    return TitledTable(
        f"Stages ({where})", ("stage", *columns, "Gpairs/s a core", "of peak"), rows)


def _time(speed: Speed, part: str) -> Timing | None:
    whole = {"forward": speed.forward, "backward": speed.backward, "step": speed.step}
    return whole.get(part) or speed.stages.get(part)


def _rates(speed: Speed, part: str) -> tuple[str, str]:
    if part not in _RATED:
        return "", ""
    if _RATED[part] == "forward":
        return number(speed.gpairs_per_s_forward), percent(speed.peak_fraction_forward)
    return number(speed.gpairs_per_s_backward), percent(speed.peak_fraction_backward)


_ERRORS = ("image max", "image RMS", "pixels > 1e-5", "gradient rel.", "worst", "gradient 1 - cos")


def _errors(where: str, scene: SceneResult) -> TitledTable:
    """Every backend against the oracle."""
    rows = [(name, number(_both(one.speed)), *_accuracy_cells(one.accuracy))
            for name, one in scene.backends.items()]
    return TitledTable(f"Error against float64 ({where})", ("backend", "ms", *_ERRORS), rows)


def _accuracy_cells(found: Accuracy) -> tuple[str, ...]:
    """Returns the cells under `_ERRORS`."""
    return (number(found.image_error_max), number(found.image_error_rms),
            percent(found.flipped_pixels), number(found.gradient_relative_error),
            found.gradient_worst, number(1 - found.gradient_cosine, 2))


def _variants(where: str, scene: SceneResult) -> TitledTable:
    """Every approximation against the oracle, and what it saves."""
    contract = scene.variants[0].time
    rows = []
    for one in scene.variants:
        saved = None if one.time is None or contract is None else contract.ms - one.time.ms
        rows.append((one.name, timed(one.time), number(saved, 2), *_accuracy_cells(one.accuracy)))
    return TitledTable(
        f"Approximations on {scene.variants_of} ({where})",
        ("what", "ms", "ms saved", *_ERRORS), rows)
