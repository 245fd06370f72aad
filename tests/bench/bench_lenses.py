"""Camera models compared: `python tests/bench/bench_lenses.py SFM...`, folders of `recon sfm`, or
of a COLMAP model alone.

A row a camera: the error in pixels of points that an adjustment did not see, with each camera model
A row a camera: the error in pixels of points that an adjustment did not see, with each camera model
in place of that of the finished model (`sfm.mapping.lens_trial`), and the share of the error that
shares of those that an ordinary lens without distortion does, where there is a database: by that
sfm chooses between the two before it maps.
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import click
import pycolmap
from workbench import print_head, print_row

from recon_cli.sfm.job import CameraGroup, MappingJob
from recon_cli.sfm.mapping import lens_trial, wide_lens

MODELS = (*lens_trial.MODELS, "FULL_OPENCV")
REFERENCE = "OPENCV"


def compare(model: pycolmap.Reconstruction) -> dict[int, list[str]]:
    """Returns the cells of the table of each camera: a reference, then gains and the verdict."""
    part = lens_trial._middle(model)
    cameras = sorted(part.cameras)
    errors = {name: lens_trial.try_lens(part, cameras, name) for name in MODELS}
    better = {lens.camera: lens for lens in lens_trial.find_better_lenses(model, cameras)}
    rows = {}
    for number in cameras:
        reference = errors[REFERENCE][number]
        if len(reference) < lens_trial.LEAST_IMAGES:
            continue
        cells = [f"{lens_trial.root(reference):.3f}"]
        for name in MODELS:
            if name != REFERENCE:
                gain, noise = lens_trial.gain_over(errors[name][number], reference)
                cells.append(f"{gain:+.2%} ± {noise:.2%}")
        found = better.get(number)
        rows[number] = [*cells, f"{found.better}, {found.gain:.0%}" if found else ""]
    return rows


def explained(database: Path) -> dict[int, str]:
    """Returns the share of matches that a fisheye explains, by camera."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "database.db"
        shutil.copyfile(database, copy)
        samples = wide_lens._read_samples(cast(MappingJob, SimpleNamespace(database=copy)))
        with pycolmap.Database.open(copy) as opened:
            cameras = {number: opened.read_camera(number) for number in samples}
    shares = {}
    for number, pairs in sorted(samples.items()):
        group = CameraGroup((), cameras[number].width, cameras[number].height)
        side = max(group.width, group.height)
        fisheye, ordinary = (max(sum(wide_lens.count_explained(
            wide_lens._camera(group, model, share * side), pair, seed=0) for pair in pairs)
            for share in focals) for model, focals in (
                (wide_lens.FISHEYE, wide_lens.FOCALS),
                (wide_lens.ORDINARY, wide_lens.ORDINARY_FOCALS)))
        shares[number] = f"{fisheye / max(1, ordinary):.3f}"
    return shares


@click.command(help=__doc__)
@click.argument("folders", nargs=-1, required=True, type=click.Path(path_type=Path))
def main(folders: tuple[Path, ...]) -> None:
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR
    print_head("camera", "mapped as", "images", f"{REFERENCE}, px", *(
        name for name in MODELS if name != REFERENCE), "better", "matches")
    for folder in folders:
        sparse = folder / "sparse" if (folder / "sparse").is_dir() else folder
        model = pycolmap.Reconstruction(sparse)
        database = folder / "database.db"
        shares = explained(database) if database.exists() else {}
        for number, cells in compare(model).items():
            print_row(f"{folder} {number}", model.camera(number).model_name,
                      str(model.num_reg_images()), *cells, shares.get(number, ""))


if __name__ == "__main__":
    main()
