"""`recon bench`: speed of the rasterizers on this machine and their error, as one table.

The error is against the torch backend in float64, which the tests compare with an untiled brute
force within 1e-12. All parameters are rounded to float32 before, so that only arithmetic is
measured.
"""

from __future__ import annotations

import math
import re
import statistics
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import psutil
import torch
from torch import Tensor

from recon_cli import machine
from recon_cli.config.stages import RunConfig
from recon_cli.errors import ConfigError, InputError
from recon_cli.evaluation.scores import Table, number
from recon_cli.experiments.clock import Clock, examine
from recon_cli.experiments.outputs import Result
from recon_cli.experiments.synthetic_room import QUICK, SIZES, RoomScene, SceneSize, build_scene
from recon_cli.kernels.thread_pool import pool
from recon_cli.progress import Progress
from recon_cli.render import registry
from recon_cli.render.contract import Renderer, RenderOutput, StepOptions
from recon_cli.render.torch import tiles
from recon_cli.scene.train_view import TrainView
from recon_cli.train.fit.gradient import gradient_step
from recon_cli.train.fit.optimizer import SplatOptimizer
from recon_cli.workspace import atomic

SCHEMA = "recon-bench"
VERSION = 3  # goes up when a key changes its name or meaning
_ROUNDS, _QUICK_ROUNDS = 7, 2
_REFERENCE = "torch"  # the other backends are compared with it
# OpenMP's threads of the previous candidate keep spinning for some milliseconds after their work.
_SETTLE_SECONDS = 0.03
_SAMPLE_SECONDS = 0.001  # of resident memory; a forward pass takes some twenty


@dataclass(frozen=True)
class BenchPlan:
    """The measurements to make."""

    size: SceneSize
    sh_degree: int
    backends: tuple[str, ...]  # by name
    device: str  # "cpu" or "cuda"
    threads: int  # CPU threads
    rounds: int  # behind each median


@dataclass(frozen=True)
class BackendFigures:
    """Speed and error of one backend; an error is infinite where a value is not finite."""

    forward_ms: float  # medians over the rounds
    backward_ms: float
    step_ms: float  # of training: forward, loss, backward, Adam
    memory_bytes: int  # peak that a first forward and backward pass added, gradients included
    image_error_max: float  # largest difference of a channel of a pixel
    image_error_rms: float  # root of the mean square of the differences
    # ||g - g*|| / ||g*||, of the raw parameter where it is largest
    gradient_relative_error: float


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
    figures = measure(plan, progress)
    result = Result(
        {"schema": SCHEMA, "version": VERSION, "machine": asdict(host), "rounds": plan.rounds,
         "scenes": {request.scene: {
             **asdict(plan.size), "sh_degree": plan.sh_degree,
             "backends": {name: {key: None if value == math.inf else value
                                 for key, value in asdict(one).items()}
                          for name, one in figures.items()}}}},
        f"{host.line}; medians of {plan.rounds} alternated rounds", [Table(
            ("backend", "forward + backward, ms", f"{_REFERENCE} : this", "step, ms", "MB",
             "image max", "image RMS", "gradient rel."),
            [_cells(name, one, figures.get(_REFERENCE)) for name, one in figures.items()],
            f"{request.scene}: {plan.size.gaussians:,} Gaussians, {plan.size.width}x"
            f"{plan.size.height}, SH degree {plan.sh_degree}")])
    if request.out is not None:
        atomic.write_json(request.out, result.record)
    return result


def _cells(name: str, one: BackendFigures, reference: BackendFigures | None) -> tuple[str, ...]:
    both = one.forward_ms + one.backward_ms
    share = (reference.forward_ms + reference.backward_ms) / both if reference else None
    return (name, number(both), "-" if share is None else f"{share:.2f}x", number(one.step_ms),
            f"{one.memory_bytes / 1e6:.0f}", number(one.image_error_max),
            number(one.image_error_rms), number(one.gradient_relative_error))


def measure(plan: BenchPlan, progress: Progress) -> dict[str, BackendFigures]:
    """Returns the figures of every backend, the candidates in turn: a slow minute affects all.

    A first round that compiles and warms caches is not counted.
    """
    scene, tiny = (build_scene(size, plan.sh_degree, plan.device) for size in (plan.size, QUICK))
    renderers = {name: registry.renderer(name) for name in plan.backends}
    before = torch.get_num_threads(), pool.threads
    samples: dict[str, list[tuple[float, float, float]]] = {name: [] for name in renderers}
    try:
        with progress.bar("bench", plan.rounds + 2, unit="round") as bar:
            memory = {}
            for name, renderer in renderers.items():
                registry.use_threads(name, plan.threads)
                answer(tiny, renderer)  # compiles
                memory[name] = measure_memory(partial(answer, scene, renderer), plan.device)
            truth = answer(replace(
                scene, splats=scene.splats.map(Tensor.double),
                background=scene.background.double(), weights=scene.weights.double()), tiles.render)
            bar.advance()
            steps = {name: training_step(scene, name) for name in renderers}
            for round_number in range(plan.rounds + 1):
                for name, renderer in renderers.items():
                    time.sleep(_SETTLE_SECONDS)
                    timed = _time(scene, renderer, steps[name], plan.device)
                    samples[name] += [timed] * bool(round_number)
                bar.advance()
    finally:
        torch.set_num_threads(before[0])
        pool.threads = before[1]
    return {name: _collect(samples[name], memory[name], errors(answer(scene, renderer), truth))
            for name, renderer in renderers.items()}


