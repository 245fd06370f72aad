"""The measurement: every backend, thread count, loss and approximation on one scene."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon_cli.config.stages import RunConfig
from recon_cli.experiments.accuracy import Answer, accuracy, answer, oracle
from recon_cli.experiments.bench_result import BackendResult, BenchedScene, Speed, VariantResult
from recon_cli.experiments.host import (
    FLOPS_BACKWARD,
    FLOPS_FORWARD,
    Host,
    Samples,
    Stopwatch,
    added_memory,
    alternate,
    peak_fraction,
    rate,
    timing_of,
)
from recon_cli.experiments.probes import COMPOSITE, DECOMPOSE, probe_for
from recon_cli.experiments.synthetic_room import (
    CONTRACT,
    QUICK,
    BenchScene,
    SceneSize,
    build_scene,
    renderer_of,
    variants_for,
)
from recon_cli.progress import Bar, Progress
from recon_cli.render import registry
from recon_cli.render.contract import Renderer, RenderOutput
from recon_cli.render.numba.loss import C1, C2, MAPS, RADIUS, photometric, taps
from recon_cli.render.numba.thread_pool import pool
from recon_cli.scene.train_view import TrainView
from recon_cli.train.gradient import gradient_step
from recon_cli.train.losses import photometric_loss
from recon_cli.train.optimizer import SplatOptimizer

Mark = Callable[[str], None]
ADAM = "adam"  # the part of a step that moves the parameters


def training_step(scene: BenchScene, backend: str) -> Callable[[Mark], None]:
    """Returns a function that takes one step as `recon_cli.train.fit` does and marks its parts.

    The learning rates are zero, so that every step of every candidate meets the same scene; Adam
    does the same arithmetic.
    """
    still = replace(
        RunConfig(), means_rate=0.0, quats_rate=0.0, scales_rate=0.0, opacities_rate=0.0,
        sh_rate=0.0)
    optimizer = SplatOptimizer(scene.splats, still, 1.0, backend=backend)
    compute = gradient_step(backend, scene.splats.means.device)
    view = TrainView(scene.camera, noise(scene))

    def step(mark: Mark) -> None:
        compute(optimizer, view, scene.sh_degree, still.ssim_weight)
        mark("gradients")
        optimizer.step(still.means_rate, sh_rest=scene.sh_degree > 0)
        mark(ADAM)

    return step


def loss_passes(scene: BenchScene, device: str) -> dict[str, Callable[[], object]]:
    """Returns, by name, what computes the photometric loss and its gradient on an image.

    "torch" is what the others are compared with.
    """
    weight, truth = RunConfig().ssim_weight, noise(scene)
    target = torch.from_numpy(truth).to(device).float() / 255
    image = target.flip(0).contiguous()
    leaf = image.clone().requires_grad_()
    passes: dict[str, Callable[[], object]] = {
        "torch": lambda: torch.autograd.grad(photometric_loss(leaf, target, weight), leaf)}
    passes["autograd"] = lambda: torch.autograd.grad(
        convolution_loss(leaf, target, weight), leaf)
    if device == "cpu":
        rgb, gradient = image.numpy().reshape(-1), np.empty(image.numel(), np.float32)
        maps = np.empty(MAPS * image.numel(), np.float32)
        passes["fused"] = lambda: photometric(
            rgb, truth.reshape(-1), scene.camera.width, scene.camera.height, weight, maps=maps,
            gradient=gradient)
    return passes


def convolution_loss(image: Tensor, truth: Tensor, ssim_weight: float) -> Tensor:
    """Returns (1 - w) L1 + w (1 - SSIM) in the way that most trainers write it.

    Five grouped convolutions with the 11x11 window, differentiated by autograd. Its numbers are
    those of `photometric_loss`; only its time is of interest.
    """
    line = image.new_tensor(taps())
    window = (line[:, None] * line).expand(3, 1, -1, -1)

    def blur(planes: Tensor) -> Tensor:
        return torch.nn.functional.conv2d(planes, window, padding=RADIUS, groups=3)

    x, y = (item.permute(2, 0, 1)[None] for item in (image, truth))
    mu_x, mu_y = blur(x), blur(y)
    variances = blur(x * x) - mu_x * mu_x + blur(y * y) - mu_y * mu_y
    covariance = blur(x * y) - mu_x * mu_y
    ssim: Tensor = ((2 * mu_x * mu_y + float(C1)) * (2 * covariance + float(C2))) / (
        (mu_x * mu_x + mu_y * mu_y + float(C1)) * (variances + float(C2)))
    loss: Tensor = (
        (1 - ssim_weight) * (image - truth).abs().mean() + ssim_weight * (1 - ssim.mean()))
    return loss


def noise(scene: BenchScene) -> NDArray[np.uint8]:
    """Returns a random photograph of the scene's size, [H, W, 3]."""
    size = (scene.camera.height, scene.camera.width, 3)
    return np.random.default_rng(0).integers(0, 256, size, np.uint8)


