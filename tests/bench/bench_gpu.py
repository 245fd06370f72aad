"""The triton backend on a GPU: `python tests/bench/bench_gpu.py`.

Builds the kernels, checks them, and measures pictures, gradients, training steps and memory. Each
figure is printed at once; a table of all of them comes last. Exit code 1 where a check failed or a
part broke off. tests/bench/README.md says how things are measured.

    TRITON_INTERPRET=1 python tests/bench/bench_gpu.py --device cpu --gaussians 60 --size 32x16 \
        --rounds 1 --stretch 2

tries the script where there is no GPU. Steps start in the second half of a long run with the usual
recipe, where images have their full size and colours their full degree.
"""

from __future__ import annotations

import gc
import importlib
import importlib.util
import os
import statistics
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any
from unittest import mock

import click
import numpy as np
import torch
from torch import Tensor

from recon_cli import machine
from recon_cli.config.stages import RunConfig
from recon_cli.evaluation.scores import number
from recon_cli.experiments.synthetic_room import RoomScene, SceneSize, build_scene, room
from recon_cli.render import render
from recon_cli.render.contract import NEAR
from recon_cli.render.triton import step as triton_step
from recon_cli.render.triton.step_status import StepReport
from recon_cli.scene.train_view import TrainView
from recon_cli.train.fit import stepper
from recon_cli.train.fit.schedule import Schedule
from recon_cli.train.fit.state import TrainState, new_state
from recon_cli.train.fit.task import Task
from recon_cli.workspace import atomic

_SMALL = 8  # the part of Gaussians and of each side in the first checks, which are soon over
_IMAGE, _GRADIENT = 1e-5, 1e-3  # greatest rms of a picture, relative error of a gradient
_NEAR_GSPLAT = 5e-3  # rms; the same picture but for the greatest alpha
_ITERATIONS = 30_000
_GATHERING = 15_000  # step after a densification; the next one is 100 steps away
_AFTER = 20_000  # no Gaussian is added any more
_GROWTH = 10  # the part by which the count may grow
_TURNS = 0.0, -0.05, 0.05, 0.1  # radians by which the views look aside
_CHECKED, _FREE = 20, 8  # steps: half of the first before a densification; that may not wait
_BATCH = 4
_RECORDED, _AT_ONCE = 6, 16  # steps; so few that the device's queue is never full
_FEW = 1_000  # Gaussians while kernels are compiled; the image has its size, which is compiled in
_ENOUGH, _LEAST_ROUNDS = 10_000, 3  # ms that one candidate may take in all; then three rounds do
_NAMES = "picture", "means", "quats", "log_scales", "logit_opacities", "sh_dc", "sh_rest"


@dataclass
class Figures:
    """All figures so far, each printed at once, and the checks that failed."""

    device: str  # "cuda" or "cpu"
    rows: list[dict[str, Any]] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    begin: float = field(default_factory=time.monotonic)

    def say(self, text: str) -> None:
        """Prints a line at once, with the seconds since the start."""
        click.echo(f"[{time.monotonic() - self.begin:5.0f} s] {text}")

    def add(self, name: str, value: float | None, unit: str, note: str = "") -> None:
        """Keeps a figure and prints it; a value is None where the note says why."""
        self.rows.append({"name": name, "value": value, "unit": unit, "note": note})
        self.say(f"{name}: {_text(value, unit)}{f' ({note})' * bool(note)}")

    def check(self, good: bool, name: str, found: str) -> None:
        """Prints the result of a check, and keeps it where it failed."""
        self.say(f"{'ok' if good else 'FAILED'}: {name}: {found}")
        self.failures += [f"{name}: {found}"] * (not good)

    def table(self) -> str:
        """Returns all figures in Markdown, and what failed."""
        return "\n".join([
            "| figure | measured | |", "|---|---:|---|",
            *(f"| {row['name']} | {_text(row['value'], row['unit'])} | {row['note']} |"
              for row in self.rows), "",
            *([f"FAILED: {failure}" for failure in self.failures] or ["All checks passed."])])


def _text(value: float | None, unit: str) -> str:
    return f"{number(value)} {unit}".rstrip()


def in_turn(
    works: Mapping[str, Callable[[], object]], rounds: int, device: str
) -> dict[str, list[float]]:
    """Returns milliseconds by candidate: A B A B, after one round that does not count."""
    found: dict[str, list[float]] = {name: [] for name in works}
    for each in range(rounds + 1):
        for name, work in works.items():
            if len(found[name]) >= _LEAST_ROUNDS and sum(found[name]) > _ENOUGH:
                continue
            ms = _time(work, device)
            found[name] += [ms] * bool(each)
    return found


