"""Scores of any program's renders: PSNR, SSIM and LPIPS by the conventions of `recon eval`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from recon_cli.datasets.posed import SUFFIXES
from recon_cli.errors import InputError, list_names
from recon_cli.evaluation.metrics import load_lpips
from recon_cli.evaluation.reference_views import score_image
from recon_cli.evaluation.scores import ViewScore
from recon_cli.io.images import decode_file
from recon_cli.scene.train_view import MIN_PIXELS, MIN_SIDE, leaves_enough

Image = NDArray[Any] | Tensor
Images = str | Path | Mapping[str, Image] | Iterable[Image]
Masks = str | Path | Mapping[str, Image | None] | Iterable[Image | None]

_HINT = "An image is [H, W, 3], 8-bit or float in [0, 1]."
_BRIGHT = 1.5  # median of a float image; one in [0, 1] may overshoot, but not by half everywhere


@dataclass(frozen=True)
class Scores:
    """Means over the views, and the views."""

    psnr_db: float  # mean of per-image dB, of the float renders clamped to [0, 1]
    psnr_8bit_db: float  # of the renders rounded to 8 bits
    ssim: float  # by scikit-image: a border of 5 px is left out
    ssim_padded: float  # by INRIA's scripts: zeros around the image; a little higher
    lpips: float | None  # with AlexNet; None where it was not measured
    lpips_missing: str  # why it was not; empty where it was
    views: tuple[ViewScore, ...]


def evaluate(renders: Images, truths: Images, *, masks: Masks | None = None) -> Scores:
    """Returns the scores of renders against their truths.

    Args:
        renders: arrays or tensors [H, W, 3], 8-bit or float in [0, 1], in a list, by name, or as
            one [V, H, W, 3]; or a folder of images.
        truths: likewise, of the same sizes. What has names (files have theirs without the suffix)
            is paired by them, a list in order.
        masks: likewise, [H, W] True or above 0 where a pixel counts; in a folder, images that are
            white there. All pixels of an image without a mask, or with None, count.

    Raises:
        InputError: images are missing on one side, differ in size, or are not what they should be.
        FormatError: a file is damaged.
    """
    names = next((list(_list_names(given)) for given in (renders, truths)
                  if isinstance(given, (str, Path, Mapping))), None)
    images = _read(renders, "renders", names)
    names = list(images) if names is None else names
    references = _read(truths, "truths", names)
    hidden = {} if masks is None else _read(masks, "masks", names, gray=True)
    _check_names(images, references, hidden)
    perceptual, missing = load_lpips()
    views = tuple(
        score_image(name, _to_float(image), references[name], hidden.get(name),
                    perceptual=perceptual)
        for name, image in images.items())
    lpips = [view.lpips for view in views if view.lpips is not None]
    measured = len(lpips) == len(views)
    psnr_db, psnr_8bit_db, ssim, ssim_padded = (
        float(np.mean([getattr(view, key) for view in views]))
        for key in ("psnr_db", "psnr_8bit_db", "ssim", "ssim_padded"))
    return Scores(
        psnr_db, psnr_8bit_db, ssim, ssim_padded, float(np.mean(lpips)) if measured else None,
        "" if measured else missing or "views with a mask have none", views)


def _check_names(
    images: Mapping[str, NDArray[Any]], references: Mapping[str, NDArray[Any]],
    masks: Mapping[str, NDArray[Any]],
) -> None:
    """Raises InputError unless all images can be paired and compared."""
    if not images:
        raise InputError("There are no renders to score.", hint=_HINT)
    without = [name for name in images if name not in references]
    unused = [name for name in references if name not in images]
    if without or unused:
        parts = [f"{len(names)} {what}: {list_names(names)}" for names, what in (
            (without, "renders have no truth"), (unused, "truths have no render")) if names]
        raise InputError(
            f"Of {len(images)} renders and {len(references)} truths, {'; '.join(parts)}.",
            hint="Give the same number of images, or files of the same names.")
    if foreign := [name for name in masks if name not in images]:
        raise InputError(f"Masks of no render: {list_names(foreign)}.",
                         hint="Call each mask as its image.")
    for name, image in images.items():
        size, other = image.shape[:2], references[name].shape[:2]
        if size != other:
            raise InputError(
                f"{name}: the render is {size[1]}x{size[0]} pixels, the truth "
                f"{other[1]}x{other[0]}.", hint="Render at the size of the truth.")
        if min(size) < MIN_SIDE:
            raise InputError(f"{name} is {size[1]}x{size[0]} pixels; SSIM needs {MIN_SIDE} a side.",
                             hint="Score larger images.")
        mask = masks.get(name)
        if mask is not None and mask.shape != size:
            raise InputError(f"{name}: the mask is {mask.shape[1]}x{mask.shape[0]} pixels, the "
                             f"image {size[1]}x{size[0]}.", hint="Give one of the same size.")
        if not leaves_enough(mask):
            raise InputError(f"{name}: the mask leaves fewer than {MIN_PIXELS} pixels.",
                             hint="Leave this image out, or hide less of it.")


def _list_names(images: str | Path | Mapping[str, Any]) -> Iterable[str]:
    return images if isinstance(images, Mapping) else _list_files(Path(images))


def _read(
    images: Masks, what: str, names: list[str] | None, *, gray: bool = False
) -> dict[str, NDArray[Any]]:
    """Returns images by name; those of a list get `names`, or their numbers."""
    if isinstance(images, (str, Path)):
        return {name: _read_file(path, gray=gray) for name, path in
                _list_files(Path(images)).items()}
    if not isinstance(images, Mapping):
        listed = list(images)
        names = [str(number) for number in range(len(listed))] if names is None else names
        if len(listed) != len(names):
            raise InputError(f"There are {len(names)} renders or truths, and {len(listed)} {what}.",
                             hint="Give as many of each.")
        images = dict(zip(names, listed, strict=True))
    check = _check_mask if gray else _check_image
    return {name: check(f"{what}, {name}", _to_numpy(image))
            for name, image in images.items() if image is not None}


def _list_files(folder: Path) -> dict[str, Path]:
    """Returns the images of a folder by name without the suffix; InputError if there are none."""
    if not folder.is_dir():
        raise InputError(f"The folder {folder} does not exist.", hint="Check the path.")
    files: dict[str, Path] = {}
    for path in sorted(folder.rglob("*")):
        if path.suffix in SUFFIXES and path.is_file():
            name = path.relative_to(folder).with_suffix("").as_posix()
            if name in files:
                raise InputError(f"{folder} holds {files[name].name} and {path.name}.",
                                 hint="Leave one image of each name.")
            files[name] = path
    if not files:
        raise InputError(f"{folder} holds no images.", hint="Give a folder of .png or .jpg files.")
    return files


def _read_file(path: Path, *, gray: bool) -> NDArray[Any]:
    data = decode_file(path, cv2.IMREAD_UNCHANGED)
    if data is None:
        raise InputError(f"{path} cannot be read as an image.", hint="Copy the file again.")
    largest = np.iinfo(data.dtype).max if data.dtype.kind == "u" else 0
    if not largest:
        raise InputError(f"{path} holds {data.dtype}, needed whole numbers.",
                         hint="Give arrays for images of floats.")
    if gray:
        return np.asarray((data if data.ndim == 2 else data[..., :3].min(axis=2)) == largest)
    if data.ndim == 2:
        data = np.repeat(data[..., None], 3, axis=2)
    if data.shape[2] == 4 and (data[..., 3] != largest).any():
        raise InputError(f"{path} is transparent in places.",
                         hint="Composite it over the background of the renders first.")
    rgb = data[..., 2::-1]
    return np.ascontiguousarray(rgb) if largest == 255 else (rgb / largest).astype(np.float32)


def _to_float(image: NDArray[Any]) -> NDArray[np.float32]:
    unit = image / 255 if image.dtype == np.uint8 else image
    return np.asarray(unit, np.float32)


def _to_numpy(image: Image) -> NDArray[Any]:
    return image.detach().cpu().numpy() if isinstance(image, Tensor) else np.asarray(image)


def _check_image(where: str, image: NDArray[Any]) -> NDArray[Any]:
    """Returns an image of 8 bits or of floats; InputError if it is none."""
    if image.ndim != 3 or image.shape[2] != 3:
        raise InputError(f"{where} has shape {image.shape}.", hint=_HINT)
    if image.dtype == np.uint8:
        return image
    if image.dtype.kind != "f":
        raise InputError(f"{where} is of {image.dtype}.", hint=_HINT)
    if not np.isfinite(image).all():
        raise InputError(f"{where} holds a value that is not finite.", hint=_HINT)
    if np.median(image) > _BRIGHT:
        raise InputError(f"{where} has values around {np.median(image):g}.",
                         hint="Divide by 255, or convert it to uint8.")
    return image


def _check_mask(where: str, mask: NDArray[Any]) -> NDArray[np.bool_]:
    if mask.ndim != 2:
        raise InputError(f"{where} has shape {mask.shape}.", hint="A mask is [H, W].")
    return np.asarray(mask > 0)
