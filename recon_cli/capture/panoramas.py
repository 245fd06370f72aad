"""360-degree panoramas among photos: told by their metadata, or by their content.

A panorama is not taken by a pinhole camera: treated as such it gives wrong cameras or none.
"""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from contextlib import suppress

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from recon_cli.capture.images import BROKEN, Photo, open_image
from recon_cli.errors import InputError

_SMALL = (256, 128)
_CHECKED = 8  # panoramas of a set, evenly spread
# In panoramas the edge columns are neighbours: they differ as neighbours do, while columns half a
# turn apart differ by 4 to 40 times as much. The top or the bottom row is one point. 14 of 19 and
# 60 of 60 panoramas pass both, and 1 of 446 photos of rooms that were cut to 2:1.
_SEAM, _OPPOSITE, _POLE = 3.0, 3.0, 0.5
_LEAST, _SHARE = 3, 0.5  # of the checked pictures must pass where no metadata says it


def find_panoramas(photos: Sequence[Photo]) -> list[Photo]:
    """Returns which photos are panoramas: by metadata, else where those of 2:1 wrap around."""
    told = [photo for photo in photos if photo.panorama]
    wide = [photo for photo in photos
            if not photo.panorama and not photo.is_raw and photo.width == 2 * photo.height]
    if len(wide) < _LEAST:
        return told
    checked = [wide[int((at + 0.5) * len(wide) / _CHECKED)] for at in range(_CHECKED)]
    pictures = [small for photo in dict.fromkeys(checked)
                if (small := _read_small(photo)) is not None]
    if sum(map(wraps_around, pictures)) >= max(_LEAST, _SHARE * len(pictures)):
        return [photo for photo in photos if photo in told or photo in wide]
    return told


def wraps_around(rgb: NDArray[np.uint8]) -> bool:
    """Returns whether a picture [H, 2 H, 3] ends where it begins and has a pole, as panoramas."""
    small = cv2.resize(rgb, _SMALL, interpolation=cv2.INTER_AREA).astype(np.float64)
    seam = np.abs(small[:, 0] - small[:, -1]).mean()
    steps = np.abs(np.diff(small, axis=1)).mean(axis=(0, 2))
    opposite = np.abs(small - np.roll(small, _SMALL[0] // 2, axis=1)).mean()
    spread = small.std(axis=1).mean(axis=1)  # of each row
    pole = min(spread[0], spread[-1]) <= _POLE * np.median(spread)
    return bool(pole and seam <= _SEAM * np.median(steps) and _OPPOSITE * seam < opposite)


def _read_small(photo: Photo) -> NDArray[np.uint8] | None:
    """Returns a photo at a fraction of its size; None where it cannot be read."""
    with suppress(*BROKEN), open_image(photo.path) as image:
        image.draft("RGB", (2 * _SMALL[0], 2 * _SMALL[1]))
        return np.asarray(image.convert("RGB").resize(
            (2 * _SMALL[0], 2 * _SMALL[1]), Image.Resampling.BOX))
    return None


def panorama_error(name: str, panoramas: Sequence[Photo], count: int) -> InputError:
    """Returns the error for a capture that is, but for a few pictures, panoramas."""
    return InputError(
        f"{len(panoramas)} of the {count} pictures in {name} are 360-degree panoramas "
        f"(equirectangular), such as {panoramas[0].name}; needed are pictures of ordinary lenses.",
        hint=panorama_advice(panoramas[0]))


def panorama_advice(photo: Photo) -> str:
    """Returns the command that cuts panoramas like this one into pictures that can be used."""
    return (
        "Cut each into six pictures of 90 degrees, and give the folder of these: mkdir -p faces; "
        f"for f in {shlex.quote(str(photo.path.parent))}/*{photo.path.suffix}; do "
        'for y in -120 -60 0 60 120 180; do ffmpeg -i "$f" -vf '
        f"v360=e:flat:yaw=$y:h_fov=90:v_fov=90:w={photo.width // 4}:h={photo.width // 4} "
        '"faces/$(basename "$f")_$y.png"; done; done; recon ingest faces')