def _collect(
    samples: Sequence[tuple[float, float, float]], memory: int, error: tuple[float, float, float]
) -> BackendFigures:
    forward, backward, step = map(statistics.median, zip(*samples, strict=True))
    return BackendFigures(forward, backward, step, memory, *error)


def _time(
    scene: RoomScene, renderer: Renderer, step: Callable[[], None], device: str
) -> tuple[float, float, float]:
    """Returns the milliseconds of a forward pass, a backward pass and a training step."""
    clock = Clock(device)
    output = _render(scene, renderer)
    forward = clock.seconds()[0]
    output.rgb.backward(scene.weights)  # type: ignore[no-untyped-call]
    backward = clock.seconds()[0]
    step()
    return 1e3 * forward, 1e3 * (backward - forward), 1e3 * (clock.seconds()[0] - backward)


def training_step(scene: RoomScene, backend: str) -> Callable[[], None]:
    """Returns a function that takes one training step at rates of 0."""
    still = replace(
        RunConfig(), means_rate=0.0, quats_rate=0.0, scales_rate=0.0, opacities_rate=0.0,
        sh_rate=0.0)
    optimizer = SplatOptimizer(scene.splats, still, 1.0, backend=backend)
    compute = gradient_step(backend, scene.splats.means.device)
    size = (scene.camera.height, scene.camera.width, 3)
    view = TrainView(scene.camera, np.random.default_rng(0).integers(0, 256, size, np.uint8))

    def step() -> None:
        compute(optimizer, view, StepOptions(scene.sh_degree, still.ssim_weight))
        optimizer.step(still.means_rate, sh_rest=scene.sh_degree > 0)

    return step


def _render(scene: RoomScene, renderer: Renderer) -> RenderOutput:
    splats = scene.splats.map(lambda tensor: tensor.detach().requires_grad_())
    return renderer(splats, scene.camera, scene.background, scene.sh_degree, False)


def answer(scene: RoomScene, renderer: Renderer) -> tuple[Tensor, dict[str, Tensor]]:
    """Returns the image of a renderer [H, W, 3] and its gradients by raw parameter, in float64."""
    splats = scene.splats.map(lambda tensor: tensor.detach().requires_grad_())
    output = renderer(splats, scene.camera, scene.background, scene.sh_degree, False)
    leaves = splats.parameters()
    computed = torch.autograd.grad(
        output.rgb, list(leaves.values()), scene.weights, allow_unused=True)
    return output.rgb.detach().double(), {
        name: (torch.zeros_like(leaf) if gradient is None else gradient).double()
        for (name, leaf), gradient in zip(leaves.items(), computed, strict=True)}


def errors(
    candidate: tuple[Tensor, dict[str, Tensor]], truth: tuple[Tensor, dict[str, Tensor]]
) -> tuple[float, float, float]:
    """Returns the largest error and the RMS of an image, and the relative one of its gradients."""
    difference = (candidate[0] - truth[0]).abs()
    relative = [(candidate[1][name] - gradient).norm() / gradient.norm()
                for name, gradient in truth[1].items() if float(gradient.norm()) > 0]
    found = (difference.max(), difference.square().mean().sqrt(),
             torch.stack(relative).amax() if relative else torch.zeros(()))
    image_max, image_rms, worst = (
        float(value.nan_to_num(nan=math.inf, posinf=math.inf)) for value in found)
    return image_max, image_rms, worst


def measure_memory(work: Callable[[], object], device: str) -> int:
    """Returns the peak bytes that `work` added: on a GPU those that torch allocated.

    On a CPU resident memory, sampled every millisecond, with the reserve of an allocator.
    """
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        work()
        torch.cuda.synchronize()
        return torch.cuda.max_memory_allocated() - before
    process, done = psutil.Process(), threading.Event()
    start = peak = process.memory_info().rss

    def watch() -> None:
        nonlocal peak
        while not done.wait(_SAMPLE_SECONDS):
            peak = max(peak, process.memory_info().rss)

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        work()
    finally:
        done.set()
        thread.join()
    added: int = max(peak, process.memory_info().rss) - start
    return added