Work = Callable[[], Mapping[str, float]]
Pairs = tuple[int, int] | None


@dataclass(frozen=True)
class BenchPlan:
    """What is measured."""

    size: SceneSize
    sh_degree: int
    backends: tuple[str, ...]  # by name
    device: str  # "cpu" or "cuda"
    threads: int  # CPU threads; the figures of one thread are taken as well
    rounds: int  # behind each median

    @property
    def thread_counts(self) -> list[int]:
        """The numbers of threads that speeds are taken with."""
        return [self.threads] if self.device == "cuda" else sorted({1, self.threads})


def measure(plan: BenchPlan, host: Host, progress: Progress) -> BenchedScene:
    """Returns every figure of one scene."""
    scene = build_scene(plan.size, plan.sh_degree, plan.device)
    with _threads(plan.threads), progress.bar(
        "bench", 3 * (plan.rounds + 1) + 1, unit="round"
    ) as bar:
        memory = {name: _memory(scene, name, plan.device) for name in plan.backends}
        truth = oracle(scene)
        bar.advance()
        backends = _backends(scene, plan, host, truth, memory, bar)
        losses = alternate(
            {name: _second(work, plan.device)
             for name, work in loss_passes(scene, plan.device).items()},
            plan.rounds, bar.advance)
        variants = _variants(scene, plan, truth, bar)
    return BenchedScene(
        plan.size.gaussians, plan.size.width, plan.size.height, plan.sh_degree, backends,
        {name: timing_of(samples["whole"]) for name, samples in losses.items()},
        plan.backends[0], variants)


def _backends(
    scene: BenchScene, plan: BenchPlan, host: Host, truth: Answer, memory: Mapping[str, int],
    bar: Bar,
) -> dict[str, BackendResult]:
    """Returns speed and accuracy of every backend, all thread counts in turn."""
    peak = host.peak_gflops if plan.device == "cpu" else None
    works, pairs = _speed_works(scene, plan)
    samples = alternate(works, plan.rounds, bar.advance)

    def speed(name: str, threads: int) -> Speed:
        return _speed(samples[_label(name, threads)], pairs[name], peak, threads)

    return {
        name: BackendResult(
            speed(name, plan.threads), speed(name, 1) if plan.device == "cpu" else None,
            accuracy(answer(scene, registry.renderer(name)), truth), pairs[name], memory[name])
        for name in plan.backends}


def _variants(
    scene: BenchScene, plan: BenchPlan, truth: Answer, bar: Bar
) -> list[VariantResult]:
    """Returns time and accuracy of the contract and of every approximation, in turn."""
    backend = plan.backends[0]
    variants = [CONTRACT, *variants_for(backend, plan.sh_degree)]
    renderers = {variant.name: renderer_of(variant, backend) for variant in variants}
    with _threads(plan.threads, backend):
        samples = alternate(
            {name: _whole(_passes(scene, draw), plan.device) for name, draw in renderers.items()},
            plan.rounds, bar.advance)
    return [
        VariantResult(
            variant.name,
            timing_of(samples[variant.name]["whole"]) if variant.saves_time else None,
            accuracy(answer(scene, renderers[variant.name]), truth))
        for variant in variants]


def _label(backend: str, threads: int) -> str:
    return f"{backend} {threads}"


