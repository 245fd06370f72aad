"""How much coarser levels look like the scene, by the size of the picture: `python bench_lod.py`.

WORKSPACE has a trained scene. Its views are rendered from every level of `--format lod` at full
size and at a half, a quarter and an eighth of it, which is what is seen from as many times farther
away, and compared with pictures of the scene at full size that are reduced by area.
"""

from __future__ import annotations

import math
import statistics
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import click
import cv2
import torch
from workbench import open_trained, print_head, print_row, workspace_argument

from recon_cli.io.images import fit_camera
from recon_cli.render import render
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats
from recon_cli.splats.lod import make_levels, write_lod

SIZES = (1, 2, 4, 8)
VIEWS, SIDE = 8, 600


def image(splats: Splats, camera: Camera) -> torch.Tensor:
    """Returns what a camera sees."""
    with torch.no_grad():
        rgb: torch.Tensor = render(
            splats, camera, splats.background, splats.sh_degree, backend="numba").rgb.clamp(0, 1)
    return rgb


def agreement(splats: Splats, views: Sequence[tuple[Camera, torch.Tensor]], size: int) -> float:
    """Returns the PSNR in dB of all pixels at a `size` times smaller."""
    squares = []
    for camera, full in views:
        small = fit_camera(camera, SIDE // size)
        truth = cv2.resize(full.numpy(), (small.width, small.height), interpolation=cv2.INTER_AREA)
        squares.append(float((image(splats, small) - torch.from_numpy(truth)).square().mean()))
    return -10 * math.log10(max(statistics.mean(squares), 1e-10))


@click.command()
@workspace_argument
def main(workspace: Path) -> None:
    """Print Gaussians, megabytes and agreement of each level."""
    _, scene, splats = open_trained(workspace)
    cameras = [fit_camera(view.camera, SIDE)
               for view in scene.train[:: max(1, len(scene.train) // VIEWS)]]
    views = [(camera, image(splats, camera)) for camera in cameras]
    begin = time.perf_counter()
    levels = make_levels(splats)
    making = time.perf_counter() - begin
    with tempfile.TemporaryDirectory() as folder:
        begin = time.perf_counter()
        write_lod(Path(folder) / "lod-meta.json", levels)
        writing = time.perf_counter() - begin
        sizes = [sum(file.stat().st_size for part in Path(folder).glob(f"{level}_*")
                     for file in part.iterdir()) for level in range(len(levels))]
    click.echo(f"levels in {making:.1f} s, files in {writing:.1f} s")
    print_head("level", "Gaussians", "MB", *(f"dB at 1/{size}" for size in SIZES))
    for level, coarse in enumerate(levels):
        print_row(str(level), f"{len(coarse):,}", f"{sizes[level] / 1e6:.1f}", *(
            f"{agreement(coarse, views, size):.1f}" for size in SIZES))


if __name__ == "__main__":
    main()
