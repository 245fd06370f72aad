"""What training in blocks costs: `python tests/bench/bench_blocks.py WORKSPACE OUT --blocks 3`.

WORKSPACE has its sfm done and is only read: a capture with held-out views, such as the apartment of
make_apartment.py. It is trained in blocks, then whole, with as many Gaussians as the merged model
has and as many steps as all blocks and the fine-tuning took together. Printed are PSNR and SSIM on
the held-out views, also of those alone that lie within a metre (--near) of a border between two
blocks, with the CPU seconds of each training.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray
from workbench import (
    numba_context,
    open_trained,
    print_head,
    print_row,
    run_recon,
    stage_folders,
    workspace_argument,
)

from recon_cli.context import StageInputs
from recon_cli.evaluation.reference_views import load_reference_views, score_views
from recon_cli.io.views import ReferenceView
from recon_cli.scene.cells import Cell
from recon_cli.splats.ply import read_ply
from recon_cli.train.blocks.blocks import cut_blocks

PLACES = 500  # that are drawn around a camera
SEED = 0


def train_copy(source: Path, out: Path, words: list[str]) -> float:
    """Trains a copy of a workspace, and returns the CPU seconds."""
    if not out.exists():
        shutil.copytree(source, out, ignore=shutil.ignore_patterns("train", "prune", ".lock"))
    done = run_recon(out, "train", *words)
    if done.code:
        raise click.ClickException(done.error)
    return done.cpu_seconds


def score_model(
    path: Path, views: list[ReferenceView]
) -> tuple[int, NDArray[np.float64], NDArray[np.float64]]:
    """Returns the count of a model's Gaussians, and PSNR in dB and SSIM of each view."""
    splats = read_ply(path)
    scores = score_views(splats, views, splats.sh_degree, "numba").views
    return (len(splats), np.array([score.psnr_db for score in scores]),
            np.array([score.ssim for score in scores]))


def owners(cells: list[Cell], positions: NDArray[np.float64]) -> NDArray[np.int64]:
    """Returns the block of each position, [N]."""
    return np.argmax([cell.owns(positions) for cell in cells], axis=0)


def near_border(cells: list[Cell], centre: NDArray[np.float64], reach: float) -> bool:
    """Returns whether a ball about a camera reaches into several cells."""
    draws = np.random.default_rng(SEED)
    offsets = draws.normal(size=(PLACES, 3))
    offsets /= np.linalg.norm(offsets, axis=1, keepdims=True)
    offsets *= reach * draws.random((PLACES, 1)) ** (1 / 3)
    return len(np.unique(owners(cells, centre + offsets))) > 1


@click.command()
@workspace_argument
@click.argument("out", type=click.Path(path_type=Path))
@click.option("--blocks", default=3, show_default=True)
@click.option("--iterations", default=1500, show_default=True, help="Steps of each block.")
@click.option("--max-gaussians", default=60_000, show_default=True, help="Cap of each block.")
@click.option("--max-size", default=480, show_default=True)
@click.option("--near", default=1.0, show_default=True, help="Scene units from a border.")
@click.option("--set", "settings", multiple=True, metavar="OPTION", help="More options of train.")
def main(
    workspace: Path, out: Path, blocks: int, iterations: int, max_gaussians: int, max_size: int,
    near: float, settings: tuple[str, ...],
) -> None:
    """Print the scores of WORKSPACE trained in blocks and as one model."""
    common = ["--max-size", str(max_size), "--no-early-stop", *settings]
    places = {"one model": out / "whole", "blocks": out / "blocks"}
    seconds = {"blocks": train_copy(workspace, places["blocks"], [
        "--blocks", str(blocks), "--iterations", str(iterations), "--max-gaussians",
        str(max_gaussians), *common])}
    config, scene, merged = open_trained(places["blocks"])
    seconds["one model"] = train_copy(workspace, places["one model"], [
        "--blocks", "off", "--iterations", str(config.iterations), "--max-gaussians",
        str(len(merged)), *common])
    views = load_reference_views(scene.test, max_size, numba_context())
    inputs = StageInputs(stage_folders(workspace))
    cells = [job.cell for job in cut_blocks(config, blocks, scene, inputs, out / "cut")]
    border = np.array([near_border(cells, view.camera.center, near) for view in views])
    click.echo(f"{len(views)} held-out views, {border.sum()} within {near:g} of a border\n")
    print_head("model", "Gaussians", "PSNR / SSIM", "near a border", "CPU s")
    for name, place in places.items():
        count, psnr, ssim = score_model(place / "train" / "splats.ply", views)
        columns = [f"{psnr[rows].mean():.2f} / {ssim[rows].mean():.3f}" if rows.any() else ""
                   for rows in (np.ones(len(views), bool), border)]
        print_row(name, f"{count:,}", *columns, f"{seconds[name]:.0f}")


if __name__ == "__main__":
    main()
