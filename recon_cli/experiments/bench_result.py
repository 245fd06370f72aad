"""What a run of the benchmark found, and the JSON file that holds it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from recon_cli.errors import FormatError
from recon_cli.experiments.accuracy import Accuracy
from recon_cli.experiments.host import Host, Timing
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
    """How fast a backend is with some number of threads.

    Attributes:
        threads: CPU threads.
        forward: a whole forward pass.
        backward: a whole backward pass.
        step: forward, loss, backward, Adam.
        gpairs_per_s_forward: evaluated pairs of Gaussian and pixel over the time of compositing;
            None where the backend does not count them.
        gpairs_per_s_backward: the same of the backward pass.
        peak_fraction_forward: arithmetic of those pairs against what the threads could do; None
            where no peak was measured.
        peak_fraction_backward: the same of the backward pass.
        stages: parts of the passes and of the step, in order, as "pass: part".
    """

    threads: int
    forward: Timing
    backward: Timing
    step: Timing
    gpairs_per_s_forward: float | None
    gpairs_per_s_backward: float | None
    peak_fraction_forward: float | None
    peak_fraction_backward: float | None
    stages: dict[str, Timing]

    def record(self) -> dict[str, Any]:
        """Returns the figures by the names of the JSON file."""
        passes = {"forward": self.forward, "backward": self.backward, "step": self.step}
        return {
            "threads": self.threads,
            **{f"{name}_ms": timing.ms for name, timing in passes.items()},
            **{f"{name}_iqr_ms": timing.iqr_ms for name, timing in passes.items()},
            "gpairs_per_s_forward": self.gpairs_per_s_forward,
            "gpairs_per_s_backward": self.gpairs_per_s_backward,
            "peak_fraction_forward": self.peak_fraction_forward,
            "peak_fraction_backward": self.peak_fraction_backward,
            "stages": {name: asdict(timing) for name, timing in self.stages.items()},
        }


def _written(accuracy: Accuracy) -> dict[str, Any]:
    """Returns an accuracy for JSON, which knows no infinity: null stands for it."""
    return {name: None if value == math.inf else value
            for name, value in asdict(accuracy).items()}


@dataclass(frozen=True)
class BackendResult:
    """Everything about one backend in one scene.

    Attributes:
        speed: with all the threads that were asked for.
        one_thread: with one; None on a GPU.
        accuracy: against the oracle.
        pairs: evaluated forward and backward; None where nobody counts them.
        memory_bytes: most memory that a first forward and backward pass added, gradients included.
    """

    speed: Speed
    one_thread: Speed | None
    accuracy: Accuracy
    pairs: tuple[int, int] | None
    memory_bytes: int

    def record(self) -> dict[str, Any]:
        """Returns the figures by the names of the JSON file."""
        return {
            **self.speed.record(), **_written(self.accuracy), "pairs": self.pairs,
            "memory_bytes": self.memory_bytes,
            "one_thread": self.one_thread.record() if self.one_thread else None,
        }


@dataclass(frozen=True)
class VariantResult:
    """One approximation on one backend.

    Attributes:
        name: see `variants`.
        time: forward and backward; None where a difference would mean nothing.
        accuracy: against the oracle, which follows the contract.
    """

    name: str
    time: Timing | None
    accuracy: Accuracy


@dataclass(frozen=True)
class SceneResult:
    """Everything about one scene.

    Attributes:
        gaussians: how many.
        width: of the image in pixels.
        height: of the image in pixels.
        sh_degree: 0 to 3.
        backends: by name, the fastest kind first.
        losses: forward and backward of each photometric loss.
        variants_of: the backend that the approximations were drawn by.
        variants: the contract first, then the approximations.
    """

    gaussians: int
    width: int
    height: int
    sh_degree: int
    backends: dict[str, BackendResult]
    losses: dict[str, Timing]
    variants_of: str
    variants: list[VariantResult]

    @property
    def settings(self) -> dict[str, int]:
        """What two runs must share to be compared."""
        return {"gaussians": self.gaussians, "width": self.width, "height": self.height,
                "sh_degree": self.sh_degree}

    def record(self) -> dict[str, Any]:
        """Returns the figures by the names of the JSON file."""
        return {
            **self.settings,
            "backends": {name: one.record() for name, one in self.backends.items()},
            "losses": {name: asdict(timing) for name, timing in self.losses.items()},
            "variants_of": self.variants_of,
            "variants": [
                {"name": one.name, "time": asdict(one.time) if one.time else None,
                 **_written(one.accuracy)} for one in self.variants],
        }


@dataclass(frozen=True)
class Result:
    """A run of the benchmark.

    Attributes:
        host: where it ran.
        rounds: behind each median.
        scenes: by name.
        warm_start: of the numba backend in a fresh process; None where it was left out.
    """

    host: Host
    rounds: int
    scenes: dict[str, SceneResult]
    warm_start: Timing | None = None

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
    found = atomic.read_json(path)
    kind = (found.get("schema"), found.get("version")) if isinstance(found, dict) else None
    if kind != (SCHEMA, VERSION):
        shown = "none" if kind is None or kind[0] is None else f"{kind[0]} {kind[1]}"
        raise FormatError(
            f"{path} has the schema {shown}, but {SCHEMA} {VERSION} was needed.",
            hint="Write a new one with `recon bench --json FILE`.")
    assert isinstance(found, dict)
    return found
