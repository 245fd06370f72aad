"""Speed and accuracy of sfm: `python tests/bench/bench_sfm.py CAPTURE [--help]`.

Runs ingest, denoise (off) and sfm on a video or a folder of photos and prints what came out and
the seconds of each step. With --traj (one 4x4 camera-to-world pose a line, in metres, line k for
frame k of the video) also how far the cameras are from the truth after the best similarity: the
error of the centres, and of the rotations before and after a rotation common to all is taken off,
which a shift of the principal point brings and no picture shows.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recon_cli.config import DenoiseConfig, IngestConfig, SfmConfig
from recon_cli.io.colmap import read_images
from recon_cli.progress import TqdmProgress
from recon_cli.stages import denoise, ingest, sfm
from recon_cli.stages.context import StageContext, StageInputs, Summary

Poses = NDArray[np.float64]  # [F, 4, 4] camera to world


def similarity(found: NDArray[np.float64], truth: NDArray[np.float64]) -> tuple[float, Poses]:
    """Scale and [4, 4] motion with truth ~ motion (scale found); both [F, 3] (Umeyama 1991)."""
    a, b = found - found.mean(axis=0), truth - truth.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    flip = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    scale = float(np.trace(np.diag(s) @ flip) / (a**2).sum())
    motion = np.eye(4)
    motion[:3, :3] = u @ flip @ vt
    motion[:3, 3] = truth.mean(axis=0) - scale * motion[:3, :3] @ found.mean(axis=0)
    return scale, motion


def errors(found: Poses, truth: Poses) -> dict[str, float]:
    """Errors of the poses after the best similarity, in cm and degrees."""
    scale, motion = similarity(found[:, :3, 3], truth[:, :3, 3])
    centers = scale * found[:, :3, 3] @ motion[:3, :3].T + motion[:3, 3]
    squares = ((centers - truth[:, :3, 3]) ** 2).sum(axis=1)
    turns = Rotation.from_matrix((motion[:3, :3] @ found[:, :3, :3]).transpose(0, 2, 1)
                                 @ truth[:, :3, :3])
    own = turns.mean().inv() * turns
    return {
        "centre RMSE cm": 100 * float(np.sqrt(squares.mean())),
        "centre max cm": 100 * float(np.sqrt(squares.max())),
        "rotation median deg": float(np.degrees(np.median(turns.magnitude()))),
        "rotation median deg, common part off": float(np.degrees(np.median(own.magnitude()))),
    }


def poses(model: Path, traj: Path) -> tuple[Poses, Poses]:
    """Poses of the registered frames, as found and as they are."""
    lines = np.loadtxt(traj).reshape(-1, 4, 4)
    images = read_images(model / "images.bin")
    found = np.stack([np.linalg.inv(viewmat) for _, _, viewmat in images])
    return found, np.stack([lines[int(Path(name).stem)] for name, _, _ in images])


def run(capture: Path, work: Path, ctx: StageContext, frames: int | None, config: SfmConfig
        ) -> Summary:
    """Runs the three stages in `work` and returns the summary of sfm."""
    folders = {name: work / name for name in ("ingest", "denoise", "sfm")}
    for folder in folders.values():
        folder.mkdir(parents=True, exist_ok=True)
    ingest.run(
        IngestConfig(frames=frames), StageInputs(sources=(capture,)), folders["ingest"], ctx)
    inputs = StageInputs(folders)
    denoise.run(DenoiseConfig(mode="off"), inputs, folders["denoise"], ctx)
    return sfm.run(config, inputs, folders["sfm"], ctx)


def table(rows: Mapping[str, object]) -> str:
    """Two columns of text."""
    width = max(map(len, rows))
    return "\n".join(
        f"{name:<{width}}  {value:.3f}" if isinstance(value, float) else f"{name:<{width}}  {value}"
        for name, value in rows.items())


@click.command()
@click.argument("capture", type=click.Path(exists=True, path_type=Path))
@click.option("--traj", type=click.Path(exists=True, path_type=Path), help="True poses.")
@click.option("--frames", type=int, help="Frames to choose from a video.")
@click.option("--max-features", default=SfmConfig().max_features, show_default=True)
@click.option("--pairs", default=SfmConfig().pairs, show_default=True)
@click.option("--threads", default=2, show_default=True)
@click.option("--work", type=click.Path(path_type=Path), help="Keep the results in this folder.")
def main(
    capture: Path, traj: Path | None, frames: int | None, max_features: int, pairs: str,
    threads: int, work: Path | None,
) -> None:
    """Prints a table for one capture."""
    ctx = StageContext(threads=threads, progress=TqdmProgress())
    config = SfmConfig(max_features=max_features, pairs=pairs)
    with tempfile.TemporaryDirectory() as temporary:
        folder = work or Path(temporary)
        summary = run(capture, folder, ctx, frames, config)
        seconds = summary.pop("seconds")
        rows = {name: value for name, value in summary.items() if not name.startswith("unreg")}
        if traj is not None:
            rows |= errors(*poses(folder / "sfm" / "sparse", traj))
    rows |= {f"seconds, {step}": value for step, value in seconds.items()}
    rows["seconds, all"] = float(sum(seconds.values()))
    click.echo(table(rows))


if __name__ == "__main__":
    main()