@contextmanager
def _threads(count: int, backend: str = "torch") -> Iterator[None]:
    """Lets a backend use `count` threads within the block, in the way that training does."""
    before, pool_before = torch.get_num_threads(), pool.threads
    registry.use_threads(backend, count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        pool.threads = pool_before


def _render(scene: BenchScene, draw: Renderer) -> RenderOutput:
    splats = scene.splats.map(lambda tensor: tensor.detach().requires_grad_())
    return draw(splats, scene.camera, scene.background, scene.sh_degree, False)


def _memory(scene: BenchScene, backend: str, device: str) -> int:
    """Returns the memory of a first pass, after one on a tiny scene has compiled everything."""
    draw = registry.renderer(backend)
    tiny = build_scene(QUICK, scene.sh_degree, device)

    _passes(tiny, draw)()
    return added_memory(_passes(scene, draw), device)


def _speed_works(scene: BenchScene, plan: BenchPlan) -> tuple[dict[str, Work], dict[str, Pairs]]:
    """Returns the timed work of each backend and thread count, and where their pairs end up."""
    pairs: dict[str, Pairs] = dict.fromkeys(plan.backends)

    def work(name: str, threads: int) -> Work:
        step = training_step(scene, name)

        def run() -> Mapping[str, float]:
            with _threads(threads, name):
                passes, pairs[name] = _timed_passes(scene, name, plan.device)
                return {**passes, **_timed_step(step, name, plan.device)}

        return run

    works = {_label(name, threads): work(name, threads)
             for threads in plan.thread_counts for name in plan.backends}
    return works, pairs


def _timed_passes(scene: BenchScene, name: str, device: str) -> tuple[dict[str, float], Pairs]:
    """Returns the milliseconds of both passes and of their parts, and the pairs."""
    draw, probe = registry.renderer(name), probe_for(name, device)
    with probe.watching():
        watch = Stopwatch(device)
        output = _render(scene, draw)
        watch.mark("forward")
        forward = probe.collect()
        output.rgb.backward(scene.weights)  # type: ignore[no-untyped-call]
        watch.mark("backward")
        backward = probe.collect()
    return {
        **_parts("forward", watch.ms["forward"], forward),
        **_parts("backward", watch.ms["backward"], backward)}, probe.pairs(output)


def _timed_step(step: Callable[[Mark], None], name: str, device: str) -> dict[str, float]:
    """Returns the milliseconds of an optimization step and of its parts."""
    probe = probe_for(name, device)
    with probe.watching():
        watch = Stopwatch(device)
        step(watch.mark)
    parts = probe.collect()
    parts.setdefault(ADAM, watch.ms[ADAM])
    return _parts("step", sum(watch.ms.values()), parts)


def _parts(whole: str, ms: float, parts: Mapping[str, float]) -> dict[str, float]:
    """Returns the time of a pass under its name, and of its parts with what they leave over."""
    times = {whole: ms}
    if parts:
        times |= {f"{whole}: {part}": part_ms for part, part_ms in parts.items()}
        times[f"{whole}: rest"] = max(0.0, ms - sum(parts.values()))
    return times


def _whole(work: Callable[[], object], device: str) -> Work:
    """Returns a function that does some work and returns its milliseconds."""
    def run() -> Mapping[str, float]:
        watch = Stopwatch(device)
        work()
        watch.mark("whole")
        return watch.ms

    return run


def _second(work: Callable[[], object], device: str) -> Work:
    """Returns a function that does short work twice and returns the milliseconds of the second.

    In training the images have just been written; after the pause between candidates they have
    left the caches.
    """
    timed = _whole(work, device)

    def run() -> Mapping[str, float]:
        work()
        return timed()

    return run


def _passes(scene: BenchScene, draw: Renderer) -> Callable[[], object]:
    """Returns a function that runs both passes of a renderer."""
    return lambda: _render(scene, draw).rgb.backward(  # type: ignore[no-untyped-call]
        scene.weights)


def _speed(samples: Samples, pairs: Pairs, peak: float | None, threads: int) -> Speed:
    """Returns medians and rates; those of pairs are of the compositing stages alone."""
    timings = {name: timing_of(values) for name, values in samples.items()}
    whole = {name: timings.pop(name) for name in ("forward", "backward", "step")}
    inner = [timings.get(f"forward: {COMPOSITE}"), timings.get(f"backward: {DECOMPOSE}")]
    forward, backward = (
        rate(pairs[i] if pairs else None, stage.ms if stage else None)
        for i, stage in enumerate(inner))
    return Speed(
        threads, whole["forward"], whole["backward"], whole["step"], forward, backward,
        peak_fraction(forward, FLOPS_FORWARD, peak, threads),
        peak_fraction(backward, FLOPS_BACKWARD, peak, threads), timings)
