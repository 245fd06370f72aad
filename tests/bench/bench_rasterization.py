"""CPU seconds of `recon_cli.rasterization` in several cameras against a loop of the torch backend.

Forward and backward of a made scene; the two alternate in one process, and each has its least time.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import click
import torch
from torch import Tensor

from recon_cli import rasterization
from recon_cli.experiments.synthetic_room import SceneSize, build_scene
from recon_cli.render.registry import render


def main() -> None:
    """Prints CPU seconds, wall seconds and their ratio."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--gaussians", type=int, default=100_000)
    parser.add_argument("--cameras", type=int, default=4)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    calls = candidates(args.gaussians, args.cameras)
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in calls}
    for call in calls.values():
        call()  # compiles, and makes buffers
    for _ in range(args.rounds):
        for name, call in calls.items():
            times[name].append(measure(call))
    slowest = min(cpu for cpu, _ in times["loop of torch"])
    slow_wall = min(wall for _, wall in times["loop of torch"])
    for name, pairs in times.items():
        cpu, wall = (min(column) for column in zip(*pairs, strict=True))
        click.echo(f"{name:32} {cpu:8.3f} CPU s {slowest / cpu:6.1f}x   {wall:8.3f} s "
                   f"{slow_wall / wall:6.1f}x")


def candidates(gaussians: int, cameras: int) -> dict[str, Callable[[], None]]:
    """Returns what is timed: each a forward and a backward pass of all cameras."""
    scene = build_scene(SceneSize(gaussians, 640, 360), 3, "cpu")
    camera = scene.camera
    raw = scene.splats.map(lambda tensor: tensor.detach().float().requires_grad_())
    like = raw.means.detach()
    leaves = [tensor.detach().clone().requires_grad_() for tensor in (
        raw.means, raw.quats, raw.scales, raw.opacities,
        torch.cat([raw.sh_dc[:, None], raw.sh_rest], 1))]
    viewmats = like.new_tensor(camera.viewmat).repeat(cameras, 1, 1)
    viewmats[:, 0, 3] += 0.02 * torch.arange(cameras)
    K = like.new_tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    Ks = K.repeat(cameras, 1, 1)
    size = camera.width, camera.height
    black = like.new_zeros(3)

    def loop() -> None:
        loss = torch.zeros(())
        for viewmat in viewmats:
            moved = type(camera)(camera.width, camera.height, camera.fx, camera.fy, camera.cx,
                                 camera.cy, viewmat.double().numpy())
            loss = loss + render(raw, moved, black, scene.sh_degree, backend="torch").rgb.square(
            ).mean()
        loss.backward()
        clear([*raw.parameters().values()])

    def one(poses: Tensor, *, statistics: bool) -> None:
        images, _, meta = rasterization(*leaves, poses, Ks, *size, sh_degree=scene.sh_degree)
        if statistics:
            meta["means2d"].retain_grad()
        images.square().mean().backward()
        if statistics:
            meta["radii"].max()
        clear(leaves)

    return {
        "loop of torch": loop,
        "rasterization": lambda: one(viewmats, statistics=False),
        "with statistics of densification": lambda: one(viewmats, statistics=True),
        "with gradients of viewmats": lambda: one(
            viewmats.clone().requires_grad_(), statistics=False)}


def clear(tensors: list[Tensor]) -> None:
    """Takes the gradients away."""
    for tensor in tensors:
        tensor.grad = None


def measure(call: Callable[[], None]) -> tuple[float, float]:
    """Returns the CPU seconds and the seconds of a call."""
    cpu, wall = time.process_time(), time.perf_counter()
    call()
    return time.process_time() - cpu, time.perf_counter() - wall


if __name__ == "__main__":
    main()
