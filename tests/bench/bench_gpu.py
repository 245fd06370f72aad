"""The backends of a GPU side by side, in one run: `python tests/bench/bench_gpu.py`.

Builds the kernels, compares triton with the torch backend in float64 and with itself, and times
forward, forward with backward and a whole training step by the device's own events, warm, the
candidates in turn. Prints one table, in less than ten minutes on a GPU of the H100's class.
`--device cpu --gaussians 300 --size 64x48` tries the script in triton's interpreter.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import click
import torch

from recon_cli.bench.scenes import BenchScene, SceneSize, build_scene
from recon_cli.render import render
from recon_cli.render.contract import TILE
from recon_cli.scene.splats import Splats
from recon_cli.train.losses import photometric_loss

_IMAGE, _GRADIENT = 1e-5, 1e-3  # greatest rms of a picture, relative error of a gradient
_PAIR_FLOPS = {"forward": 31, "backward": 49}  # of a Gaussian at a pixel, counted in docs/bench.md


@dataclass(frozen=True)
class Figure:
    """What one candidate takes for one thing.

    Attributes:
        name: of the thing.
        ms: by candidate, medians.
    """

    name: str
    ms: dict[str, float]


@click.command()
@click.option("--device", default="cuda", type=click.Choice(["cuda", "cpu"]), show_default=True)
@click.option("--gaussians", type=int, multiple=True, help="[default: 100000, 500000]")
@click.option("--size", multiple=True, metavar="WxH", help="[default: 640x360, 1200x680]")
@click.option("--rounds", default=7, show_default=True, help="of each candidate.")
def main(device: str, gaussians: tuple[int, ...], size: tuple[str, ...], rounds: int) -> None:
    """Compare and time the backends that run on DEVICE."""
    if device == "cuda":
        found = torch.cuda.get_device_properties(0)
        click.echo(f"{found.name}, {found.total_memory / 2**30:.0f} GiB, torch {torch.__version__}")
    sizes = [SceneSize(count, *map(int, text.split("x"))) for count, text in zip(
        gaussians or (100_000, 500_000), size or ("640x360", "1200x680"), strict=True)]
    failed = False
    for one in sizes:
        scene = build_scene(one, 3, device)
        click.echo(f"\n{one.gaussians:,} Gaussians, {one.width}x{one.height}, SH degree 3")
        failed |= not _agrees(scene)
        figures = [_timed(name, work, scene, rounds, device) for name, work in _WORKS.items()]
        for figure in figures:
            click.echo(_line(figure))
        _say_memory(scene, device)
    sys.exit(failed)


def _leaves(splats: Splats) -> Splats:
    return splats.map(lambda tensor: tensor.detach().clone().requires_grad_())


def _picture(scene: BenchScene, backend: str, dtype: torch.dtype) -> list[torch.Tensor]:
    """Returns a picture and the gradients of its sum with the scene's weights."""
    splats = _leaves(scene.splats.map(lambda tensor: tensor.to(dtype)))
    rgb = render(splats, scene.camera, scene.background.to(dtype), 3, backend=backend).rgb
    (rgb * scene.weights.to(dtype)).sum().backward()
    return [rgb.detach(), *(tensor.grad for tensor in splats.parameters().values())]


def _agrees(scene: BenchScene) -> bool:
    """Says how far triton lies from the torch backend in float64, and whether it repeats itself."""
    ours, again = (_picture(scene, "triton", torch.float32) for _ in range(2))
    same = all(torch.equal(one, other) for one, other in zip(ours, again, strict=True))
    truth = _picture(scene, "torch", torch.float64)
    image = float((ours[0] - truth[0]).square().mean().sqrt())
    worst = max(float((one - other).norm() / other.norm())
                for one, other in zip(ours[1:], truth[1:], strict=True))
    good = same and image < _IMAGE and worst < _GRADIENT
    click.echo(f"{'agrees' if good else 'DIFFERS'}: rms {image:.1e}, gradients {worst:.1e}, "
               f"{'the same bits again' if same else 'OTHER BITS AGAIN'}")
    return good


def _forward(scene: BenchScene, backend: str) -> None:
    with torch.no_grad():
        render(scene.splats, scene.camera, scene.background, 3, backend=backend)


def _both(scene: BenchScene, backend: str) -> None:
    _picture(scene, backend, torch.float32)


def _step(scene: BenchScene, backend: str) -> None:
    """The loss of training and its gradients; Adam is the same for all."""
    splats = _leaves(scene.splats)
    rgb = render(splats, scene.camera, scene.background, 3, backend=backend).rgb
    photometric_loss(rgb, scene.weights.clamp(0, 1), 0.2).backward()


_WORKS: dict[str, Callable[[BenchScene, str], None]] = {
    "forward": _forward, "forward + backward": _both, "with L1 + D-SSIM": _step}


def _timed(
    name: str, work: Callable[[BenchScene, str], None], scene: BenchScene, rounds: int, device: str
) -> Figure:
    """Returns medians, the candidates in turn, after one round that does not count."""
    found: dict[str, list[float]] = {"triton": [], "torch": []}
    for _ in range(rounds + 1):
        for backend, times in found.items():
            times.append(_milliseconds(lambda backend=backend: work(scene, backend), device))
    return Figure(name, {key: statistics.median(times[1:]) for key, times in found.items()})


def _milliseconds(work: Callable[[], None], device: str) -> float:
    if device == "cpu":
        begin = time.perf_counter()
        work()
        return 1000 * (time.perf_counter() - begin)
    first, last = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    first.record()
    work()
    last.record()
    torch.cuda.synchronize()
    return first.elapsed_time(last)


def _line(figure: Figure) -> str:
    ours, theirs = figure.ms["triton"], figure.ms["torch"]
    return (f"{figure.name}: triton {ours:.2f} ms, torch {theirs:.2f} ms, "
            f"{theirs / ours:.1f} times faster")


def _say_memory(scene: BenchScene, device: str) -> None:
    """Says the memory of a picture with gradients, and the least work that it needs."""
    pixels = scene.camera.width * scene.camera.height
    with torch.no_grad():
        hits = int(render(scene.splats, scene.camera, scene.background, 3, backend="triton",
                          scores=True).statistics.hits.sum())
    click.echo(f"{hits / pixels:.1f} fragments a pixel, {pixels // TILE**2:,} tiles; at least "
               f"{hits * sum(_PAIR_FLOPS.values()) / 1e9:.1f} GFLOP")
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
        _both(scene, "triton")
        click.echo(f"at most {torch.cuda.max_memory_allocated() / 2**20:.0f} MiB of the device")


if __name__ == "__main__":
    main()
