"""What training on many images takes in memory: `python tests/bench/bench_memory.py WORKSPACE`.

The views of a workspace are enlarged and repeated until there are as many as asked for. `recon
train` then runs on them, trials included, with their images in memory and in a file; each run has
a process of its own.
"""

from __future__ import annotations

import dataclasses
import subprocess
import sys
import tempfile
from itertools import cycle, islice
from pathlib import Path
from unittest.mock import patch

import click
import cv2
from workbench import (
    numba_context,
    open_scene,
    print_head,
    print_row,
    stage_folders,
    workspace_argument,
)

from recon_cli import machine
from recon_cli.config.stages import TrainConfig
from recon_cli.context import StageInputs
from recon_cli.io.training_scene import PlacedCapture
from recon_cli.scene.scene import Scene
from recon_cli.stages import train


def enlarged(scene: Scene, count: int, width: int, folder: Path) -> Scene:
    """Returns a scene of `count` training views with images of a width, which it writes."""
    views = []
    for view in scene.train:
        camera = view.camera
        camera = camera.resized(width, round(camera.height * width / camera.width))
        path = folder / f"{Path(view.name).stem}.png"
        if not path.exists():
            image = cv2.resize(cv2.imread(str(view.original)), (camera.width, camera.height))
            cv2.imwrite(str(path), image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        views.append(dataclasses.replace(view, camera=camera, original=path, denoised=path))
    return dataclasses.replace(
        scene, train=tuple(islice(cycle(views), count)), validation=tuple(views[:10]))


@click.command()
@workspace_argument
@click.option("--views", default=1200, show_default=True)
@click.option("--width", default=1280, show_default=True)
@click.option("--iterations", default=300, show_default=True)
@click.option("--max-gaussians", default=200_000, show_default=True)
@click.option("--max-memory", default=2.0, show_default=True, help="GB, for the second run.")
@click.option("--child", type=click.Path(path_type=Path), hidden=True)
def main(
    workspace: Path, views: int, width: int, iterations: int, max_gaussians: int,
    max_memory: float, child: Path | None,
) -> None:
    """Print peak memory and seconds with images in memory and in a file."""
    if child is None:
        print_head("images", "peak memory, GB", "seconds")
        with tempfile.TemporaryDirectory(dir=workspace.parent) as folder:
            for given in (1e6, max_memory):
                subprocess.run(
                    [sys.executable, __file__, str(workspace), "--views", str(views), "--width",
                     str(width), "--iterations", str(iterations), "--max-gaussians",
                     str(max_gaussians), "--max-memory", str(given), "--child", folder],
                    check=True)
        return
    scene = enlarged(open_scene(workspace, 0.05), views, width, child)
    config = TrainConfig(
        iterations=iterations, max_size=width, max_gaussians=max_gaussians)
    ctx = dataclasses.replace(
        numba_context(2), max_memory_bytes=int(max_memory * 1e9), scratch=child)
    with (tempfile.TemporaryDirectory(dir=child) as out, machine.Meter() as meter,
          patch.object(PlacedCapture, "load_scene", lambda *_, **__: scene)):
        train.run(config, StageInputs(stage_folders(workspace)), Path(out), ctx)
    label = "in memory" if max_memory >= 1e6 else f"in a file, --max-memory {max_memory:g}"
    print_row(label, f"{meter.peak_memory_bytes / 1e9:.2f}", f"{meter.seconds:.0f}")


if __name__ == "__main__":
    main()
