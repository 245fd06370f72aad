"""Does a join of segments see that one of them is broken?

    python tests/bench/bench_join_breaks.py SFM...

Each SFM is an unfinished folder of sfm, `.partial/sfm` of a workspace whose `recon sfm` was stopped
while it joined segments. For every two neighbours the frames in common are judged as they are, and
with the second segment broken in them: from a frame a third, a half or two thirds into them on, its
cameras and points are scaled or turned about that frame's camera, as where a walk was mapped badly.
Printed is how many are accepted by the points and cameras of common frames, and the shares and
offsets of nine of ten cameras, least, middle and most.
"""

from __future__ import annotations

import itertools
import zlib  # noqa: F401 - before pycolmap, which brings a zlib of its own
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import click
import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from workbench import FOLDER

from recon_cli.sfm.limits import MAX_POINT_ERROR
from recon_cli.sfm.segments.join_segments import MODEL_FOLDER
from recon_cli.sfm.segments.segment_joins import (
    camera_residuals,
    judge_join,
)
from recon_cli.sfm.segments.shared_points import (
    Segment,
    SegmentCameras,
    SharedPoints,
    describe_segment,
)

BREAKS = {"as it is": (1.0, 0.0), "x 0.8": (0.8, 0.0), "x 0.9": (0.9, 0.0), "x 1.1": (1.1, 0.0),
          "x 1.25": (1.25, 0.0), "x 1.5": (1.5, 0.0), "5 degrees": (1.0, 5.0),
          "10 degrees": (1.0, 10.0), "20 degrees": (1.0, 20.0)}
PLACES = (0.3, 0.5, 0.7)

Array = NDArray[np.float64]


def common_points(first: Segment, second: Segment) -> SharedPoints:
    """Returns the points of the common frames of two segments: keypoints at the same place."""
    pairs, ours, theirs, counts = [], [], [], []
    for name in sorted(first.shown.keys() & second.shown.keys()):
        one, other = first.shown[name], second.shown[name]
        spots = [np.round(shown.xy * 16).astype(np.int64) @ [1 << 32, 1] for shown in (one, other)]
        _, left, right = np.intersect1d(*spots, return_indices=True)
        pairs.append((name, name))
        ours.append(one.points[left])
        theirs.append(other.points[right])
        counts.append(len(left))
    return SharedPoints(first.index, second.index, np.concatenate(ours), np.concatenate(theirs),
                        np.repeat(np.arange(len(pairs)), counts), tuple(pairs))


def break_segment(
    shared: SharedPoints, cameras: SegmentCameras, name: str, scale: float, degrees: float
) -> tuple[SharedPoints, SegmentCameras]:
    """Returns points and cameras of a segment that is scaled and turned from a frame on."""
    middle = cameras.centers[cameras.names.index(name)]
    turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()

    def moved(points: Array, after: NDArray[np.bool_]) -> Array:
        return np.where(after[:, None], middle + scale * (points - middle) @ turn.T, points)

    later = np.array(cameras.names) > name
    frames = np.array([pair[0] for pair in shared.pairs]) > name
    return (replace(shared, theirs=moved(shared.theirs, frames[shared.pair])),
            replace(cameras, centers=moved(cameras.centers, later), rotations=np.where(
                later[:, None, None], cameras.rotations @ turn.T, cameras.rotations)))


@click.command()
@click.argument("folders", nargs=-1, required=True, type=FOLDER)
def main(folders: Sequence[Path]) -> None:
    """Print a row for each kind of break."""
    rows: dict[str, list[tuple[float, ...]]] = defaultdict(list)
    for folder in folders:
        paths = sorted((folder / "segments").iterdir(), key=lambda path: int(path.name))
        segments = [describe_segment(int(path.name), pycolmap.Reconstruction(path / MODEL_FOLDER))
                    for path in paths if (path / MODEL_FOLDER / "images.bin").exists()]
        for first, second in itertools.pairwise(segments):
            if not first.shown.keys() & second.shown.keys():
                continue
            shared = common_points(first, second)
            for name, (scale, degrees) in BREAKS.items():
                for place in PLACES if name != "as it is" else PLACES[:1]:
                    frame = shared.pairs[int(place * len(shared.pairs))][0]
                    points, cameras = break_segment(shared, second.cameras, frame, scale, degrees)
                    join = judge_join(points, first.cameras, cameras, seed=0)
                    if join.motion is None:
                        rows[name].append((0.0, 0.0, np.inf, np.inf))
                        continue
                    off = np.linalg.norm(join.motion.points(points.ours) - points.theirs, axis=1)
                    rows[name].append((
                        float(join.holds), float((off <= MAX_POINT_ERROR * cameras.depth).mean()),
                        *camera_residuals(join.motion, first.cameras, cameras)))
    click.echo("| second segment | joins | accepted | points that agree | cameras off | degrees |\n"
               "|---|---:|---:|---:|---:|---:|")
    for name, values in rows.items():
        table = np.array(values)
        least, middle, most = np.quantile(table[:, 1:], (0, 0.5, 1), axis=0)
        click.echo(f"| {name} | {len(table)} | {table[:, 0].mean():.0%} | " + " | ".join(
            f"{low:{form}} / {mid:{form}} / {high:{form}}" for low, mid, high, form in zip(
                least, middle, most, (".0%", ".1%", ".1f"), strict=True)) + " |")


if __name__ == "__main__":
    main()
