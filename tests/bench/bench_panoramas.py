"""Cameras of panoramas against the truth: `python tests/bench/bench_panoramas.py DATA`.

DATA is the folder of the captures. Of two rendered walks: panoramas with a camera, the root mean
square error of their centres after the best similarity, and CPU seconds of `recon sfm`. Of a real
house of seven rooms: the panoramas in each trusted part, and how far the positions that came with
them are off after the best similarity (they are good to some decimetres).
"""

from __future__ import annotations

import csv
import tempfile
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray
from workbench import FOLDER, run_recon

from recon_cli.io.colmap_library import pycolmap
from recon_cli.workspace.records import read_frame_list

ROOMS = ("living", "office")


def read_centers(model: Path, workspace: Path) -> dict[str, NDArray[np.float64]]:
    """Returns the centres of the cameras of a model by the names of their pictures."""
    source = {frame.name: frame.source for frame in read_frame_list(workspace / "ingest").frames}
    found = pycolmap.Reconstruction(model)
    return {source[found.image(i).name]: found.image(i).projection_center()
            for i in found.reg_image_ids()}


def errors(found: NDArray[np.float64], truth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns how far places [K, 3] are off after the best similarity, [K]."""
    ours, theirs = found - found.mean(axis=0), truth - truth.mean(axis=0)
    left, sizes, right = np.linalg.svd(theirs.T @ ours)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    turn = left @ np.diag(sign) @ right
    scale = (sizes * sign).sum() / (ours**2).sum()
    return np.asarray(np.linalg.norm(scale * ours @ turn.T - theirs, axis=1))


def find_cameras(pictures: Path, workspace: Path) -> float:
    """Runs ingest and sfm; returns the CPU seconds of sfm."""
    run_recon(workspace, "ingest", str(pictures), "--quiet")
    return run_recon(workspace, "sfm", "--quiet").cpu_seconds


@click.command()
@click.argument("data", type=FOLDER)
def main(data: Path) -> None:
    """Prints a line for each room, and one for each part of the house."""
    with tempfile.TemporaryDirectory() as scratch:
        for room in ROOMS:
            folder, workspace = data / "rooms360" / room, Path(scratch) / room
            seconds = find_cameras(folder / "images", workspace)
            truth = np.loadtxt(folder / "pano_traj.txt").reshape(-1, 4, 4)[:, :3, 3]
            names = [path.name for path in sorted((folder / "images").iterdir())]
            found = read_centers(workspace / "place" / "sparse", workspace)
            rows = [names.index(name) for name in found]
            off = errors(np.stack(list(found.values())), truth[rows])
            click.echo(f"{room}: {len(found)} of {len(names)}, RMSE "
                       f"{100 * np.sqrt((off**2).mean()):.3f} cm, {seconds:.0f} CPU s")
        workspace = Path(scratch) / "house"
        find_cameras(data / "house_360" / "images", workspace)
        with (data / "house_360" / "positions.csv").open() as file:
            places = {row["file"]: np.array([float(row[axis]) for axis in "xyz"])
                      for row in csv.DictReader(file)}
        for part in sorted(path for path in (workspace / "sfm" / "parts").iterdir()
                           if path.is_dir()):
            found = read_centers(part, workspace)
            off = errors(np.stack(list(found.values())), np.stack([
                places[name] for name in found]))
            click.echo(f"house, part {part.name}: {', '.join(found)}; off by {off.max():.2f} m")


if __name__ == "__main__":
    main()
