"""Names for the images of a COLMAP model whose file of names is missing, proved by colour.

COLMAP numbers images from 1 in the order of their names, so the n-th file is image n when no number
is left out. That is a guess until the points, seen by the pose of an image, have the colours that
its file has there, and other poses do not fit as well.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import FormatError
from recon_cli.io.colmap_model import Model
from recon_cli.io.listed import SUFFIXES
from recon_cli.scene.lens import MODELS, Lens

_CHECKED = 5  # images, evenly spread
_POINTS = 5000  # of the model, evenly spread; seen by one view about a tenth of them
# Over 70 photos of a desk the right pose is off by 21 to 40 of 255, the best wrong one by 39 to 77,
# and never is the right one off by more than 0.82 of the best wrong one.
_BETTER = 0.9


def named_in_order(
    model: Model, candidates: Iterable[Path], model_at: Path
) -> tuple[list[tuple[str, int, NDArray[np.float64]]], Path]:
    """Returns (name, camera id, world to camera) of each image, and the folder of the images.

    Raises:
        FormatError: the images are not as many as the poses, or their colours speak against it.
    """
    ids = list(model.unnamed)
    for place in candidates:
        names = _image_names(place)
        if names and ids == list(range(1, len(names) + 1)) and _colors_agree(model, place, names):
            return [(name, *model.unnamed[at]) for at, name in enumerate(names, 1)], place
    raise FormatError(
        f"{model_at} lacks images.bin or images.txt, which hold the names of its {len(ids)} "
        "images, and no folder has these images in their order.",
        hint="Copy that file too; without it poses and images cannot be told to belong together.")


def _image_names(folder: Path) -> list[str]:
    if not folder.is_dir():
        return []
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*")
                  if path.suffix in SUFFIXES and path.is_file())


def _colors_agree(model: Model, folder: Path, names: list[str]) -> bool:
    """Returns whether most of the checked images fit their own pose better than any other."""
    poses = list(model.unnamed.values())
    step = max(1, len(model.points) // _POINTS)
    points, colors = model.points[::step], model.colors[::step].astype(np.float64)
    right = 0
    checked = sorted({int((at + 0.5) * len(names) / _CHECKED) for at in range(_CHECKED)})
    for index in checked:
        pixels = cv2.imread(
            str(folder / names[index]), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        if pixels is None:
            continue
        rgb = pixels[:, :, ::-1].astype(np.float64)
        off = [_difference(rgb, model.lenses[camera], viewmat, points, colors)
               for camera, viewmat in poses]
        own = off.pop(index)
        right += own < _BETTER * min(off, default=0.0)
    return right > len(checked) / 2


def _difference(
    rgb: NDArray[np.float64],
    lens: Lens,
    viewmat: NDArray[np.float64],
    points: NDArray[np.float64],
    colors: NDArray[np.float64],
) -> float:
    """Returns the median difference of points to the pixels where a pose puts them.

    Distortion is left out, so only the middle of the image counts, where it moves little.
    """
    height, width = rgb.shape[:2]
    fitted = lens.resized(width, height)
    focals, _ = MODELS[lens.model]
    focal = np.array([fitted.params[0], fitted.params[focals - 1]])
    camera = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    ahead = camera[:, 2] > 0
    at = camera[ahead, :2] / camera[ahead, 2:] * focal + fitted.params[focals:focals + 2]
    x, y = at.T
    middle = (np.abs(x - width / 2) < width / 4) & (np.abs(y - height / 2) < height / 4)
    if not middle.any():
        return 255.0
    seen = rgb[y[middle].astype(int), x[middle].astype(int)]
    return float(np.median(np.abs(seen - colors[ahead][middle]).max(axis=1)))
