"""`recon bench`: speed of the rasterizers and their error, as tables."""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass, replace
from pathlib import Path

from recon_cli import machine
from recon_cli.errors import ConfigError, InputError
from recon_cli.evaluation.scores import Table, number, percent
from recon_cli.experiments.bench_measure import (
    BackendResult,
    BenchPlan,
    BenchResult,
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


def parse_size(size: str) -> tuple[int, int]:
    """Returns width and height of "640x360"; ConfigError for another form, or a side of 0."""
    match = re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", size)
    if not match:
        raise ConfigError(
            f"--size is {size!r}, but it must be WIDTHxHEIGHT in pixels.",
            hint="Try --size 640x360.")
    return int(match[1]), int(match[2])


def run(request: BenchRequest, progress: Progress) -> Result:
    """Measures, writes the file, and returns the result."""
    plan = request.plan()
    host = examine(plan.threads, plan.device)
    benched = BenchResult(host, plan.rounds, {request.scene: measure(plan, progress)})
    result = Result(benched.record(), head(benched), tables(benched))
    if request.out is not None:
        atomic.write_json(request.out, result.record)
    return result


def tables(result: BenchResult) -> list[Table]:
    """Returns a table for each scene: a row a backend, speed before error."""
    return [Table(
        ("backend", *_SPEEDS, *_ERRORS),
        [(name, *_speed_cells(backend, scene.backends.get(_REFERENCE)),
          *_accuracy_cells(backend.accuracy)) for name, backend in scene.backends.items()],
        f"{name}: {scene.gaussians:,} Gaussians, {scene.width}x{scene.height}, "
        f"SH degree {scene.sh_degree}") for name, scene in result.scenes.items()]


def head(result: BenchResult) -> str:
    """Returns the line about machine and method above the tables."""
    return (f"{result.host.line}; medians of {result.rounds} alternated rounds, "
            "interquartile range in brackets")


_SPEEDS = ("forward + backward, ms", f"{_REFERENCE} : this", "step, ms", "step, 1 thread", "MB")


def _speed_cells(backend: BackendResult, reference: BackendResult | None) -> tuple[str, ...]:
    """Returns the cells under `_SPEEDS`; a GPU has no figure of one thread."""
    both = backend.speed.both_ms
    return (number(both), f"{reference.speed.both_ms / both:.2f}x" if reference else "-",
            backend.speed.times["step"].text(),
            "-" if backend.one_thread is None else backend.one_thread.times["step"].text(),
            f"{backend.memory_bytes / 1e6:.0f}")


_ERRORS = ("image max", "image RMS", "pixels > 1e-5", "gradient rel.", "worst", "gradient 1 - cos")


def _accuracy_cells(accuracy: Accuracy) -> tuple[str, ...]:
    """Returns the cells under `_ERRORS`."""
    return (number(accuracy.image_error_max), number(accuracy.image_error_rms),
            percent(accuracy.flipped_pixels), number(accuracy.gradient_relative_error),
            accuracy.gradient_worst, number(1 - accuracy.gradient_cosine, 2))
