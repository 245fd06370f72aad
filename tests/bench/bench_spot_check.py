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
from workbench import mapping_job, workspace_argument

from recon_cli.sfm.poses import known_poses
from recon_cli.workspace.records import POSES, read_poses

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
@workspace_argument
def main(workspace: Path) -> None:
    """Prints a line for each way."""
    ingest = workspace / "ingest"
    with tempfile.TemporaryDirectory() as out:
        job = mapping_job(
            ingest, Path(out), poses=ingest / POSES, pose_use="keep", given_points=True,
            partial=True, gravity=True, max_minutes=5.0, threads=2)
        for label, viewmats in spoilt(dict(read_poses(ingest / POSES).viewmats)).items():
            check = known_poses.spot_check(job, viewmats)
            share = "too few to tell" if check.share is None else f"{check.share:.3f}"
            click.echo(f"{label:<24} {check.matches:>6} matches, share {share}")


if __name__ == "__main__":
    main()
