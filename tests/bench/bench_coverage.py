"""Where the error of held-out views lies, by how many training views show the same surface.

    python tests/bench/bench_coverage.py WORKSPACE

WORKSPACE holds a trained model. Surfaces are told by the model's own depth: a training view shows
a pixel's surface where its own depth there is no smaller, within 3%.
"""

from __future__ import annotations

import zlib  # noqa: F401 - before pycolmap, which brings a zlib of its own
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import click
import numpy as np
import torch
from numpy.typing import NDArray

from recon_cli.context import StageContext, StageInputs
from recon_cli.evaluation.reference_views import load_reference_views
from recon_cli.io.training_scene import load_scene
from recon_cli.render import render
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats
from recon_cli.scene.train_view import TrainView
from recon_cli.splats.ply import read_ply
from recon_cli.train.train_data import read_config

CLASSES = (0, 1, 3, 10, 1000)  # views that show a pixel: 0, 1 to 2, 3 to 9, 10 and more
SLACK = 1.03  # of the depth
SHOWN = 30  # training views that are scored, at most


def picture(splats: Splats, camera: Camera, degree: int) -> tuple[NDArray, NDArray]:
    """Returns colours [H, W, 3] and depth [H, W], world units."""
    with torch.no_grad():
        out = render(splats, camera, splats.background, degree, backend="numba")
    return out.rgb.clamp(0, 1).numpy(), (out.depth / out.alpha.clamp(min=1e-3)).numpy()


def showing(
    camera: Camera, depth: NDArray, others: Sequence[Camera], depths: Sequence[NDArray]
) -> NDArray:
    """Returns how many of the other views show the surface of each pixel, [H, W]."""
    v, u = np.mgrid[:camera.height, :camera.width] + 0.5
    local = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy,
                      np.ones_like(u)], -1) * depth[..., None]
    turn, shift = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    world = (local - shift) @ turn
    count = np.zeros(depth.shape, int)
    for other, other_depth in zip(others, depths, strict=True):
        x, y, z = np.moveaxis(world @ other.viewmat[:3, :3].T + other.viewmat[:3, 3], -1, 0)
        ahead = np.maximum(z, 1e-6)
        column = np.floor(other.fx * x / ahead + other.cx).astype(int)
        line = np.floor(other.fy * y / ahead + other.cy).astype(int)
        inside = ((z > 0) & (column >= 0) & (line >= 0)
                  & (column < other.width) & (line < other.height))
        hit = np.zeros_like(inside)
        hit[inside] = z[inside] <= SLACK * other_depth[line[inside], column[inside]]
        count += hit
    return count


def line(name: str, error: NDArray, count: NDArray, low: int, high: int) -> str:
    """Returns one class as a line of a table."""
    here = (count >= low) & (count < high)
    if not here.any():
        return f"| {name} | {low}+ | 0% | | |"
    return (f"| {name} | {low} to {high - 1} | {here.mean():.1%} | "
            f"{error[here].sum() / error.sum():.1%} | {-10 * np.log10(error[here].mean()):.2f} |")


@click.command()
@click.argument("workspace", type=click.Path(exists=True, file_okay=False, path_type=Path))
def main(workspace: Path) -> None:
    """Print shares of pixels and of squared error, and PSNR, by how many views show a pixel."""
    inputs = StageInputs({name: workspace / name for name in ("ingest", "sfm", "train")})
    config = read_config(workspace / "train")
    scene = load_scene(inputs.folders, validation=config.validation)
    splats, ctx = read_ply(workspace / "train" / "splats.ply"), StageContext(backend="numba")
    train = load_reference_views(scene.train, config.max_size, ctx)
    cameras = [view.camera for view in train]
    depths = [picture(splats, camera, config.sh_degree)[1] for camera in cameras]

    def table(name: str, views: Sequence[TrainView], own: int) -> None:
        errors, counts = [], []
        for view in views:
            rgb, depth = picture(splats, view.camera, config.sh_degree)
            errors.append(np.square(rgb - view.image / 255).mean(-1).ravel())
            counts.append(showing(view.camera, depth, cameras, depths).ravel() - own)
        error, count = np.concatenate(errors), np.concatenate(counts)
        for low, high in pairwise(CLASSES):
            click.echo(line(name, error, count, low, high))
        click.echo(f"| {name} | all | 100% | 100% | {-10 * np.log10(error.mean()):.2f} |")

    click.echo("| views | shown by other training views | pixels | squared error | PSNR there |\n"
               "|---|---|---:|---:|---:|")
    table("held out", load_reference_views(scene.test, config.max_size, ctx), 0)
    table("validation", load_reference_views(scene.validation, config.max_size, ctx), 0)
    table("training", train[::max(1, -(-len(train) // SHOWN))], 1)


if __name__ == "__main__":
    main()
