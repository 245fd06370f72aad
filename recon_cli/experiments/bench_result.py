"""What a run of the rasterizer benchmark measured, its JSON file, and comparing two of them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from recon_cli.errors import ConfigError, FormatError
from recon_cli.evaluation.tables import Table, number
from recon_cli.experiments.accuracy import Accuracy
from recon_cli.experiments.instruments import Host, Timing
from recon_cli.workspace import atomic

SCHEMA = "recon-bench"
VERSION = 1  # goes up when a key changes its name or meaning

# What each backend has under its own name in every scene; --compare prints a ratio for each.
FIGURES = (
    "forward_ms", "backward_ms", "step_ms", "gpairs_per_s_forward", "gpairs_per_s_backward",
    "peak_fraction_forward", "peak_fraction_backward", "image_error_max",
    "gradient_relative_error")


@dataclass(frozen=True)
class Speed:
    """How fast a backend is with some number of threads."""

    threads: int
    forward: Timing  # a whole forward pass
    backward: Timing
    step: Timing  # forward, loss, backward, Adam
    # evaluated pairs of Gaussian and pixel over the time of compositing; None where not counted
    gpairs_per_s_forward: float | None
    gpairs_per_s_backward: float | None
    # arithmetic of those pairs over what the threads could do; None where no peak was measured
    peak_fraction_forward: float | None
    peak_fraction_backward: float | None
    stages: dict[str, Timing]  # parts of the passes and of the step, in order, as "pass: part"

    def record(self) -> dict[str, Any]:
        """Returns the figures by the names of the JSON file."""
        passes = {"forward": self.forward, "backward": self.backward, "step": self.step}
        return {
            "threads": self.threads,
            **{f"{name}_ms": timing.ms for name, timing in passes.items()},
            **{f"{name}_iqr_ms": timing.iqr_ms for name, timing in passes.items()},
            **{name: getattr(self, name) for name in FIGURES[3:7]},
            "stages": {name: asdict(timing) for name, timing in self.stages.items()},
        }


def _finite(accuracy: Accuracy) -> dict[str, Any]:
    """Returns an accuracy for JSON, which knows no infinity: null stands for it."""
    return {name: None if value == math.inf else value
            for name, value in asdict(accuracy).items()}


@dataclass(frozen=True)
class BackendResult:
    """One backend in one scene."""

    speed: Speed  # with all the threads that were asked for
    one_thread: Speed | None  # None on a GPU
    accuracy: Accuracy  # against the oracle
    pairs: tuple[int, int] | None  # evaluated forward and backward; None where not counted
    memory_bytes: int  # most that a first forward and backward pass added, gradients included

    def record(self) -> dict[str, Any]:
        """Returns the figures by the names of the JSON file."""
        return {
            **self.speed.record(), **_finite(self.accuracy), "pairs": self.pairs,
            "memory_bytes": self.memory_bytes,
            "one_thread": self.one_thread.record() if self.one_thread else None,
        }


@dataclass(frozen=True)
class VariantResult:
    """One approximation on one backend."""

    name: str
    time: Timing | None  # forward and backward; None where a difference would mean nothing
    accuracy: Accuracy  # against the oracle, which follows the contract


@dataclass(frozen=True)
class BenchedScene:
    """Everything about one scene."""

    gaussians: int
    width: int  # of the image in pixels
    height: int
    sh_degree: int
    backends: dict[str, BackendResult]  # by name, the fastest kind first
    losses: dict[str, Timing]  # forward and backward of each photometric loss
    variants_of: str  # the backend that the approximations were drawn by
    variants: list[VariantResult]  # the contract first, then the approximations

    def record(self) -> dict[str, Any]:
        """Returns the figures by the names of the JSON file."""
        return {
            "gaussians": self.gaussians, "width": self.width, "height": self.height,
            "sh_degree": self.sh_degree,
            "backends": {name: backend.record() for name, backend in self.backends.items()},
            "losses": {name: asdict(timing) for name, timing in self.losses.items()},
            "variants_of": self.variants_of,
            "variants": [
                {"name": variant.name, "time": asdict(variant.time) if variant.time else None,
                 **_finite(variant.accuracy)} for variant in self.variants],
        }


@dataclass(frozen=True)
class BenchResult:
    """A run of the benchmark."""

    host: Host
    rounds: int  # behind each median
    scenes: dict[str, BenchedScene]
    warm_start: Timing | None = None  # of the numba backend in a fresh process; None if left out

    def record(self) -> dict[str, Any]:
        """Returns what the JSON file holds."""
        return {
            "schema": SCHEMA, "version": VERSION, "machine": asdict(self.host),
            "rounds": self.rounds,
            "warm_start": asdict(self.warm_start) if self.warm_start else None,
            "scenes": {name: scene.record() for name, scene in self.scenes.items()},
        }


def read_record(path: Path) -> Mapping[str, Any]:
    """Returns what a JSON file of an earlier run holds.

    Raises:
        FormatError: it cannot be read, or is of another schema.
    """
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
    """Raises ConfigError unless the earlier run timed the same scene with as many threads.

    Args:
        old: the record of the earlier run.
        scene: its name.
        settings: gaussians, width, height and sh_degree of this run.
        threads: of this run.
    """
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
    """Returns what differs between the machines of two records; empty where nothing does."""
    was, now = old["machine"], new["machine"]
    return "; ".join(f"{key} {was[key]} there, {now[key]} here"
                     for key in ("cpu", "cores", "lanes", "device") if was[key] != now[key])
