"""Speed and accuracy of sfm: `python tests/bench/bench_sfm.py CAPTURE [--help]`.

Runs ingest, denoise (off) and sfm on a video or a folder of photos and prints what came out and
the seconds of each step. With --traj (one 4x4 camera-to-world pose a line, in metres, line k for
frame k of the video) also how far the cameras are from the truth after the best similarity: the
error of the centres, and of the rotations before and after a rotation common to all is taken off,
which a shift of the principal point brings and no picture shows.

With several --max-features, a table with a row for each: `--max-features 1000 --max-features 2048`.
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

SHOWN = ("frames", "registered", "points", "mean_track_length", "reprojection_error_px",
         "median_triangulation_angle_deg", "models", "cameras")
COMPARED = ("seconds", "registered", "centre", "rotation")  # how the columns of the table begin

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


def prepare(capture: Path, work: Path, ctx: StageContext, frames: int | None) -> StageInputs:
    """Runs ingest and denoise in `work` and returns what sfm reads."""
    folders = {name: work / name for name in ("ingest", "denoise")}
    for folder in folders.values():
        folder.mkdir(parents=True, exist_ok=True)
    ingest.run(
        IngestConfig(frames=frames), StageInputs(sources=(capture,)), folders["ingest"], ctx)
    inputs = StageInputs(folders)
    denoise.run(DenoiseConfig(mode="off"), inputs, folders["denoise"], ctx)
    return inputs


def measured(
    inputs: StageInputs, out: Path, ctx: StageContext, config: SfmConfig, traj: Path | None
) -> dict[str, object]:
    """Runs sfm in `out` and returns what came out, how far from the truth, and the seconds."""
    out.mkdir(parents=True, exist_ok=True)
    summary: Summary = sfm.run(config, inputs, out, ctx)
    seconds = summary["seconds"]
    rows: dict[str, object] = {
        name: value for name, value in summary.items() if name in SHOWN}
    rows["rungs"] = ", ".join(rung["name"] for rung in summary["rungs"])
    if traj is not None:
        rows |= errors(*poses(out / "sparse", traj))
    rows |= {f"seconds, {step}": value for step, value in seconds.items()}
    return {**rows, "seconds, all": float(sum(seconds.values()))}


def compared(rows: Mapping[int, Mapping[str, object]]) -> str:
    """A line for each number of keypoints, separated by tabs."""
    names = [name for name in next(iter(rows.values())) if name.startswith(COMPARED)]
    lines = [["keypoints", *names]]
    for count, row in rows.items():
        lines.append([str(count), *(
            f"{row[name]:.3f}" if isinstance(row[name], float) else str(row[name])
            for name in names)])
    return "\n".join("\t".join(line) for line in lines)


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
@click.option(
    "--max-features", type=int, multiple=True, default=[SfmConfig().max_features],
    show_default=True)
@click.option("--pairs", default=SfmConfig().pairs, show_default=True)
@click.option("--threads", default=2, show_default=True)
@click.option("--work", type=click.Path(path_type=Path), help="Keep the results in this folder.")
def main(
    capture: Path, traj: Path | None, frames: int | None, max_features: tuple[int, ...], pairs: str,
    threads: int, work: Path | None,
) -> None:
    """Prints a table for one capture."""
    ctx = StageContext(threads=threads, progress=TqdmProgress())
    rows = {}
    with tempfile.TemporaryDirectory() as temporary:
        folder = work or Path(temporary)
        inputs = prepare(capture, folder, ctx, frames)
        for count in max_features:
            config = SfmConfig(max_features=count, pairs=pairs)
            rows[count] = measured(inputs, folder / f"sfm{count}", ctx, config, traj)
            click.echo(table(rows[count]))
    if len(rows) > 1:
        click.echo(compared(rows))


if __name__ == "__main__":
    main()
