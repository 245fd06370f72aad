"""360-degree panoramas among photos: told by their metadata, or by their content.

A panorama is not taken by a pinhole camera: treated as such it gives wrong cameras or none. A
folder is used as panoramas or as ordinary photos, whichever it holds more of. Pictures that hold
two are neither: unstitched ones of two fisheye lenses, and the views of both eyes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from recon_cli.capture.decoded_picture import Packing
from recon_cli.capture.images import Photo, open_image
from recon_cli.capture.limits import SAME_SHAPE, SAMPLED_PICTURES
from recon_cli.capture.two_views import find_two_views, has_two_circles
from recon_cli.capture.unreadable import BROKEN
from recon_cli.capture.xmp import PanoramaArea
from recon_cli.errors import InputError, list_names
from recon_cli.io.views import evenly_spread, spread_inside
from recon_cli.workspace.records import MIN_FRAMES

_SMALL = (256, 128)
_DETAILED = (1280, 640)  # at which circles are round in pictures of 2:1, and features are found
# In panoramas the edge columns are neighbours: they differ as neighbours do, while columns half a
# turn apart differ by 4 to 40 times as much. The top or the bottom row is one point. 14 of 19 and
# 60 of 60 panoramas pass both, and 1 of 446 photos of rooms that were cut to 2:1.
_SEAM, _POLE = 3.0, 0.5
# Wider pictures have no pole: at 2.2, 3 and 4:1 74 to 100 of 100 panoramas pass without it, and at
# most 3 of 100 photos of seven captures.


@dataclass(frozen=True)
class ChosenPhotos:
    """The photos of a folder that are used, all of one projection."""

    photos: tuple[Photo, ...]
    panoramas: bool  # they are equirectangular
    notices: tuple[str, ...] = ()


def choose_projection(folder: str, photos: Sequence[Photo], camera: str) -> ChosenPhotos:
    """Returns the panoramas of a folder, or its ordinary photos; `camera` is that of IngestConfig.

    InputError where too few of either are left, or a picture cannot be what was asked for.
    """
    if camera == "perspective":
        return ChosenPhotos(tuple(photos), panoramas=False)
    single, notices = _drop_double(folder, photos)
    chosen = _choose_projection(folder, single, camera)
    return replace(chosen, notices=(*notices, *chosen.notices))


def _drop_double(folder: str, photos: Sequence[Photo]) -> tuple[list[Photo], list[str]]:
    """Returns the photos without pictures that hold two, and notices; InputError where few remain.
    """
    doubled = {
        "unstitched pictures of two fisheye lenses": (
            _find_double(photos, lambda shape: abs(shape / 2 - 1) <= SAME_SHAPE, has_two_circles),
            "Export them as 360-degree (equirectangular) pictures with the app of the camera."),
        "3D pictures with the views of both eyes side by side": (
            _find_double(photos, lambda shape: shape > 2 * (1 + SAME_SHAPE),
                         lambda pictures: find_two_views(pictures) is Packing.SIDE_BY_SIDE),
            "Cut one view out, for example with mkdir left && magick mogrify -path left -crop "
            "50%x100%+0+0 +repage *.jpg")}
    singles, notices = list(photos), []
    for kind, (doubles, advice) in doubled.items():
        singles = [photo for photo in singles if photo not in doubles]
        if doubles and len(singles) < MIN_FRAMES:
            raise InputError(
                f"{len(doubles)} of the {len(photos)} pictures in {folder} are {kind}, such as "
                f"{doubles[0].name}.",
                hint=f"{advice} --camera perspective uses them as ordinary photos.")
        if doubles:
            names = list_names([photo.name for photo in doubles])
            notices.append(f"{len(doubles)} {kind} are left out: {names}. {advice}")
    return singles, notices


def _find_double(
    photos: Sequence[Photo], fits: Callable[[float], bool],
    test: Callable[[Sequence[NDArray[np.uint8]]], bool],
) -> list[Photo]:
    """Returns the photos of each size, of a shape that fits, of which some pass a test together."""
    sizes: dict[tuple[int, int], list[Photo]] = {}
    for photo in photos:
        if not photo.is_raw and fits(photo.width / photo.height):
            sizes.setdefault((photo.width, photo.height), []).append(photo)
    return [photo for alike in sizes.values()
            if test([picture for one in evenly_spread(alike, SAMPLED_PICTURES)
                     if (picture := _read_small(one, _DETAILED)) is not None])
            for photo in alike]


def _choose_projection(folder: str, photos: Sequence[Photo], camera: str) -> ChosenPhotos:
    if camera == "equirectangular":
        odd = [photo for photo in photos if photo.area is None
               and abs(photo.width / photo.height / 2 - 1) > SAME_SHAPE]
        if odd:
            raise InputError(
                f"{len(odd)} of {len(photos)} pictures in {folder} are not twice as wide as high, "
                f"as panoramas are, such as {odd[0].name} ({odd[0].width}x{odd[0].height}).",
                hint="Take them out of the folder, or leave --camera equirectangular out.")
        return ChosenPhotos(tuple(photos), panoramas=True)
    found = find_panoramas(photos)
    round_about = [photo for photo in found if photo.area or not photo.panorama]
    bands = find_bands(photos)
    found = [photo for photo in photos if photo in found or photo in bands]
    others = [photo for photo in photos if photo not in found]
    if len(round_about) >= MIN_FRAMES and len(round_about) > len(others):
        left_out = [photo.name for photo in photos if photo not in round_about]
        return ChosenPhotos(tuple(round_about), True, (
            f"{len(round_about)} pictures are used as 360-degree panoramas (equirectangular); "
            "--camera perspective uses them as ordinary photos.",
            *([f"{len(left_out)} pictures are left out, because they are not panoramas as the "
               f"others are: {list_names(left_out)}."] if left_out else [])))
    if found and len(others) < MIN_FRAMES:
        raise InputError(
            f"{len(found)} of the {len(photos)} pictures in {folder} are panoramas, such as "
            f"{found[0].name}; {len(round_about)} of them are equirectangular, but at least "
            f"{MIN_FRAMES} are needed.",
            hint="Add panoramas from other places in the room, stitched to equirectangular "
            "pictures twice as wide as high (cropped ones need the metadata that says where), or "
            "give the folder of ordinary photos; --camera perspective takes these for such.")
    if found:
        names = [photo.name for photo in found]
        return ChosenPhotos(tuple(others), False, (
            f"{len(names)} panoramas are left out, because they are not pictures of ordinary "
            f"lenses as the others are: {list_names(names)}. To use them, give them in a "
            "folder of their own.",))
    return ChosenPhotos(tuple(others), panoramas=False)


def fill_sphere(
    rgb: NDArray[np.uint8],  # [H, W, 3], at any scale
    mask: NDArray[np.uint8] | None,  # [H, W], 255 where a pixel counts, else 0
    area: PanoramaArea,
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Returns a cropped panorama as one of the full sphere, and its mask.

    What it does not show is black, and masked.
    """
    scale = rgb.shape[1] / area.width
    top, left = round(scale * area.top), round(scale * area.left)
    height = max(round(scale * area.full_height), top + rgb.shape[0])
    width = max(round(scale * area.full_width), left + rgb.shape[1])
    full = np.zeros((height, width, 3), np.uint8)
    counts = np.zeros((height, width), np.uint8)
    rows, columns = slice(top, top + rgb.shape[0]), slice(left, left + rgb.shape[1])
    full[rows, columns], counts[rows, columns] = rgb, 255 if mask is None else mask
    return full, counts


