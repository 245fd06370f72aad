"""What the verdict says of models, and how long it takes: `python tests/bench/bench_weak_link.py`.

Takes folders with a database.db and a sparse/ (the folder of a finished sfm stage is one) and
prints a line for each: cameras, reprojection error, share of the weakest link, least overlap,
cameras astray, whether it is trusted, and the CPU seconds of one examination. With --reference (a
transforms.json, or a traj.txt with a 4x4 camera-to-world pose a line, line k for frame k) also how
many cameras are displaced by more than a twentieth of the extent, and the largest displacement,
after the similarity that fits most cameras. --images N adds a walk made in closed form, matched
exhaustively, for its seconds.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import click
import numpy as np
import pycolmap
from numpy.typing import NDArray

from recon_cli.sfm.verdict import ModelVerdict, examine

sys.path += [str(Path(__file__).parents[1] / "sfm"), str(Path(__file__).parent)]
from made_model import MadeModel, along, wall
from pose_errors import similarity

NEAR = 0.05  # of the extent: a camera further off is displaced
TRIALS = 2000  # samples of four cameras; with half of them right, one in 16 is good
HEADS = ("model", "cameras", "error px", "weak link", "overlap", "astray", "trusted", "CPU s",
         "displaced", "farthest")


def displaced(found: NDArray[np.float64], truth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance of each centre from the truth as a share of the extent, [F]; both [F, 3]."""
    extent = float(np.linalg.norm(np.ptp(truth, axis=0)))
    generator = np.random.default_rng(0)
    best = np.full(len(found), np.inf)
    for _ in range(TRIALS):
        some = generator.choice(len(found), 4, replace=False)
        scale, motion = similarity(found[some], truth[some])
        placed = scale * found @ motion[:3, :3].T + motion[:3, 3]
        off = np.linalg.norm(placed - truth, axis=1) / extent
        if np.minimum(off, NEAR).sum() < np.minimum(best, NEAR).sum():
            best = off
    return best


def centers(reference: Path) -> dict[str, NDArray[np.float64]]:
    """True camera centres by the stem of the image's name."""
    if reference.suffix == ".json":
        frames = json.loads(reference.read_text())["frames"]
        return {Path(frame["file_path"]).stem: np.array(frame["transform_matrix"])[:3, 3]
                for frame in frames}
    poses = np.loadtxt(reference).reshape(-1, 4, 4)
    return {f"{index:06d}": pose[:3, 3] for index, pose in enumerate(poses)}


def row(name: str, model: pycolmap.Reconstruction, database: Path, reference: Path | None
        ) -> list[str]:
    """The cells of one line of the table."""
    with pycolmap.Database.open(database) as opened:
        names = sorted(image.name for image in opened.read_all_images())
    start = time.process_time()
    verdict = examine(model, database, names)
    seconds = time.process_time() - start
    cells = [
        name, f"{verdict.registered}/{verdict.images}",
        f"{model.compute_mean_reprojection_error():.2f}", *shares(verdict),
        str(len(verdict.outliers)), "yes" if verdict.trusted else "no", f"{seconds:.2f}"]
    if reference is not None:
        known = centers(reference)
        images = [model.image(i) for i in model.reg_image_ids()]
        pairs = [(image.projection_center(), known[Path(image.name).stem]) for image in images
                 if Path(image.name).stem in known]
        off = displaced(*map(np.array, zip(*pairs, strict=True)))
        cells += [f"{np.count_nonzero(off > NEAR)}", f"{off.max():.1%}"]
    return cells


def shares(verdict: ModelVerdict) -> Iterator[str]:
    """The two shares, or a dash where they cannot be told."""
    for share in (verdict.weakest_cut.share, verdict.aliasing.share):
        yield "-" if share is None else f"{share:.3f}"


def made(count: int, folder: Path) -> list[str]:
    """The line of a walk of `count` cameras in closed form."""
    walk = MadeModel(wall(-4, 4 + count * 0.1, count=60 * count), along(np.arange(count) * 0.1))
    return row(f"made walk of {count}", walk.model(), walk.write_database(folder / "db"), None)


@click.command()
@click.argument("models", nargs=-1, type=click.Path(exists=True, path_type=Path))
@click.option("--reference", type=click.Path(exists=True, path_type=Path), help="True poses.")
@click.option("--images", type=int, help="Also a made walk of so many images.")
def main(models: tuple[Path, ...], reference: Path | None, images: int | None) -> None:
    """Prints the table."""
    rows = [list(HEADS)]
    rows += [
        row(path.name, pycolmap.Reconstruction(path / "sparse"), path / "database.db", reference)
        for path in models]
    if images is not None:
        with tempfile.TemporaryDirectory() as folder:
            rows.append(made(images, Path(folder)))
    for cells in rows:
        click.echo("  ".join(f"{cell:<12}" for cell in cells).rstrip())


if __name__ == "__main__":
    main()
