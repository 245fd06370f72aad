"""What views lose in viewers that leave out Gaussians beside the window.

`python tests/bench/bench_viewers.py WORKSPACE...` with a trained model each. A wall without texture
is few large Gaussians, and one whose middle lies beside an image still shows in it. Viewers in
browsers often leave out those whose middle is beyond 1.2 to 1.4 times the window (1.4 is Spark's
default; recon's own pages leave out none). Held-out views are scored by recon's renderer with all
Gaussians, and without those beyond each limit.
"""

from __future__ import annotations

import statistics
from pathlib import Path

import click
import torch
from workbench import numba_context, open_trained, print_head, print_row, workspaces_argument

from recon_cli.evaluation.reference_views import load_reference_views
from recon_cli.experiments.runner import score_as_ply
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats

LIMITS = (2.0, 1.4, 1.2)  # times the window


def within(splats: Splats, camera: Camera, limit: float) -> Splats:
    """Returns the Gaussians before the camera whose middle is within `limit` times the image."""
    rotation, shift = torch.from_numpy(camera.viewmat).float()[:3].split([3, 1], dim=1)
    x, y, z = (splats.means @ rotation.T + shift[:, 0]).unbind(-1)
    across = (camera.fx * x / z + camera.cx) / camera.width
    down = (camera.fy * y / z + camera.cy) / camera.height
    inside = (z > 0) & ((2 * across - 1).abs() < limit) & ((2 * down - 1).abs() < limit)
    return splats.select(torch.nonzero(inside)[:, 0])


@click.command()
@workspaces_argument
@click.option("--threads", default=2, show_default=True)
def main(workspaces: tuple[Path, ...], threads: int) -> None:
    """Print the PSNR of held-out views in dB, with all Gaussians and within each limit."""
    ctx = numba_context(threads)
    print_head(
        "scene", "Gaussians", "views", "all", *(f"within {limit:g}" for limit in LIMITS))
    for workspace in workspaces:
        config, scene, splats = open_trained(workspace)
        views = load_reference_views(scene.test, config.max_size, ctx)
        scores = [statistics.mean(
            score_as_ply(splats if limit is None else within(splats, view.camera, limit),
                         [view], splats.sh_degree, ctx)[0].psnr_db for view in views)
            for limit in (None, *LIMITS)]
        print_row(workspace.name, f"{len(splats):,}", str(len(views)),
                  *(f"{value:.2f}" for value in scores))


if __name__ == "__main__":
    main()
