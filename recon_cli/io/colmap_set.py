"""COLMAP data sets: a model with its images, wherever the usual programs put the two."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import FormatError, InputError
from recon_cli.io.colmap_model import Model, model_suffix, read_model
from recon_cli.io.colmap_names import named_in_order
from recon_cli.io.listed import Listed, find_images, inside, is_file
from recon_cli.io.posed import PosedSet

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
    """Returns a COLMAP model with its images.

    Raises:
        InputError: none of its images is there.
        FormatError: the model is damaged, or an image is of another size than its camera.
    """
    place = _find_model(folder)
    if place is None:
        raise FormatError(f"{folder} holds no COLMAP model.")
    model_at, image_places = folder / place[0], place[1]
    model = read_model(model_at)
    candidates = [*(folder / name for name in image_places), *_reduced(folder)]
    if model.images:
        named, images, said = _named(model, candidates, folder)
    else:
        named, images = named_in_order(model, candidates, model_at)
        said = (f"the model lacks the names of its {len(named)} images; they were taken in the "
                "order of the files, and their colours agree with it",)
    listed = []
    for name, camera, viewmat in sorted(named, key=lambda image: image[0]):
        mask = folder / "masks" / f"{name}.png"  # as COLMAP's --ImageReader.mask_path names them
        listed.append(Listed(
            name, images / name, model.lenses[camera], viewmat,
            mask=mask if is_file(mask) else None))
    found = find_images(listed, model_at)
    has_points = len(model.points) > 0
    return PosedSet(
        "colmap", found.lenses, found.images, found.missing,
        points=model.points if has_points else None, colors=model.colors if has_points else None,
        notices=(*said, *_other_models(model_at), *found.notices))


def _find_model(folder: Path) -> tuple[str, tuple[str, ...]] | None:
    for place, images in _PLACES:
        if model_suffix(folder / place) is None:
            continue
        if place == "undistorted/sparse" and not (folder / images[0]).is_dir():
            continue
        return place, images
    return None


def _reduced(folder: Path) -> list[Path]:
    """Returns images_2, images_4 and so on, the largest images first."""
    found = [path for path in folder.glob("images_*") if path.name[7:].isdecimal()]
    return sorted(found, key=lambda path: int(path.name[7:]))


def _named(
    model: Model, candidates: Iterable[Path], folder: Path
) -> tuple[list[tuple[str, int, NDArray[np.float64]]], Path, tuple[str, ...]]:
    """Returns the images of the model, the folder where they are, and what to say about it."""
    for name, _, _ in model.images:
        inside(folder, name, f"the COLMAP model in {folder}")
    for place in candidates:
        if any(is_file(place / name) for name, _, _ in model.images):
            reduced = place.name.startswith("images_")
            return model.images, place, (f"the images are those in {place.name}",) * reduced
    raise InputError(
        f"The COLMAP model in {folder} has {len(model.images)} images, but none of their files is "
        f"there. The first is {model.images[0][0]}.",
        hint=f"Put the images into {folder / 'images'}.")


def _other_models(model_at: Path) -> tuple[str, ...]:
    """Returns that COLMAP left several models and only the first was read."""
    if model_at.name != "0":
        return ()
    others = [path for path in model_at.parent.iterdir()
              if path != model_at and model_suffix(path) is not None]
    return (f"only the first of {len(others) + 1} models in {model_at.parent.name} was read",) * (
        len(others) > 0)
