"""Whether the triton backend is right on this device, before anything is timed."""

from __future__ import annotations

from collections.abc import Callable
from unittest import mock

import torch
from gpu_figures import Figures
from gpu_scene import AFTER, GATHERING, photometric, stretch, training, without_graphs
from torch import Tensor

from recon_cli.experiments.bench_scene import BenchScene, SceneSize, build_scene
from recon_cli.render import render
from recon_cli.render.triton import step as triton_step
from recon_cli.render.triton.step_status import StepReport
from recon_cli.train import stepper

_IMAGE, _GRADIENT = 1e-5, 1e-3  # greatest rms of a picture, relative error of a gradient
_STEPS = 20  # half of them before a densification
_FREE = 8  # steps that may not wait
_NAMES = "picture", "means", "quats", "log_scales", "logit_opacities", "sh_dc", "sh_rest"


def _drawn(scene: BenchScene, backend: str, dtype: torch.dtype) -> list[Tensor]:
    """Returns a picture and the gradients of its sum with the scene's weights."""
    leaves = scene.splats.map(lambda tensor: tensor.to(dtype).clone().requires_grad_())
    rgb = render(leaves, scene.camera, scene.background.to(dtype), 3, backend=backend).rgb
    gradients = torch.autograd.grad(
        rgb, list(leaves.parameters().values()), scene.weights.to(dtype))
    return [rgb.detach(), *gradients]


def agreement(figures: Figures, size: SceneSize) -> None:
    """Compares with the torch backend in float64, and with a second time."""
    scene = build_scene(size, 3, figures.device)
    ours, again = (_drawn(scene, "triton", torch.float32) for _ in range(2))
    truth = _drawn(scene, "torch", torch.float64)
    image = float((ours[0] - truth[0]).square().mean().sqrt())
    errors = {name: float((one - other).norm() / other.norm())
              for name, one, other in zip(_NAMES, ours, truth, strict=True)}
    errors.pop("picture")
    worst = max(errors, key=lambda name: errors[name])
    what = f"{size.gaussians:,} Gaussians, {size.width}x{size.height}"
    # not >: NaN fails
    good = image <= _IMAGE and all(error <= _GRADIENT for error in errors.values())
    figures.check(good, f"against float64, {what}",
                  f"picture rms {image:.1e}, worst gradient {errors[worst]:.1e} ({worst})")
    other = [name for name, one, two in zip(_NAMES, ours, again, strict=True)
             if not torch.equal(one, two)]
    figures.check(not other, f"the same bits twice, {what}",
                  f"others in {', '.join(other)}" if other else "yes")


def recordings(figures: Figures, size: SceneSize) -> None:
    """Takes the same steps with and without recorded launches, and with too little room."""
    plain, _ = _moved(size, figures.device, graphs=without_graphs())
    replayed: list[int] = []
    with mock.patch.object(
            torch.cuda.CUDAGraph, "replay", _counted(torch.cuda.CUDAGraph.replay, replayed)):
        # the interpreter has no graphs; work that is done again stands for them
        graphs = None if figures.device == "cuda" else triton_step.Graphs(_Again(replayed))
        recorded, _ = _moved(size, figures.device, graphs=graphs)
    before, after = size.gaussians, len(plain["splats.means"])
    figures.check(_same(plain, recorded), "steps as CUDA graphs",
                  f"{_STEPS} steps, {len(replayed)} of them played back, across a densification "
                  f"from {before:,} to {after:,} Gaussians, {_word(plain, recorded)}")
    figures.check(len(replayed) > 0, "graphs are used", f"{len(replayed)} times")
    tight, accounts = _moved(size, figures.device, room=max(1, size.gaussians // 16))
    stopped = sum(account.stopped is not None for account in accounts)
    figures.check(_same(plain, tight), "steps whose room runs out",
                  f"stopped {stopped} times, {_word(plain, tight)}")
    figures.check(stopped > 0, "room ran out", f"{stopped} times")


class _Again:
    """Stands for a recorder: does the work again, and notes each time in `calls`."""

    def __init__(self, calls: list[int]) -> None:
        self._calls = calls

    def reset(self) -> None:
        """Has no memory to give back."""

    def __call__(self, work: Callable[[], None]) -> Callable[[], None]:
        """Returns the work, counted."""
        return _counted(work, self._calls)


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
    accounts: list[StepReport] = []
    with photometric(accounts, **options):
        state, task = training(size, device, still=False)
        take = stretch(state, task, GATHERING + 100 - _STEPS // 2, _STEPS)
    take()
    held = {name: value.cpu().clone() for name, value in state.optimizer.tensors().items()}
    return held, accounts


def _same(one: dict[str, Tensor], other: dict[str, Tensor]) -> bool:
    return not _others(one, other)


def _word(one: dict[str, Tensor], other: dict[str, Tensor]) -> str:
    others = _others(one, other)
    return f"other bits in {', '.join(others)}" if others else "the same bits of all parameters"


def _others(one: dict[str, Tensor], other: dict[str, Tensor]) -> list[str]:
    return [name for name in one | other if name not in one or name not in other
            or not torch.equal(one[name], other[name])]


def waiting(figures: Figures, size: SceneSize) -> None:
    """Starts steps where whatever waits for the device is an error."""
    if figures.device == "cpu":
        figures.say("the interpreter waits for nothing: that steps do not is not checked here")
        return
    state, task = training(size, figures.device, still=True)
    for start in (GATHERING, AFTER):
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
