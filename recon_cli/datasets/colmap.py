"""COLMAP data sets: a model with its images, in the folder layouts of the usual programs."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.datasets.exported_files import read_points
from recon_cli.datasets.file_finder import FileFinder
from recon_cli.datasets.frame_files import list_reduced
from recon_cli.datasets.frame_table import FrameTable
from recon_cli.datasets.posed import SUFFIXES, PosedImage, PosedSet, is_file, resolve_inside
from recon_cli.errors import FormatError, InputError
from recon_cli.io.colmap_model import Model, NamedImage, count_images, model_suffix, read_model
from recon_cli.io.images import decode_file
from recon_cli.io.views import spread_inside
from recon_cli.scene.camera import Lens

logger = logging.getLogger("recon")

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
    checked = spread_inside(range(len(names)), _CHECKED)
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
    size = np.array(rgb.shape[1::-1])
    pixels, _ = lens.resized(*size.tolist()).pinhole(viewmat).project(points)
    middle = (np.abs(pixels - size / 2) < size / 4).all(axis=1)
    if not middle.any():
        return 255.0
    column, row = pixels[middle].astype(int).T
    return float(np.median(np.abs(rgb[row, column] - colors[middle]).max(axis=1)))


# Where a model lies below the folder that was given, and where its images may lie, as paths from
# there: our own undistorted model; COLMAP's and INRIA's; nerfstudio's; the model's own folder.
_PLACES: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("undistorted/sparse", ("undistorted/images",)),
    *((place, ("images", "input", ".")) for place in (
        "sparse/0", "sparse", "sparse_text/0", "sparse_text", "colmap/sparse/0", "colmap/sparse")),
    (".", ("images", ".", "../images", "../../images")),
)


# Folders of numbered models that did not connect.
_NUMBERED = ("sparse", "sparse_text", "colmap/sparse")


def is_colmap(folder: Path) -> bool:
    """Returns whether a folder holds a COLMAP model in one of the usual places."""
    return _find_model(folder) is not None


def read_colmap(folder: Path) -> PosedSet:
    """Returns a COLMAP model with its images; InputError if none exist, FormatError if damaged."""
    place = _find_model(folder)
    if place is None:
        raise FormatError(f"{folder} holds no COLMAP model.")
    image_places = place[1]
    model_at, model_notices = folder / place[0], tuple[str, ...]()
    if place[0] != ".":  # not a model that was given itself
        model_at, model_notices = _choose_model(model_at)
    model = read_model(model_at)
    candidates = [folder / name for name in image_places] + list_reduced(folder)
    if model.images:
        named, home, paths, notices = _locate_images(model, candidates, folder)
    else:
        named, home = _match_names_by_order(model, candidates, model_at)
        notices = (f"the model lacks the names of its {len(named)} images; they were taken in the "
                   "order of the files, and their colours agree with it",)
        paths = {name: home / name for name, _, _ in named}
    table = FrameTable(model_at, pictures=home)
    for name, camera, viewmat in sorted(named, key=lambda image: image[0]):
        if name in paths:
            table.add(PosedImage(name, paths[name], model.lenses[camera], viewmat))
        else:
            table.missing.append(name)
    table.notices += [*model_notices, *notices]
    posed = table.finish()
    if len(model.points):
        posed = replace(posed, points=model.points, colors=model.colors)
    # INRIA's trainer and those after it start from it, and write it of the model's own points.
    file = model_at / "points3D.ply"
    return read_points(posed, file) if is_file(file) else posed


def list_cameras(folder: Path) -> list[tuple[str, Lens, NDArray[np.float64]]]:
    """Returns the name, lens and [4, 4] world to camera of each image of a model, by name.

    The images need not exist, unless the model lacks the file with their names. FormatError if it
    is damaged.
    """
    place = _find_model(folder)
    if place is None:
        raise FormatError(f"{folder} holds no COLMAP model.")
    model_at = folder / place[0]
    if place[0] != ".":
        model_at, notices = _choose_model(model_at)
        for notice in notices:
            logger.warning("%s", notice)
    model = read_model(model_at)
    if not model.images:
        return [(image.name, image.lens, image.viewmat) for image in read_colmap(folder).images]
    return [(name, model.lenses[camera], viewmat)
            for name, camera, viewmat in sorted(model.images, key=lambda image: image[0])]


def _find_model(folder: Path) -> tuple[str, tuple[str, ...]] | None:
    places = [*_PLACES[:1], *(
        (path.relative_to(folder).as_posix(), ("images", "input", "."))
        for parent in _NUMBERED for path in _numbered_models(folder / parent)), *_PLACES[1:]]
    return next(((place, images) for place, images in places
                 if model_suffix(folder / place) is not None
                 and (place != "undistorted/sparse" or (folder / images[0]).is_dir())), None)


def _numbered_models(parent: Path) -> list[Path]:
    """Returns the models in the folders 0, 1 and so on of a folder, in this order."""
    models = [path for path in parent.glob("[0-9]*")
              if path.name.isdecimal() and model_suffix(path) is not None]
    return sorted(models, key=lambda path: int(path.name))


def _choose_model(model_at: Path) -> tuple[Path, tuple[str, ...]]:
    """Returns the largest of the numbered models beside a model, and a notice of the others."""
    models = _numbered_models(model_at.parent) if model_at.name.isdecimal() else []
    if len(models) < 2:
        return model_at, ()
    counts = {path: count_images(path) for path in models}
    largest = max(models, key=lambda path: counts[path])
    others = ", ".join(f"{path.parent.name}/{path.name} has {counts[path]}"
                       for path in models if path != largest)
    return largest, (
        f"{largest.parent.name}/{largest.name} with {counts[largest]} images is read, the largest "
        f"of {len(models)} models that did not connect: {others}; give such a folder to read it",)


def _locate_images(
    model: Model, candidates: Sequence[Path], folder: Path
) -> tuple[list[NamedImage], Path, dict[str, Path], tuple[str, ...]]:
    """Returns the images of the model, their folder, files that are called otherwise, and notices.

    Images that have another suffix, another case or a path of another machine are found by their
    names. FormatError if a name leads out of the folder, and no file in it is called so.
    """
    names = [name for name, _, _ in model.images]
    where = f"the COLMAP model in {folder}"
    place = next((place for place in candidates if any(
        not PurePosixPath(name).is_absolute() and is_file(place / name) for name in names)), None)
    places = [path for path in candidates if path.is_dir()] if place is None else [place]
    for home in places:
        finder = FileFinder(home, names)
        paths = finder.find_all(where)
        if paths:
            for name in names:  # of another machine is a path from its root, not one with ..
                if name not in paths and not PurePosixPath(name).is_absolute():
                    resolve_inside(folder, name, where)
            reduced = (f"the images are those in {home.name}",) * home.name.startswith("images_")
            return model.images, home, paths, (*reduced, *finder.notices())
    for name in names:
        resolve_inside(folder, name, where)
    there = next((path for home in places for path in sorted(home.rglob("*"))
                  if path.suffix in SUFFIXES), None)
    instead = "" if there is None else f" There is {there.relative_to(folder)}, say."
    raise InputError(
        f"The COLMAP model in {folder} has {len(names)} images, but none of their files is "
        f"there. The first is {names[0]}.{instead}",
        hint=f"Put the images into {folder / 'images'}, called as in the model.")
