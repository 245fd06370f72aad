"""Captures of scanning apps through ingest and sfm: `python tests/bench/bench_apps.py DATA`.

DATA is the folder of rendered rooms. Each layout of `app_sets` is written with frames of a room.
Poses of layouts that are tracked drift by 2 cm and 1 degree until the end; those of others are
exact. A row has the frames that got a camera, how far the scale is off and its interval of 95%,
the root mean square error of the centres and the largest of the rotations after the best rigid
motion (a similarity where the layout gives no metres), how far z is from up, and CPU seconds of
`recon sfm`. Photos are told by what they show.
"""

from __future__ import annotations

import dataclasses
import functools
import shutil
import tempfile
from pathlib import Path
from typing import Any

import click
import cv2
import numpy as np
from app_sets import APPS
from app_shots import Shot, shots
from numpy.typing import NDArray
from phone_writers import quest, stray
from PIL import Image
from pose_errors import similarity
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation
from solved_writers import rig
from workbench import FOLDER, print_head, print_row, read_json, run_recon

from recon_cli.io.colmap import read_images
from recon_cli.workspace.records import read_frame_list

DRIFT_METRES, DRIFT_DEG = 0.02, 1.0  # at the end of the walk
SMALL = (48, 27)  # pixels, at which pictures are compared
# Both cameras of a headset or a rig show what one saw; frames of a video follow each other.
WRITERS = {"quest": functools.partial(quest, eyes=("left",)),
           "colmap rig": functools.partial(rig, baseline=0.0),
           "stray": functools.partial(stray, between=1)}


def drift(taken: list[Shot], seed: int) -> list[Shot]:
    """Returns shots whose poses drift smoothly away."""
    rng = np.random.default_rng(seed)

    def walk(end: float) -> NDArray[np.float64]:
        path = np.cumsum(gaussian_filter1d(rng.normal(size=(len(taken), 3)), 5, axis=0), axis=0)
        path -= path[0]
        return np.asarray(path * end / np.linalg.norm(path[-1]))

    shifts, turns = walk(DRIFT_METRES), Rotation.from_rotvec(np.radians(walk(DRIFT_DEG)))
    drifted = []
    for shot, shift, turn in zip(taken, shifts, turns.as_matrix(), strict=True):
        pose = shot.c2w.copy()
        pose[:3, :3] = turn @ pose[:3, :3]
        pose[:3, 3] += shift
        drifted.append(dataclasses.replace(shot, c2w=pose))
    return drifted


def small(picture: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Returns a picture in few pixels."""
    return np.asarray(cv2.resize(picture, SMALL, interpolation=cv2.INTER_AREA), np.float64)


def match_shots(ingest: Path, taken: list[Shot]) -> dict[str, int]:
    """Returns the number of the shot that each frame shows."""
    seen = np.stack([small(shot.rgb) for shot in taken])
    found = {}
    for frame in read_frame_list(ingest).frames:
        picture = small(np.asarray(Image.open(ingest / "frames" / frame.name)))
        found[frame.name] = int(np.abs(seen - picture).mean(axis=(1, 2, 3)).argmin())
    return found


def score(workspace: Path, taken: list[Shot], metric: bool) -> dict[str, Any]:
    """Returns the figures of a row."""
    which = match_shots(workspace / "ingest", taken)
    found = {name: np.linalg.inv(viewmat) for name, _, viewmat in read_images(
        workspace / "place" / "sparse" / "images.bin")}
    ours = np.stack(list(found.values()))
    truth = np.stack([taken[which[name]].c2w for name in found])
    scale, _ = similarity(ours[:, :3, 3], truth[:, :3, 3])
    # A walk may be nearly straight, so the turn is that of the axes.
    turn = Rotation.from_matrix(truth[:, :3, :3] @ ours[:, :3, :3].transpose(0, 2, 1)).mean()
    own = scale if not metric else 1.0
    apart = own * turn.apply(ours[:, :3, 3]) - truth[:, :3, 3]
    off = np.linalg.norm(apart - apart.mean(axis=0), axis=1)
    turns = Rotation.from_matrix(
        (turn.as_matrix() @ ours[:, :3, :3]).transpose(0, 2, 1) @ truth[:, :3, :3]).magnitude()
    world = read_json(workspace / "place" / "world.json")["evidence"]
    up = turn.apply([0.0, 0.0, 1.0])
    return {"frames": len(found), "of": len(which), "scale": scale - 1, "rmse": float(
        np.sqrt((off**2).mean())), "turn": float(np.degrees(turns.max())),
        "up": float(np.degrees(np.arccos(min(1.0, up[2])))), **world}


@click.command()
@click.argument("data", type=FOLDER)
@click.option("--room", default="office")
@click.option("--count", default=40, help="Frames.")
@click.option("--step", default=2, help="Frames of the room from one to the next.")
@click.option("--layout", "layouts", multiple=True, type=click.Choice(list(APPS)))
@click.option("--scratch", type=click.Path(path_type=Path), help="Keeps the workspaces there.")
@click.option("--exact", is_flag=True, help="No drift.")
def main(data: Path, room: str, count: int, step: int, layouts: tuple[str, ...],
         scratch: Path | None, exact: bool) -> None:
    """Prints a row for each layout."""
    print_head("layout", "poses", "frames", "scale off", "interval", "centres", "rotation", "up",
               "CPU of sfm")
    with tempfile.TemporaryDirectory() as temporary:
        home = scratch or Path(temporary)
        for name in layouts or APPS:
            app = APPS[name]
            taken = shots(data / room, count, step, factor=1, moving=app.own)
            folder, workspace = home / f"{name} capture", home / name
            for old in (folder, workspace):
                shutil.rmtree(old, ignore_errors=True)
            folder.mkdir(parents=True)
            tracked = app.accuracy == "tracked" and not exact
            WRITERS.get(name, app.write)(folder, drift(taken, 0) if tracked else taken)
            read = run_recon(workspace, "ingest", str(folder), "--quiet")
            done = read if read.code else run_recon(workspace, "sfm", "--quiet")
            shutil.rmtree(folder)
            if done.code:
                print_row(name, "drift" if tracked else "exact", done.error)
                continue
            row = score(workspace, taken, app.metric)
            error = row.get("scale_error")  # none of an arbitrary scale
            print_row(
                name, "drift" if tracked else "exact", f"{row['frames']} of {row['of']}",
                f"{row['scale']:+.2%}" if row["metres"] else row["scale_source"],
                "-" if error is None else f"{1.96 * error:.2%}", f"{100 * row['rmse']:.3f} cm",
                f"{row['turn']:.3f} deg", f"{row['up']:.2f} deg", f"{done.cpu_seconds:.0f} s")


if __name__ == "__main__":
    main()
