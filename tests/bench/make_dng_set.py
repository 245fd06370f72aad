"""Camera RAW of known exposures from photos: `python tests/bench/make_dng_set.py PHOTOS OUT`.

Every photo becomes a DNG as a camera with a mosaic would have written it, exposed up to one stop
longer or shorter by time, ISO or f-number, with the white balance off by up to 5 %. What `recon`
should take back stands in OUT/truth.json, in EV by the name of the file. With --check, OUT is
developed again and compared with the photos: how far brightness ranges over the set.
"""

from __future__ import annotations

import json
import sys
from fractions import Fraction
from pathlib import Path

import click
import cv2
import numpy as np
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "capture"))
from dng import RESPONSE, Shot, linear, write_shot

from recon_cli.capture.images import Photo, inspect_photo, read_photo
from recon_cli.capture.photos import list_photos
from recon_cli.capture.raw import develop, plan_raw

TRUTH = "truth.json"
FILM = 0xA405  # EXIF: 35 mm equivalent of the focal length
STOPS = (-1.0, -0.5, 0.0, 0.5, 1.0)


def film_equivalent(photo: Photo) -> int:
    """The 35 mm equivalent that the photo's EXIF gives, 0 where it gives none."""
    with Image.open(photo.path) as image:
        return int(image.getexif().get_ifd(0x8769).get(FILM, 0))


def shot(ev: float, draws: np.random.Generator, focal_35mm: int) -> Shot:
    """A shot that collects 2^ev times what 1/60 s at ISO 100 and f/2 do."""
    iso, f_number = int(draws.choice([50, 100, 200])), Fraction(int(draws.choice([14, 20, 28])), 10)
    seconds = 2.0**ev / 60 * 100 / iso * float(f_number) ** 2 / 4
    warm = draws.uniform(0.95, 1.05, 2)
    return Shot(
        seconds=Fraction(seconds).limit_denominator(1_000_000), iso=iso, f_number=f_number,
        neutral=(RESPONSE[0] * warm[0], 1.0, RESPONSE[2] * warm[1]), focal_35mm=focal_35mm)


def make(photos: list[Photo], out: Path, white: float, size: int, seed: int) -> None:
    """Writes the set and its truth."""
    draws, truth = np.random.default_rng(seed), {}
    for photo in photos:
        rgb = read_photo(photo)
        scale = min(1.0, size / max(rgb.shape[:2]))
        rgb = cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        ev = float(draws.choice(STOPS))
        light = linear(rgb) * white * 2.0**ev
        path = out / f"{photo.path.stem}.dng"
        write_shot(path, light, shot(ev, draws, film_equivalent(photo)))
        truth[path.name] = ev
    (out / TRUTH).write_text(json.dumps(truth, indent=1))


def check(photos: list[Photo], out: Path) -> None:
    """Prints how well the set matches the photos after development."""
    paths = [out / f"{photo.path.stem}.dng" for photo in photos]
    plan, factors = plan_raw({path.name: path for path in paths}), []
    for photo, path in zip(photos, paths, strict=True):
        found = linear(develop(inspect_photo(path), plan))
        height, width = found.shape[:2]
        truth = linear(cv2.resize(read_photo(photo), (width, height), interpolation=cv2.INTER_AREA))
        usable = (found.max(axis=2) < 0.8) & (truth.min(axis=2) > 0.01) & (found.min(axis=2) > 0.01)
        factors.append(np.median(found[usable] / truth[usable], axis=0))
    bright = np.array(factors)
    for name, values in zip(("red", "green", "blue"), bright.T, strict=True):
        ratio = values / np.median(values) - 1
        click.echo(f"{name}: {100 * ratio.std():.2f} % standard deviation, "
                   f"{100 * ratio.min():+.2f} to {100 * ratio.max():+.2f} % of the median")


@click.command(help=__doc__)
@click.argument("photos", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.argument("out", type=click.Path(file_okay=False, path_type=Path))
@click.option("--white", default=0.7, help="Where a white pixel lies, as a share of saturation.")
@click.option("--size", default=10_000, help="Longest side in pixels.")
@click.option("--limit", type=int, help="So many photos at most.")
@click.option("--seed", default=0)
@click.option("--check", "checks", is_flag=True, help="Develop the set and compare.")
def main(
    photos: Path, out: Path, white: float, size: int, limit: int | None, seed: int, checks: bool
) -> None:
    """See the module."""
    taken = list(list_photos(photos.iterdir()).photos)[:limit]
    out.mkdir(parents=True, exist_ok=True)
    make(taken, out, white, size, seed)
    click.echo(f"{len(taken)} photos in {out}")
    if checks:
        check(taken, out)


if __name__ == "__main__":
    main()
