"""The measurement of `recon bench`: every backend and thread count."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from recon_cli.config.stages import RunConfig
from recon_cli.experiments import instruments
from recon_cli.experiments.bench_scene import (
    QUICK,
    Accuracy,
    BenchScene,
    SceneSize,
    accuracy,
    answer,
    build_scene,
    oracle,
)
from recon_cli.experiments.instruments import Host, Samples, Stopwatch, Timing
from recon_cli.kernels.thread_pool import pool
from recon_cli.progress import Bar, Progress
from recon_cli.render import registry
from recon_cli.render.contract import Renderer, RenderOutput, StepOptions
from recon_cli.scene.train_view import TrainView
from recon_cli.train.gradient import gradient_step
from recon_cli.train.optimizer import SplatOptimizer

SCHEMA = "recon-bench"
VERSION = 2  # goes up when a key changes its name or meaning
PASSES = ("forward", "backward", "step")

Work = Callable[[], Mapping[str, float]]  # returns milliseconds by PASSES


@dataclass(frozen=True)
class Speed:
    """The speed of a backend with some number of threads."""

    threads: int
    times: dict[str, Timing]  # by PASSES; a step is forward, loss, backward, Adam

    @property
    def both_ms(self) -> float:
        """Forward and backward pass."""
        return self.times["forward"].ms + self.times["backward"].ms

    def record(self) -> dict[str, Any]:
        """Returns the figures by the names of the JSON file."""
        return {
            "threads": self.threads,
            **{f"{name}_ms": self.times[name].ms for name in PASSES},
            **{f"{name}_iqr_ms": self.times[name].iqr_ms for name in PASSES}}


@dataclass(frozen=True)
class BackendResult:
    """One backend in one scene."""

    speed: Speed  # with all threads
    one_thread: Speed | None  # None on a GPU
    accuracy: Accuracy  # against the oracle
    memory_bytes: int  # peak that a first forward and backward pass added, gradients included

    def record(self) -> dict[str, Any]:
        """Returns the figures by the names of the JSON file."""
        return {
            **self.speed.record(), **_finite(self.accuracy),
            "memory_bytes": self.memory_bytes,
            "one_thread": self.one_thread.record() if self.one_thread else None}


def _finite(accuracy: Accuracy) -> dict[str, Any]:
    """Returns an accuracy as JSON, with null for infinity."""
    return {name: None if value == math.inf else value for name, value in asdict(accuracy).items()}


@dataclass(frozen=True)
class BenchedScene:
    """All results of one scene."""

    gaussians: int
    width: int  # of the image in pixels
    height: int
    sh_degree: int
    backends: dict[str, BackendResult]  # by name, the fastest kind first


@dataclass(frozen=True)
class BenchResult:
    """A run of the benchmark."""

    host: Host
    rounds: int  # behind each median
    scenes: dict[str, BenchedScene]

    def record(self) -> dict[str, Any]:
        """Returns the content of the JSON file."""
        return {
            "schema": SCHEMA, "version": VERSION, "machine": asdict(self.host),
            "rounds": self.rounds,
            "scenes": {name: {
                **asdict(scene),
                "backends": {name: backend.record() for name, backend in scene.backends.items()},
            } for name, scene in self.scenes.items()}}


def training_step(scene: BenchScene, backend: str) -> Callable[[], None]:
    """Returns a function that takes one training step at rates of 0."""
    still = replace(
        RunConfig(), means_rate=0.0, quats_rate=0.0, scales_rate=0.0, opacities_rate=0.0,
        sh_rate=0.0)
    optimizer = SplatOptimizer(scene.splats, still, 1.0, backend=backend)
    compute = gradient_step(backend, scene.splats.means.device)
    view = TrainView(scene.camera, noise(scene))

    def step() -> None:
        compute(optimizer, view, StepOptions(scene.sh_degree, still.ssim_weight))
        optimizer.step(still.means_rate, sh_rest=scene.sh_degree > 0)

    return step


def noise(scene: BenchScene) -> NDArray[np.uint8]:
    """Returns a random image of the scene's size, [H, W, 3]."""
    size = (scene.camera.height, scene.camera.width, 3)
    return np.random.default_rng(0).integers(0, 256, size, np.uint8)


