"""Speed and memory of a rasterizer: `python tests/bench/bench_rasterizer.py [--help]`.

Prints, for a synthetic room, the milliseconds of a forward and a backward pass, the evaluated
Gaussian-pixel pairs a second, and the most memory that a forward and backward pass added. The
rates are of the compositing passes alone and of the whole pass with projection and binning.
Medians of alternated runs; give --threads 1 to compare machines core by core.
"""

from __future__ import annotations

import resource
import statistics
import threading
import time
from collections.abc import Callable

import click
import numpy as np
import psutil
import torch

from recon_cli.render import registry, torch_blocks, torch_tiles
from recon_cli.scene import Camera, Splats


def room(n: int, width: int, height: int, *, seed: int = 0) -> tuple[Splats, Camera]:
    """N Gaussians on the walls of a 6x4x3 m room and on boxes in it, and a camera inside."""
    rng = np.random.default_rng(seed)
    size = np.array([6.0, 4.0, 3.0])
    wall = rng.integers(0, 6, n)
    means = rng.random((n, 3)) * size
    means[np.arange(n), wall // 2] = np.where(wall % 2, size[wall // 2], 0)
    boxes, edge = rng.random((12, 3)) * (size - 1), 0.3 + 0.7 * rng.random((12, 3))
    which, inside = rng.integers(0, 12, n // 3), rng.random((n // 3, 3))
    inside[np.arange(n // 3), wall[: n // 3] // 2] = wall[: n // 3] % 2
    means[: n // 3] = boxes[which] + inside * edge[which]
    spacing = np.sqrt((2 * (24 + 18 + 12) + 12 * 2.4) / n)
    scales = 0.45 * spacing * np.exp(rng.normal(0, 0.5, (n, 3)))
    scales[np.arange(n), wall // 2] *= 0.15
    values = {
        "means": means, "quats": rng.normal([1, 0, 0, 0], [1e-9, 0.1, 0.1, 0.1], (n, 4)),
        "log_scales": np.log(scales), "logit_opacities": rng.normal(0.5, 2.0, n),
        "sh_dc": np.sin(means * [3, 5, 7]), "sh_rest": rng.normal(0, 0.05, (n, 15, 3)),
    }
    forward = np.array([3.5, 2.0, -0.4]) / np.linalg.norm([3.5, 2.0, -0.4])
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = [right, np.cross(forward, right), forward]
    viewmat[:3, 3] = -viewmat[:3, :3] @ [1.0, 1.0, 1.6]
    focal = 0.85 * width
    camera = Camera(width, height, focal, focal, width / 2, height / 2, viewmat)
    return Splats(**{k: torch.tensor(v, dtype=torch.float32) for k, v in values.items()}), camera


class _PeakMemory:
    """The most resident memory above the start, sampled every millisecond."""

    def __enter__(self) -> _PeakMemory:
        self._process = psutil.Process()
        self._start = self.peak = self._process.memory_info().rss
        self._running = True
        self._thread = threading.Thread(target=self._watch)
        self._thread.start()
        return self

    def _watch(self) -> None:
        while self._running:
            self.peak = max(self.peak, self._process.memory_info().rss)
            time.sleep(0.001)

    def __exit__(self, *exc: object) -> None:
        self._running = False
        self._thread.join()
        self.added = self.peak - self._start


def _timed(work: Callable[[], object], device: str) -> float:
    if device == "cuda":
        torch.cuda.synchronize()
    start = time.perf_counter()
    work()
    if device == "cuda":
        torch.cuda.synchronize()
    return 1e3 * (time.perf_counter() - start)


class _RasterClock:
    """Wraps the compositing passes of the torch backend to time them and count their pairs."""

    def __init__(self, device: str) -> None:
        self.forward: list[float] = []
        self.backward: list[float] = []
        self.pairs = 0
        function = torch_tiles._Rasterize
        run_forward, run_backward, run_alphas = (
            function.forward, function.backward, torch_blocks.alphas)

        def forward(*args):
            self.pairs, result = 0, []
            self.forward.append(_timed(lambda: result.append(run_forward(*args)), device))
            return result[0]

        def backward(*args):
            result = []
            self.backward.append(_timed(lambda: result.append(run_backward(*args)), device))
            return result[0]

        def alphas(table, block, *rest):
            self.pairs += block.rows.numel() * torch_blocks.PIXELS
            return run_alphas(table, block, *rest)

        function.forward, function.backward = staticmethod(forward), staticmethod(backward)
        torch_tiles.alphas = alphas


@click.command(context_settings={"show_default": True})
@click.option("--gaussians", default=100_000, help="Gaussians in the room.")
@click.option("--size", default="640x360", help="Image size, WIDTHxHEIGHT.")
@click.option("--threads", default=1, help="CPU threads.")
@click.option("--device", default="cpu", help="cpu or cuda.")
@click.option("--repeat", default=7, help="Measured runs.")
def main(gaussians: int, size: str, threads: int, device: str, repeat: int) -> None:
    """Measures the torch backend on a synthetic room."""
    torch.set_num_threads(threads)
    width, height = (int(part) for part in size.split("x"))
    splats, camera = room(gaussians, width, height)
    splats = splats.map(lambda tensor: tensor.to(device).requires_grad_())
    background = torch.zeros(3, device=device)
    clock = _RasterClock(device)
    forward, backward = [], []
    for attempt in range(repeat + 1):
        images = []
        with _PeakMemory() as memory:
            forward.append(_timed(lambda made=images: made.append(
                registry.render(splats, camera, background, 3)), device))
            loss = images[0].rgb.square().mean()
            backward.append(_timed(loss.backward, device))
        if attempt == 0:
            added = memory.added
    pairs = clock.pairs / 2  # the backward pass evaluates the same blocks again
    raster = [statistics.median(times[1:]) for times in (clock.forward, clock.backward)]
    whole = [statistics.median(times[1:]) for times in (forward, backward)]
    click.echo(f"{gaussians} Gaussians, {size}, {threads} thread(s), {device}, "
               f"torch {torch.__version__}")
    click.echo(f"visible {int((images[0].statistics.radii > 0).sum())}, "
               f"evaluated pairs {pairs / 1e6:.1f} M")
    for name, part, total in zip(("forward", "backward"), raster, whole, strict=True):
        spread = max(forward[1:]) / min(forward[1:])
        click.echo(f"{name:9s} whole {total:7.1f} ms, compositing {part:7.1f} ms, "
                   f"{pairs / part / 1e3:6.0f} Mpairs/s compositing, "
                   f"{pairs / total / 1e3:6.0f} whole (max/min {spread:.2f})")
    peak = (torch.cuda.max_memory_allocated() if device == "cuda" else added) / 1e6
    click.echo(f"memory added by forward and backward: {peak:.0f} MB (first run, gradients "
               f"of {gaussians * 59 * 4 / 1e6:.0f} MB included); process peak "
               f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3:.0f} MB")


if __name__ == "__main__":
    main()
