"""COLMAP data sets: a model with its images, in the folder layouts of the usual programs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import FormatError, InputError
from recon_cli.io.colmap_model import Model, NamedImage, model_suffix, read_model
from recon_cli.io.images import decode_file
from recon_cli.io.posed import SUFFIXES, PosedImage, PosedSet, find_images, is_file, resolve_inside
from recon_cli.scene.camera import MODELS, Lens

_CHECKED = 5  # images, evenly spread
_POINTS = 5000  # of the model, evenly spread; a view shows about a tenth of them
# Over 70 photos of a desk the right pose is never off by more than 0.82 of the best wrong one.
_BETTER = 0.9


def _match_names_by_order(
    model: Model, candidates: Iterable[Path], model_at: Path
) -> tuple[list[NamedImage], Path]:
    """Returns (name, camera id, world to camera) of each image, and the folder of the images."""
    ids = list(model.unnamed)
    for place in candidates:
        names = _image_names(place)
        if names and ids == list(range(1, len(names) + 1)) and _colors_agree(model, place, names):
            return [(name, *model.unnamed[at]) for at, name in enumerate(names, 1)], place
    raise FormatError(
        f"{model_at} lacks images.bin or images.txt, which hold the names of its {len(ids)} "
        "images, and no folder has these images in their order.",
        hint="Copy that file too; without it poses cannot be matched to images.")


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
        pixels = decode_file(
            folder / names[index], cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        if pixels is None:
            continue
        rgb = pixels[:, :, ::-1].astype(np.float64)
        off = [_difference(rgb, model.lenses[camera], viewmat, points, colors)
               for camera, viewmat in poses]
        own = off.pop(index)
        right += own < _BETTER * min(off, default=0.0)
    return right > len(checked) / 2


def _difference(
    rgb: NDArray[np.float64], lens: Lens, viewmat: NDArray[np.float64],
    points: NDArray[np.float64], colors: NDArray[np.float64],
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
    observed = rgb[y[middle].astype(int), x[middle].astype(int)]
    return float(np.median(np.abs(observed - colors[ahead][middle]).max(axis=1)))


# Where a model lies below the folder that was given, and where its images may lie, as paths from
# there: our own undistorted model; COLMAP's and INRIA's; nerfstudio's; the model's own folder.
_PLACES: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("undistorted/sparse", ("undistorted/images",)),
    *((place, ("images", "input", ".")) for place in (
        "sparse/0", "sparse", "sparse_text/0", "sparse_text", "colmap/sparse/0", "colmap/sparse")),
    (".", ("images", ".", "../images", "../../images")),
)


def is_colmap(folder: Path) -> bool:
    """Returns whether a folder holds a COLMAP model in one of the usual places."""
    return _find_model(folder) is not None


def lacks_cameras(folder: Path) -> bool:
    """Returns whether a folder holds images of a COLMAP model, but none of its cameras."""
    return not is_colmap(folder) and any(
        (folder / place / f"{part}{suffix}").is_file()
        for place, _ in _PLACES for part in ("images", "frames") for suffix in (".bin", ".txt"))


def read_colmap(folder: Path) -> PosedSet:
    """Returns a COLMAP model with its images; InputError if none exist, FormatError if damaged."""
    place = _find_model(folder)
    if place is None:
        raise FormatError(f"{folder} holds no COLMAP model.")
    model_at, image_places = folder / place[0], place[1]
    model = read_model(model_at)
    candidates = [*(folder / name for name in image_places), *_list_reduced_folders(folder)]
    if model.images:
        named, images, notices = _locate_images(model, candidates, folder)
    else:
        named, images = _match_names_by_order(model, candidates, model_at)
        notices = (f"the model lacks the names of its {len(named)} images; they were taken in the "
                   "order of the files, and their colours agree with it",)
    listed = []
    for name, camera, viewmat in sorted(named, key=lambda image: image[0]):
        image = PosedImage(name, images / name, model.lenses[camera], viewmat)
        mask = folder / "masks" / f"{name}.png"  # as COLMAP's --ImageReader.mask_path names them
        listed.append(replace(image, mask=mask) if is_file(mask) else image)
    posed = find_images("colmap", listed, model_at)
    if len(model.points):
        posed = replace(posed, points=model.points, colors=model.colors)
    return replace(posed, notices=(*notices, *_other_models(model_at), *posed.notices))


def _find_model(folder: Path) -> tuple[str, tuple[str, ...]] | None:
    return next(((place, images) for place, images in _PLACES
                 if model_suffix(folder / place) is not None
                 and (place != "undistorted/sparse" or (folder / images[0]).is_dir())), None)


def _list_reduced_folders(folder: Path) -> list[Path]:
    """Returns images_2, images_4 and so on, the largest images first."""
    folders = [path for path in folder.glob("images_*") if path.name[7:].isdecimal()]
    return sorted(folders, key=lambda path: int(path.name[7:]))


def _locate_images(
    model: Model, candidates: Iterable[Path], folder: Path
) -> tuple[list[NamedImage], Path, tuple[str, ...]]:
    """Returns the images of the model, the folder where they are, and notices."""
    for name, _, _ in model.images:
        resolve_inside(folder, name, f"the COLMAP model in {folder}")
    for place in candidates:
        if any(is_file(place / name) for name, _, _ in model.images):
            reduced = place.name.startswith("images_")
            return model.images, place, (f"the images are those in {place.name}",) * reduced
    raise InputError(
        f"The COLMAP model in {folder} has {len(model.images)} images, but none of their files is "
        f"there. The first is {model.images[0][0]}.",
        hint=f"Put the images into {folder / 'images'}.")


def _other_models(model_at: Path) -> tuple[str, ...]:
    """Returns a notice if COLMAP left several models, of which only the first was read."""
    if model_at.name != "0":
        return ()
    others = [path for path in model_at.parent.iterdir()
              if path != model_at and model_suffix(path) is not None]
    return (f"only the first of {len(others) + 1} models in {model_at.parent.name} was read",) * (
        len(others) > 0)
