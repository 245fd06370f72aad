"""CPU seconds of a training step in two trees, whose processes alternate.

    .venv/bin/python tests/bench/bench_step.py ../base . --cpu haswell

Each child trains on a made room, which its views see in part, at rates of zero: every step meets
the same scene, in the order that the tree's densification leaves of one that grew by splits. Half
of the steps gather variance, a fourth moves the harmonics, as in a run. `--cpu` compiles for
another processor, in a folder of its own. `--kernels` prints each kernel, `--compile` the CPU
seconds until all kernels are ready, cold.
"""

from __future__ import annotations

import json
import os
import runpy
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from importlib import import_module
from pathlib import Path
from typing import Any

import click

ROOM = Path(__file__).parents[2] / "recon_cli" / "experiments" / "synthetic_room.py"
VIEWS, WARM, STEPS = 16, 8, 72
GROWTH = 1.1  # at each densification; the scene grew eightfold
# steps of the run, and the first that is timed: 1400 densifies, 1440 ends the variance
LENGTH, FIRST = 2400, 1404
COMPILE = ("import time; from recon_cli.render.numba import backend; start = time.process_time(); "
           "backend.warm_up(); print(time.process_time() - start)")
CPUS = {"haswell": {"NUMBA_CPU_NAME": "haswell",
                    "NUMBA_CPU_FEATURES": "+avx2,+fma,+bmi,+bmi2,+f16c,+popcnt,+lzcnt"}}


def of_training(name: str) -> Any:
    """Returns a module of training, wherever the tree has it."""
    try:
        return import_module(f"recon_cli.train.fit.{name}")
    except ModuleNotFoundError:
        return import_module(f"recon_cli.train.{name}")


def time_steps(gaussians: int, width: int, height: int) -> dict[str, Any]:
    """Returns the milliseconds of a step in this tree, by CPU and by kernel, and what is seen."""
    import numpy as np
    import torch

    from recon_cli.config.stages import RunConfig
    from recon_cli.kernels.thread_pool import pool
    from recon_cli.render import render
    from recon_cli.render.registry import use_threads
    from recon_cli.scene.camera import Camera, looking_at
    from recon_cli.scene.train_view import TrainView
    from recon_cli.splats.values import morton_order

    use_threads("numba", 1)
    splats, like = runpy.run_path(str(ROOM))["room"](gaussians, width, height)
    # each densification appends its children in the order of their parents
    born = np.floor(np.log1p(7 * np.random.default_rng(1).random(gaussians)) / np.log(GROWTH))
    order = morton_order(splats.means.numpy())
    splats = splats.select(torch.from_numpy(order[np.argsort(born[order], kind="stable")]))
    views, seen = [], []
    noise = np.random.default_rng(0).normal(0, 12, (VIEWS, height, width, 3))
    for k in range(VIEWS):
        angle = 2 * np.pi * k / VIEWS
        out_of_middle = np.array([2.4 * np.cos(angle), 1.4 * np.sin(angle), 0.2])
        eye = np.array([3, 2, 1.5]) + out_of_middle
        camera = Camera(width, height, like.fx, like.fy, like.cx, like.cy,
                        looking_at(eye, eye - out_of_middle, np.array([0, 0, 1.0])))
        out = render(splats, camera, torch.zeros(3), 3, backend="numba")
        seen.append(float((out.statistics.radii > 0).float().mean()))
        pixels = 255 * out.rgb.detach().numpy() + noise[k]
        views.append(TrainView(camera, pixels.clip(0, 255).astype(np.uint8)))
    config = RunConfig(
        iterations=LENGTH, max_gaussians=gaussians, means_rate=0.0,
        quats_rate=0.0, scales_rate=0.0, opacities_rate=0.0, sh_rate=0.0)
    task = of_training("task").Task(
        views, [], of_training("schedule").Schedule(config), 1.0, "numba", torch.device("cpu"))
    state = of_training("state").new_state(splats, config, 1.0, backend="numba")
    state.iteration = FIRST - WARM
    stepper = of_training("stepper").Stepper(state, task, None)
    for _ in range(WARM):
        stepper.step()
    kernels = Counter[str]()
    launch = pool.run

    def timed(kernel: Any, *arguments: Any, **options: Any) -> None:
        begin = time.process_time()
        launch(kernel, *arguments, **options)
        kernels[kernel.py_func.__name__] += time.process_time() - begin

    pool.run = timed
    start = time.process_time()
    for _ in range(STEPS):
        stepper.step()
    cpu = time.process_time() - start
    each = {name: 1e3 * seconds / STEPS for name, seconds in kernels.most_common()}
    total = 1e3 * cpu / STEPS
    return {"ms": total, "kernels": {**each, "rest": total - sum(each.values())},
            "seen": [min(seen), max(seen)]}


