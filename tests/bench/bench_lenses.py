"""Camera models compared: `python tests/bench/bench_lenses.py SFM...`, folders of `recon sfm`.

First the matches of the database that a fisheye and an ordinary lens without distortion explain,
by which sfm chooses between the two. Then the error in pixels of observations that an adjustment
did not see, with each camera model in place of that of the finished model: every second point of
four or more images loses one.
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import click
import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.optimize import least_squares

from recon_cli.sfm import mapper, wide_lens
from recon_cli.sfm.job import CameraGroup, MappingJob

MODELS = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV")
WRONG_PX = 4.0  # from which on an observation is wrong, and its error counts no more


def convert(camera: pycolmap.Camera, name: str) -> pycolmap.Camera:
    """Returns the camera of a model that is nearest to another one, on a grid of pixels."""
    across, down = np.meshgrid(
        np.linspace(0.02, 0.98, 15) * camera.width, np.linspace(0.02, 0.98, 15) * camera.height)
    pixels = np.stack([across.ravel(), down.ravel()], axis=1)
    rays = np.column_stack([camera.cam_from_img(pixels), np.ones(len(pixels))])
    found = pycolmap.Camera.create_from_model_name(
        camera.camera_id, name, camera.mean_focal_length(), camera.width, camera.height)

    def misses(params: NDArray[np.float64]) -> NDArray[np.float64]:
        found.params = params
        return np.asarray(found.img_from_cam(rays) - pixels).ravel()

    start = np.array(found.params)
    found.params = least_squares(
        misses, start, x_scale=np.maximum(np.abs(start), 0.1), max_nfev=60).x
    return found


def held_out_error(model: pycolmap.Reconstruction, name: str) -> tuple[int, float]:
    """Returns how many observations were held out, and their error (root mean square, pixels)."""
    fitted = pycolmap.Reconstruction(model)
    held = []
    for number, point in sorted(fitted.points3D.items()):
        elements = list(point.track.elements)
        if number % 2 == 0 and len(elements) >= 4:
            element = elements[number % len(elements)]
            held.append((element.image_id, element.point2D_idx, number))
    places = [np.array(fitted.image(image).points2D[row].xy) for image, row, _ in held]
    for image, row, _ in held:
        fitted.delete_observation(image, row)
    for camera in list(fitted.cameras.values()):
        if camera.model_name != name:
            other = convert(camera, name)
            camera.model, camera.params = other.model, other.params
    mapper.adjust(fitted)
    errors = []
    for (image, _, number), place in zip(held, places, strict=True):
        if number in fitted.points3D:
            seen = fitted.image(image)
            local = seen.cam_from_world() * fitted.point3D(number).xyz
            errors.append(np.linalg.norm(seen.camera.img_from_cam(local[None])[0] - place))
    return len(errors), float(np.sqrt(np.mean(np.minimum(errors, WRONG_PX) ** 2)))


def explained(database: Path) -> str:
    """Returns how many matches each kind of lens explains."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "database.db"
        shutil.copyfile(database, copy)
        samples = wide_lens._read_samples(cast(
            MappingJob, SimpleNamespace(database=copy)))
        with pycolmap.Database.open(copy) as opened:
            cameras = {number: opened.read_camera(number) for number in samples}
    lines = []
    for number, pairs in sorted(samples.items()):
        group = CameraGroup((), cameras[number].width, cameras[number].height)
        side = max(group.width, group.height)
        counts = {model: max(sum(wide_lens.count_explained(
            wide_lens._camera(group, model, share * side), pair, seed=0) for pair in pairs)
            for share in shares) for model, shares in (
                (wide_lens.FISHEYE, wide_lens.FOCALS),
                (wide_lens.ORDINARY, wide_lens.ORDINARY_FOCALS))}
        fisheye, ordinary = counts.values()
        lines.append(f"camera {number}: fisheye {fisheye}, ordinary {ordinary}, "
                     f"ratio {fisheye / max(1, ordinary):.3f}")
    return "\n".join(lines)


@click.command(help=__doc__)
@click.argument("folders", nargs=-1, required=True, type=click.Path(path_type=Path))
def main(folders: tuple[Path, ...]) -> None:
    pycolmap.logging.minloglevel = pycolmap.logging.Level.WARNING
    for folder in folders:
        click.echo(f"{folder}\n{explained(folder / 'database.db')}")
        model: Any = pycolmap.Reconstruction(folder / "sparse")
        for name in MODELS:
            count, error = held_out_error(model, name)
            click.echo(f"{name:15} {error:.4f} px of {count:,} observations")


if __name__ == "__main__":
    main()
