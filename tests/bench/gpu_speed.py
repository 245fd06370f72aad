"""How fast pictures, gradients and training steps are, and what memory steps take."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

import torch
from gpu_clock import clear, in_turn, middle, spread
from gpu_figures import Figures
from gpu_gsplat import Gsplat, installed
from gpu_scene import AFTER, GATHERING, photometric, stretch, training, without_graphs
from torch import Tensor

from recon_cli.experiments.bench_scene import BenchScene, SceneSize, build_scene
from recon_cli.render import render
from recon_cli.train import stepper
from recon_cli.train.state import TrainState
from recon_cli.train.task import Task

_NEAR_GSPLAT = 5e-3  # rms; the same picture but for the greatest alpha
_STRETCH = 96  # steps between two densifications
_BATCH = 4
_RECORDED, _AT_ONCE = 6, 16  # steps; so few that the device's queue is never full
_FEW = 1_000  # Gaussians while kernels are compiled; the image has its size, which is compiled in
_GB = 1e9

Picture = Callable[[], Tensor]


def build(figures: Figures, size: SceneSize, steps: int) -> None:
    """Times the first pictures and steps, which compile every kernel of training."""
    few = SceneSize(min(_FEW, size.gaussians), size.width, size.height)
    begin = time.perf_counter()
    scene = build_scene(few, 3, figures.device)
    candidate = _Ours(scene, "triton")
    candidate.gradients()
    render(scene.splats, scene.camera, scene.background, 3, backend="triton", scores=True)
    pictures = time.perf_counter() - begin
    state, task = training(few, figures.device, still=True)
    for start in (GATHERING, AFTER):
        stretch(state, task, start, min(4, steps))()
    figures.add("kernels compiled", time.perf_counter() - begin, "s",
                note=f"with first launches; {pictures:.1f} s of it for pictures alone")


class _Candidate:
    """A renderer of a scene, and of its gradients by given weights."""

    def __init__(self, scene: BenchScene, leaves: list[Tensor], draw: Picture) -> None:
        self._weights, self._leaves, self._draw = scene.weights, leaves, draw

    @torch.no_grad()
    def forward(self) -> Tensor:
        """Returns the picture alone, without the buffers that gradients need."""
        return self._draw()

    def gradients(self) -> None:
        """Draws, and takes the gradients of all parameters."""
        torch.autograd.grad(self._draw(), self._leaves, self._weights)


class _Ours(_Candidate):
    """A backend of recon."""

    def __init__(self, scene: BenchScene, backend: str) -> None:
        leaves = scene.splats.map(lambda tensor: tensor.detach().clone().requires_grad_())
        super().__init__(scene, list(leaves.parameters().values()), lambda: render(
            leaves, scene.camera, scene.background, scene.sh_degree, backend=backend).rgb)


def pictures(figures: Figures, size: SceneSize, rounds: int) -> None:
    """Times pictures and gradients of the two backends that a GPU has."""
    scene = build_scene(size, 3, figures.device)
    _compare(figures, {name: _Ours(scene, name) for name in ("triton", "torch")}, rounds)


def gsplat(figures: Figures, size: SceneSize, rounds: int) -> None:
    """Times gsplat's kernels on the same scene, where that package is installed."""
    if figures.device == "cpu" or not installed():
        figures.add("triton : gsplat, forward + backward", None, "x",
                    note="gsplat is not installed")
        return
    scene = build_scene(size, 3, figures.device)
    theirs = Gsplat(scene)
    rivals = {"triton": _Ours(scene, "triton"),
              "gsplat": _Candidate(scene, theirs.leaves, theirs.picture)}
    one, other = (rival.forward() for rival in rivals.values())
    error = float((one - other).square().mean().sqrt())
    word = "as ours" if error <= _NEAR_GSPLAT else "NOT AS OURS: the ratio means nothing"
    figures.add("gsplat's picture, rms difference x 1000", 1000 * error, "", note=word)
    _compare(figures, rivals, rounds)


def _compare(figures: Figures, rivals: Mapping[str, _Candidate], rounds: int) -> None:
    """Times triton and another candidate in turn."""
    other = next(name for name in rivals if name != "triton")
    for what, works in (
        ("forward", {name: one.forward for name, one in rivals.items()}),
        ("forward + backward", {name: one.gradients for name, one in rivals.items()}),
    ):
        times = in_turn(works, rounds, figures.device)
        ms = {name: middle(found) for name, found in times.items()}
        beside = "" if other == "torch" else f" beside {other}"
        for name, found in times.items():
            figures.add(f"{what}, {name}{beside if name == 'triton' else ''}", ms[name], "ms",
                        note=spread(found))
        figures.add(f"triton : {other}, {what}", ms[other] / ms["triton"], "x")


def steps(figures: Figures, size: SceneSize, rounds: int, count: int = _STRETCH) -> None:
    """Times whole training steps as `recon train` takes them, and their memory."""
    device = figures.device
    state, task = training(size, device, still=True)
    clear(device)
    held = _allocated(device)
    phases = {"while Gaussians are added": GATHERING, "after that": AFTER}
    works = {}
    for name, start in phases.items():
        works[name] = stretch(state, task, start, count)
        works[name]()
        if start == GATHERING:  # of one trainer, not of those that take turns below
            _say_memory(figures, held)
    with photometric([], graphs=without_graphs()):
        for name, start in phases.items():
            works[f"{name}, without graphs"] = stretch(state, task, start, count)
    for name, found in in_turn(works, rounds, device).items():
        figures.add(f"training step {name}", middle(found) / count, "ms",
                    note=spread(found, count))
    if device == "cuda":
        figures.add("the host's part of a training step", _started(state, task), "ms",
                    note="to start it, with graphs; the device works at the same time")
    del works, state, task
    clear(device)
    state, task = training(size, device, still=True, batch_views=_BATCH)
    number = max(1, count // _BATCH)
    batch = {"": stretch(state, task, GATHERING, number)}
    found = in_turn(batch, rounds, device)[""]
    figures.add(f"training step of {_BATCH} views", middle(found) / number, "ms",
                note=spread(found, number))


def _started(state: TrainState, task: Task) -> float:
    """Returns the milliseconds in which the host starts a step that was recorded before."""
    state.iteration = GATHERING
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


def _allocated(device: str) -> float:
    return torch.cuda.memory_allocated() / _GB if device == "cuda" else 0.0


def _say_memory(figures: Figures, held: float) -> None:
    if figures.device == "cpu":
        figures.add("GPU memory of training", None, "GB", note="no GPU")
        return
    figures.add("GPU memory of training", torch.cuda.max_memory_allocated() / _GB, "GB",
                note=f"allocated at most; {held:.2f} GB are parameters, gradients and moments")
    figures.add("GPU memory reserved", torch.cuda.max_memory_reserved() / _GB, "GB",
                note="by torch's allocator, recordings and free blocks included")