def run(tree: Path, *arguments: str, **environment: str) -> Any:
    """Runs Python in a tree and returns what it prints, read as JSON."""
    done = subprocess.run(
        [str(tree / ".venv" / "bin" / "python"), *arguments], check=True, stdout=subprocess.PIPE,
        cwd=tree, env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(tree),
                       **environment})
    return json.loads(done.stdout.splitlines()[-1])


def print_pairs(name: str, pairs: list[tuple[float, float]]) -> None:
    """Prints the least of each tree, and the least and the median ratio of the pairs."""
    first, second = zip(*pairs, strict=True)
    ratios = [b / a for a, b in pairs]
    click.echo(f"| {name} | {min(first):.2f} | {min(second):.2f} | {min(ratios):.3f} | "
               f"{statistics.median(ratios):.3f} | {max(ratios):.3f} |")


@click.command()
@click.argument("trees", nargs=2, type=click.Path(exists=True, path_type=Path))
@click.option("--gaussians", multiple=True, type=int, default=(63_000, 300_000), show_default=True)
@click.option("--size", nargs=2, type=int, default=(600, 340), show_default=True)
@click.option("--rounds", default=5, show_default=True)
@click.option("--cpu", type=click.Choice(sorted(CPUS)), help="Processor to compile for.")
@click.option("--kernels", is_flag=True, help="Print the milliseconds of each kernel.")
@click.option("--compile", "compiles", is_flag=True, help="Time the compilation of all kernels.")
def main(
    trees: tuple[Path, Path], gaussians: tuple[int, ...], size: tuple[int, int], rounds: int,
    cpu: str | None, *, kernels: bool, compiles: bool,
) -> None:
    """Prints milliseconds of CPU of a step in TREES, and their ratio, second over first."""
    trees = trees[0].absolute(), trees[1].absolute()
    environment = dict(CPUS[cpu]) if cpu else {}
    click.echo("| | first | second | ratio: least | median | most |")
    click.echo("|---|---:|---:|---:|---:|---:|")
    if compiles:
        pairs = []
        for _ in range(rounds):
            with tempfile.TemporaryDirectory() as one, tempfile.TemporaryDirectory() as two:
                pairs.append((run(trees[0], "-c", COMPILE, RECON_CACHE_DIR=one, **environment),
                              run(trees[1], "-c", COMPILE, RECON_CACHE_DIR=two, **environment)))
        print_pairs("compilation, s", pairs)
        return
    for n in gaussians:
        child = [str(Path(__file__).absolute()), "--child", str(n), *map(str, size)]
        found = [[run(tree, *child, **environment) for tree in trees] for _ in range(rounds)]
        print_pairs(f"{n:,}", [(a["ms"], b["ms"]) for a, b in found])
        if kernels:
            click.echo(f"seen {found[0][1]['seen']}")
            for name in sorted({name for pair in found for one in pair for name in one["kernels"]}):
                print_pairs(name, [(a["kernels"].get(name, 1e-9), b["kernels"].get(name, 1e-9))
                                   for a, b in found])


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        click.echo(json.dumps(time_steps(*map(int, sys.argv[2:]))))
    else:
        main()