@dataclass(frozen=True)
class BenchPlan:
    """The measurements to make."""

    size: SceneSize
    sh_degree: int
    backends: tuple[str, ...]  # by name
    device: str  # "cpu" or "cuda"
    threads: int  # CPU threads; one thread is measured as well
    rounds: int  # behind each median


def measure(plan: BenchPlan, progress: Progress) -> BenchedScene:
    """Returns all results of one scene."""
    size = plan.size
    with use_threads(plan.threads), progress.bar(
        "bench", plan.rounds + 2, unit="round"
    ) as bar:
        measurement = _Measurement(plan, bar)
        backends = measurement.measure_backends()
    return BenchedScene(size.gaussians, size.width, size.height, plan.sh_degree, backends)


@contextmanager
def use_threads(count: int, backend: str = "torch") -> Iterator[None]:
    """Lets a backend use `count` threads within the block, as training does."""
    before, pool_before = torch.get_num_threads(), pool.threads
    registry.use_threads(backend, count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        pool.threads = pool_before


class _Measurement:
    """One scene, the memory of every backend on it, and the oracle's answer."""

    def __init__(self, plan: BenchPlan, bar: Bar) -> None:
        self._plan, self._bar = plan, bar
        self._scene = build_scene(plan.size, plan.sh_degree, plan.device)
        self._memory = {name: self._measure_memory(name) for name in plan.backends}
        self._truth = oracle(self._scene)
        bar.advance()

    def measure_backends(self) -> dict[str, BackendResult]:
        """Returns speed and accuracy of every backend, all thread counts in turn."""
        plan, on_cpu = self._plan, self._plan.device == "cpu"
        counts = sorted({1, plan.threads}) if on_cpu else [plan.threads]
        samples = self._alternate({
            f"{name} {threads}": self._time_backend(name, threads)
            for threads in counts for name in plan.backends})

        def speed(name: str, threads: int) -> Speed:
            return Speed(threads, {part: Timing.from_samples(values) for part, values in samples[
                f"{name} {threads}"].items()})

        return {
            name: BackendResult(
                speed(name, plan.threads), speed(name, 1) if on_cpu else None,
                self._accuracy(registry.renderer(name)), self._memory[name])
            for name in plan.backends}

    def _alternate(self, works: Mapping[str, Work]) -> dict[str, Samples]:
        return instruments.alternate(works, self._plan.rounds, self._bar.advance)

    def _accuracy(self, renderer: Renderer) -> Accuracy:
        return accuracy(answer(self._scene, renderer), self._truth)

    def _measure_memory(self, backend: str) -> int:
        """Returns the memory of a first pass, after one on a tiny scene that compiles kernels."""
        renderer, device = registry.renderer(backend), self._plan.device
        _render_and_back(build_scene(QUICK, self._scene.sh_degree, device), renderer)
        return instruments.measure_memory(partial(_render_and_back, self._scene, renderer), device)

    def _time_backend(self, backend: str, threads: int) -> Work:
        """Returns a function that times both passes and a step."""
        step = training_step(self._scene, backend)

        def run() -> Mapping[str, float]:
            with use_threads(threads, backend):
                return {**self._time_passes(backend), **self._time_step(step)}

        return run

    def _time_passes(self, backend: str) -> dict[str, float]:
        """Returns the milliseconds of both passes."""
        watch = Stopwatch(self._plan.device)
        output = _render(self._scene, registry.renderer(backend))
        watch.mark("forward")
        output.rgb.backward(self._scene.weights)  # type: ignore[no-untyped-call]
        watch.mark("backward")
        return dict(watch.ms)

    def _time_step(self, step: Callable[[], None]) -> dict[str, float]:
        """Returns the milliseconds of an optimization step."""
        watch = Stopwatch(self._plan.device)
        step()
        watch.mark("step")
        return dict(watch.ms)


def _render(scene: BenchScene, renderer: Renderer) -> RenderOutput:
    splats = scene.splats.map(lambda tensor: tensor.detach().requires_grad_())
    return renderer(splats, scene.camera, scene.background, scene.sh_degree, False)


def _render_and_back(scene: BenchScene, renderer: Renderer) -> None:
    """Runs both passes of a renderer."""
    _render(scene, renderer).rgb.backward(scene.weights)  # type: ignore[no-untyped-call]