def find_panoramas(photos: Sequence[Photo]) -> list[Photo]:
    """Returns which photos are panoramas: by metadata, else where those of 2:1 wrap around."""
    told = [photo for photo in photos if photo.panorama]
    wide = [photo for photo in photos
            if not photo.panorama and not photo.is_raw and photo.width == 2 * photo.height]
    if not _most_pass(wide, wraps_around):
        return told
    return [photo for photo in photos if photo in told or photo in wide]


def find_bands(photos: Sequence[Photo]) -> list[Photo]:
    """Returns the panoramas without metadata of which only a band around the horizon is left.

    Nothing says where that lies on the sphere.
    """
    wide = [photo for photo in photos if not photo.panorama and not photo.is_raw
            and photo.width > 2 * (1 + SAME_SHAPE) * photo.height]
    return wide if _most_pass(wide, has_no_seam) else []


def _most_pass(
    photos: Sequence[Photo], test: Callable[[NDArray[np.uint8]], bool]
) -> bool:
    """Returns whether there are enough photos, and enough of those looked at pass a test."""
    if len(photos) < MIN_FRAMES:
        return False
    pictures = [small for photo in spread_inside(photos, SAMPLED_PICTURES)
                if (small := _read_small(photo)) is not None]
    return sum(map(test, pictures)) >= max(MIN_FRAMES, len(pictures) / 2)


def wraps_around(rgb: NDArray[np.uint8]) -> bool:
    """Returns whether a picture [H, 2 H, 3] ends where it begins and has a pole, as panoramas."""
    small = cv2.resize(rgb, _SMALL, interpolation=cv2.INTER_AREA).astype(np.float64)
    spread = small.std(axis=1).mean(axis=1)  # of each row
    pole = min(spread[0], spread[-1]) <= _POLE * np.median(spread)
    return bool(pole and has_no_seam(rgb))


def has_no_seam(rgb: NDArray[np.uint8]) -> bool:
    """Returns whether a picture [H, W, 3] ends where it begins."""
    small = cv2.resize(rgb, _SMALL, interpolation=cv2.INTER_AREA).astype(np.float64)
    seam = np.abs(small[:, 0] - small[:, -1]).mean()
    steps = np.abs(np.diff(small, axis=1)).mean(axis=(0, 2))
    opposite = np.abs(small - np.roll(small, _SMALL[0] // 2, axis=1)).mean()
    return bool(seam <= _SEAM * np.median(steps) and _SEAM * seam < opposite)


def _read_small(
    photo: Photo, size: tuple[int, int] = (2 * _SMALL[0], 2 * _SMALL[1])
) -> NDArray[np.uint8] | None:
    """Returns a photo at a fraction of its size; None where it cannot be read."""
    with suppress(*BROKEN), open_image(photo.path) as image:
        image.draft("RGB", size)
        return np.asarray(image.convert("RGB").resize(size, Image.Resampling.BOX))
    return None