def _time(work: Callable[[], object], device: str) -> float:
    """Returns the milliseconds of some work, by the device's own events."""
    if device == "cpu":
        begin = time.perf_counter()
        work()
        return 1000 * (time.perf_counter() - begin)
    first, last = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    first.record()
    work()
    last.record()
    last.synchronize()
    return float(first.elapsed_time(last))


def spread(times: list[float], per: float = 1) -> str:
    """Returns the range and number of the times, each divided by `per`."""
    return f"{min(times) / per:.2f} to {max(times) / per:.2f} in {len(times)} rounds"


def clear(device: str) -> None:
    """Frees unused memory, so that the peak of memory is that of the next part."""
    gc.collect()
    if device == "cuda":
        torch.cuda.synchronize()
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()


def training(
    size: SceneSize, device: str, *, still: bool, batch_views: int = 1
) -> tuple[TrainState, Task]:
    """Returns a state and the task that it is in; `still`: every step meets the same scene."""
    splats, camera = room(size.gaussians, size.width, size.height)
    config = replace(
        RunConfig(), iterations=_ITERATIONS, sh_degree=3, batch_views=batch_views,
        max_gaussians=size.gaussians + (0 if still else size.gaussians // _GROWTH))
    if still:
        config = replace(config, means_rate=0.0, quats_rate=0.0, scales_rate=0.0,
                         opacities_rate=0.0, sh_rate=0.0)
    views, rng = [], np.random.default_rng(0)
    for angle in _TURNS:
        turn, c, s = np.eye(4), np.cos(angle), np.sin(angle)
        turn[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
        image = rng.integers(0, 256, (camera.height, camera.width, 3), np.uint8)
        view = TrainView(replace(camera, viewmat=turn @ camera.viewmat), image)
        views.append(view.page_locked() if device == "cuda" else view)
    state = new_state(
        splats.map(lambda tensor: tensor.to(device)), config, 1.0, backend="triton")
    state.first_count = size.gaussians
    return state, Task(views, [], Schedule(config), 1.0, "triton", torch.device(device))


def stretch(state: TrainState, task: Task, start: int, steps: int) -> Callable[[], None]:
    """Returns a function that takes the steps after `start`, as `recon train` does, and waits."""
    advance = stepper.choose_stepper(state, task, None, lambda now: now == start + steps)

    def take() -> None:
        state.iteration = start
        while state.iteration < start + steps:
            advance()

    return take


@contextmanager
def photometric(reports: list[StepReport], **options: Any) -> Iterator[None]:
    """Lets steps that are made within the block have other options, and notes their reports."""
    original = triton_step.PhotometricStep

    class Step(original):
        def __init__(self, device: torch.device) -> None:
            super().__init__(device, **options)

        def close(self) -> StepReport:
            reports.append(super().close())
            return reports[-1]

    with mock.patch.object(triton_step, "PhotometricStep", Step):
        yield


def _drawn(scene: RoomScene, backend: str, dtype: torch.dtype) -> list[Tensor]:
    """Returns a picture and the gradients of its sum with the scene's weights."""
    leaves = scene.splats.map(lambda tensor: tensor.to(dtype).clone().requires_grad_())
    rgb = render(leaves, scene.camera, scene.background.to(dtype), 3, backend=backend).rgb
    return [rgb.detach(), *torch.autograd.grad(
        rgb, list(leaves.parameters().values()), scene.weights.to(dtype))]


def check_pictures(figures: Figures, size: SceneSize) -> None:
    """Compares with the torch backend in float64, and with a second time."""
    scene = build_scene(size, 3, figures.device)
    ours, again = (_drawn(scene, "triton", torch.float32) for _ in range(2))
    truth = _drawn(scene, "torch", torch.float64)
    image = float((ours[0] - truth[0]).square().mean().sqrt())
    errors = {name: float((one - other).norm() / other.norm())
              for name, one, other in zip(_NAMES[1:], ours[1:], truth[1:], strict=True)}
    worst = max(errors, key=lambda name: errors[name])
    what = f"{size.gaussians:,} Gaussians, {size.width}x{size.height}"
    # not >: NaN fails
    good = image <= _IMAGE and all(error <= _GRADIENT for error in errors.values())
    figures.check(good, f"against float64, {what}",
                  f"picture rms {image:.1e}, worst gradient {errors[worst]:.1e} ({worst})")
    other = [name for name, one, two in zip(_NAMES, ours, again, strict=True)
             if not torch.equal(one, two)]
    figures.check(not other, f"the same bits twice, {what}", ", ".join(other) or "yes")


def check_steps(figures: Figures, size: SceneSize) -> None:
    """Takes the same steps with and without recorded launches, and with too little room."""
    plain, _ = _moved(size, figures.device, graphs=triton_step.Graphs(None))
    replayed: list[int] = []
    with mock.patch.object(
            torch.cuda.CUDAGraph, "replay", _counted(torch.cuda.CUDAGraph.replay, replayed)):
        # the interpreter has no graphs; work that is done again stands for them
        graphs = None if figures.device == "cuda" else triton_step.Graphs(_Again(replayed))
        recorded, _ = _moved(size, figures.device, graphs=graphs)
    figures.check(not _differences(plain, recorded), "steps as CUDA graphs",
                  f"{_CHECKED} steps across a densification from {size.gaussians:,} to "
                  f"{len(plain['splats.means']):,}; other bits: {_differences(plain, recorded)}")
    figures.check(len(replayed) > 0, "graphs are used", f"{len(replayed)} times")
    tight, reports = _moved(size, figures.device, room=max(1, size.gaussians // 16))
    stopped = sum(report.stopped is not None for report in reports)
    figures.check(not _differences(plain, tight) and stopped > 0, "steps whose room runs out",
                  f"stopped {stopped} times; other bits: {_differences(plain, tight)}")


@dataclass
class _Again:
    """Stands for a recorder: does the work again, and notes each time."""

    calls: list[int]

    def reset(self) -> None:
        """Has no memory to give back."""

    def __call__(self, work: Callable[[], None]) -> Callable[[], None]:
        """Returns the work, counted."""
        return _counted(work, self.calls)


def _counted(work: Callable[..., None], calls: list[int]) -> Callable[..., None]:
    """Returns the work, with a note of each time that it is done."""

    def do(*args: object) -> None:
        calls.append(1)
        work(*args)

    return do


def _moved(
    size: SceneSize, device: str, **options: object
) -> tuple[dict[str, Tensor], list[StepReport]]:
    """Returns parameters and moments after steps across a densification."""
    reports: list[StepReport] = []
    with photometric(reports, **options):
        state, task = training(size, device, still=False)
        stretch(state, task, _GATHERING + 100 - _CHECKED // 2, _CHECKED)()
    return {name: value.cpu().clone() for name, value in state.optimizer.tensors().items()}, reports


def _differences(one: dict[str, Tensor], other: dict[str, Tensor]) -> list[str]:
    return [name for name in one | other if name not in one or name not in other
            or not torch.equal(one[name], other[name])]


def check_waiting(figures: Figures, size: SceneSize) -> None:
    """Starts steps where whatever waits for the device is an error."""
    if figures.device == "cpu":
        figures.say("the interpreter waits for nothing: that steps do not is not checked here")
        return
    state, task = training(size, figures.device, still=True)
    for start in (_GATHERING, _AFTER):
        state.iteration = start
        steps = stepper.AsyncStepper(state, task, lambda _: False)
        steps._start()  # compiles
        torch.cuda.synchronize()
        found = f"{_FREE} steps from {start:,} on, recordings among them"
        torch.cuda.set_sync_debug_mode("error")
        try:
            for _ in range(_FREE):
                steps._start()
        except RuntimeError as error:
            found = f"{error}"
        finally:
            torch.cuda.set_sync_debug_mode("default")
        figures.check(found.startswith(f"{_FREE} steps"), "nothing waits for the device", found)


def build(figures: Figures, size: SceneSize, steps: int) -> None:
    """Times the first pictures and steps, which compile every kernel of training."""
    few = SceneSize(min(_FEW, size.gaussians), size.width, size.height)
    begin = time.perf_counter()
    scene = build_scene(few, 3, figures.device)
    _ours(scene, "triton").gradients()
    render(scene.splats, scene.camera, scene.background, 3, backend="triton", scores=True)
    pictures = time.perf_counter() - begin
    state, task = training(few, figures.device, still=True)
    for start in (_GATHERING, _AFTER):
        stretch(state, task, start, min(4, steps))()
    figures.add("kernels compiled", time.perf_counter() - begin, "s",
                f"with first launches; {pictures:.1f} s of it for pictures alone")


@dataclass(frozen=True)
class _Candidate:
    """A renderer of a scene, and of its gradients by given weights."""

    weights: Tensor
    leaves: list[Tensor]
    draw: Callable[[], Tensor]

    @torch.no_grad()
    def forward(self) -> Tensor:
        """Returns the picture alone, without the buffers that gradients need."""
        return self.draw()

    def gradients(self) -> None:
        """Draws, and takes the gradients of all parameters."""
        torch.autograd.grad(self.draw(), self.leaves, self.weights)


def _ours(scene: RoomScene, backend: str) -> _Candidate:
    leaves = scene.splats.map(lambda tensor: tensor.detach().clone().requires_grad_())
    return _Candidate(scene.weights, list(leaves.parameters().values()), lambda: render(
        leaves, scene.camera, scene.background, scene.sh_degree, backend=backend).rgb)


def _gsplat(scene: RoomScene) -> _Candidate:
    """Returns gsplat's CUDA kernels on the same scene.

    Opacities and scales are activated ahead, so that its time is that of its kernels alone; its
    greatest alpha is higher than that of the contract.
    """
    splats = scene.splats.map(lambda tensor: tensor.detach())
    leaves = [tensor.clone().requires_grad_() for tensor in (
        splats.means, splats.quats, splats.scales, splats.opacities,
        torch.cat([splats.sh_dc[:, None], splats.sh_rest], 1))]
    camera, like = scene.camera, splats.means
    viewmats = like.new_tensor(camera.viewmat)[None]
    intrinsics = like.new_tensor(
        [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])[None]
    rasterization = importlib.import_module("gsplat").rasterization

    def draw() -> Tensor:
        colors, _, _ = rasterization(
            *leaves, viewmats, intrinsics, camera.width, camera.height, near_plane=NEAR,
            sh_degree=scene.sh_degree, packed=False)
        return colors[0]

    return _Candidate(scene.weights, leaves, draw)


def pictures(figures: Figures, size: SceneSize, rounds: int, rival: str) -> None:
    """Times pictures and gradients of triton and of torch, or gsplat where it is installed."""
    if rival == "gsplat" and (
            figures.device == "cpu" or importlib.util.find_spec("gsplat") is None):
        figures.add("triton : gsplat, forward + backward", None, "x", "gsplat is not installed")
        return
    scene = build_scene(size, 3, figures.device)
    rivals = {"triton": _ours(scene, "triton"),
              rival: _gsplat(scene) if rival == "gsplat" else _ours(scene, rival)}
    if rival == "gsplat":
        one, other = (each.forward() for each in rivals.values())
        error = float((one - other).square().mean().sqrt())
        figures.add("gsplat's picture, rms difference x 1000", 1000 * error, "", "as ours" if (
            error <= _NEAR_GSPLAT) else "NOT AS OURS: the ratio means nothing")
    for what, works in (
        ("forward", {name: each.forward for name, each in rivals.items()}),
        ("forward + backward", {name: each.gradients for name, each in rivals.items()}),
    ):
        times = in_turn(works, rounds, figures.device)
        ms = {name: statistics.median(found) for name, found in times.items()}
        for name, found in times.items():
            figures.add(f"{what}, {name} beside {rival}", ms[name], "ms", spread(found))
        figures.add(f"triton : {rival}, {what}", ms[rival] / ms["triton"], "x")


def steps(figures: Figures, size: SceneSize, rounds: int, count: int) -> None:
    """Times whole training steps as `recon train` takes them, and their memory."""
    device = figures.device
    state, task = training(size, device, still=True)
    clear(device)
    held = torch.cuda.memory_allocated() / 1e9 if device == "cuda" else 0.0
    phases = {"while Gaussians are added": _GATHERING, "after that": _AFTER}
    works = {}
    for name, start in phases.items():
        works[name] = stretch(state, task, start, count)
        works[name]()
        if start == _GATHERING and device == "cuda":  # of one trainer, not of those below
            figures.add("GPU memory of training", torch.cuda.max_memory_allocated() / 1e9, "GB",
                        f"at most; {held:.2f} GB are parameters, gradients and moments")
            figures.add("GPU memory reserved", torch.cuda.max_memory_reserved() / 1e9, "GB",
                        "by torch's allocator, recordings and free blocks included")
    with photometric([], graphs=triton_step.Graphs(None)):
        for name, start in phases.items():
            works[f"{name}, without graphs"] = stretch(state, task, start, count)
    for name, found in in_turn(works, rounds, device).items():
        figures.add(f"training step {name}", statistics.median(found) / count, "ms",
                    spread(found, count))
    if device == "cuda":
        figures.add("the host's part of a training step", _started(state, task), "ms",
                    "to start it, with graphs; the device works at the same time")
    del works, state, task
    clear(device)
    state, task = training(size, device, still=True, batch_views=_BATCH)
    batches = max(1, count // _BATCH)
    found = in_turn({"": stretch(state, task, _GATHERING, batches)}, rounds, device)[""]
    figures.add(f"training step of {_BATCH} views", statistics.median(found) / batches, "ms",
                spread(found, batches))


def _started(state: TrainState, task: Task) -> float:
    """Returns the milliseconds in which the host starts a step that was recorded before."""
    state.iteration = _GATHERING
    trainer = stepper.AsyncStepper(state, task, lambda _: False)
    for _ in range(_RECORDED):
        trainer._start()
    torch.cuda.synchronize()
    begin = time.perf_counter()
    for _ in range(_AT_ONCE):
        trainer._start()
    seconds = time.perf_counter() - begin
    torch.cuda.synchronize()
    return 1000 * seconds / _AT_ONCE


@click.command()
@click.option("--device", default="cuda", type=click.Choice(["cuda", "cpu"]), show_default=True)
@click.option("--gaussians", default=500_000, show_default=True)
@click.option("--size", default="1200x680", metavar="WxH", show_default=True)
@click.option("--rounds", default=7, show_default=True, help="of each candidate.")
@click.option("--stretch", "count", default=96, show_default=True, type=click.IntRange(1, 99),
              help="Training steps that are timed at a time.")
@click.option("--only", multiple=True, type=click.Choice(
    ["kernels", "checks", "pictures", "gsplat", "steps"]),
    help="Part to do; may be repeated.  [default: all]")
@click.option("--minutes", default=9.0, show_default=True, help="No part is begun later.")
@click.option("--cache", type=click.Path(file_okay=False, path_type=Path),
              help="Folder of compiled kernels.  [default: a new one: compilation is timed]")
@click.option("--out", type=click.Path(dir_okay=False, path_type=Path),
              help="Write all figures as JSON.  [default: nowhere]")
def main(device: str, gaussians: int, size: str, rounds: int, count: int,
         only: tuple[str, ...], minutes: float, cache: Path | None, out: Path | None) -> None:
    """Check and measure the triton backend on DEVICE."""
    width, height = map(int, size.split("x"))
    whole, figures = SceneSize(gaussians, width, height), Figures(device)
    small = SceneSize(max(min(40, gaussians), gaussians // _SMALL), max(16, width // _SMALL),
                      max(16, height // _SMALL))
    name = torch.cuda.get_device_name() if device == "cuda" else (
        f"{machine.cpu_model()}, triton's interpreter: no figure means anything")
    figures.say(f"{name}, torch {torch.__version__}; {gaussians:,} Gaussians, degree 3, {size}")
    checks = [(check, each) for each in (small, whole) for check in (check_pictures, check_steps)]
    parts: list[tuple[str, Callable[[], None]]] = [
        ("kernels", lambda: build(figures, whole, count)),
        *(("checks", lambda check=check, each=each: check(figures, each))
          for check, each in [*checks, (check_waiting, whole)]),
        ("pictures", lambda: pictures(figures, whole, rounds, "torch")),
        ("gsplat", lambda: pictures(figures, whole, rounds, "gsplat")),
        ("steps", lambda: steps(figures, whole, rounds, count))]
    with tempfile.TemporaryDirectory(prefix="recon-triton-") as empty:
        # without --cache kernels of earlier runs are not found: their compilation is timed
        os.environ["TRITON_CACHE_DIR"] = empty if cache is None else str(cache)
        for group, work in parts:
            if only and group not in only:
                continue
            if time.monotonic() - figures.begin > 60 * minutes:
                figures.add(group, None, "", "left out, the time is over")
                continue
            clear(device)
            try:
                work()
            except Exception as error:  # whatever it is, the table must come
                click.echo(traceback.format_exc())
                figures.failures.append(f"{group} broke off: {type(error).__name__}: {error}")
    click.echo(f"\n{figures.table()}")
    if out is not None:
        atomic.write_json(out, {"device": name, "versions": machine.versions(), **{
            key: value for key, value in asdict(figures).items() if key != "begin"}})
    sys.exit(bool(figures.failures))


if __name__ == "__main__":
    main()
