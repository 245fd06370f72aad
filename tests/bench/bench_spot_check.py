"""What the check of kept poses says of right and wrong ones.

`python tests/bench/bench_spot_check.py WORKSPACE`, after `recon ingest` of a data set with poses
and known lenses: the share of the matches that agree with the poses as they are, with axes flipped,
the matrices inverted, and the names moved on by four or shuffled.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray

from recon_cli.sfm import known_poses
from recon_cli.sfm.job import CameraGroup, MappingJob
from recon_cli.workspace.records import FOLDER, POSES, read_frame_list, read_poses

Poses = dict[str, NDArray[np.float64]]  # [4, 4] world to camera by name


def spoilt(viewmats: Poses) -> dict[str, Poses]:
    """Returns the poses as they are and in every wrong way."""
    names = sorted(viewmats)
    flips = {"y and z flipped": [1, -1, -1, 1], "x and z flipped": [-1, 1, -1, 1],
             "x and y flipped": [-1, -1, 1, 1]}
    orders = {"names moved on by four": np.roll(np.arange(len(names)), -4),
              "names shuffled": np.random.default_rng(0).permutation(len(names))}
    return {
        "as they are": viewmats,
        **{label: {name: np.diag(np.array(flip, float)) @ viewmats[name] for name in names}
           for label, flip in flips.items()},
        "inverted": {name: np.linalg.inv(viewmats[name]) for name in names},
        **{label: {name: viewmats[names[place]] for name, place in zip(names, order, strict=True)}
           for label, order in orders.items()},
    }


@click.command()
@click.argument("workspace", type=click.Path(exists=True, path_type=Path))
def main(workspace: Path) -> None:
    """Prints a line for each way."""
    ingest = workspace / "ingest"
    frames = read_frame_list(ingest)
    groups = tuple(
        CameraGroup(tuple(frame.name for frame in frames.frames if frame.group == index),
                    group.width, group.height, group.focal_px, group.lens)
        for index, group in enumerate(frames.groups))
    with tempfile.TemporaryDirectory() as out:
        job = MappingJob(
            frames=ingest / FOLDER, denoised=ingest / FOLDER, out=Path(out), groups=groups,
            masks=None, poses=ingest / POSES, pose_use="keep", given_points=True, pairs="auto",
            max_features=3000, min_registered=0.5, accept_weak=False, partial=True, gravity=True,
            scale_between=None, max_minutes=5.0, seed=0, threads=2, sharpness={}, times={})
        for label, viewmats in spoilt(dict(read_poses(ingest / POSES).viewmats)).items():
            check = known_poses.spot_check(job, viewmats)
            share = "too few to tell" if check.share is None else f"{check.share:.3f}"
            click.echo(f"{label:<24} {check.matches:>6} matches, share {share}")


if __name__ == "__main__":
    main()
