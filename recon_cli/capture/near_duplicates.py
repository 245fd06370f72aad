"""Photos that show the same view twice: copies, resaved files, bursts from one place.

A second picture from the same place adds no depth, costs as much as any, and, where one of two is
held out, lets a model be tested on a view that it was trained on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.capture.frame_measures import (
    check_exposure,
    has_content,
    measure_exposure,
    measure_sharpness,
)
from recon_cli.capture.photos import MIN_FRAMES
from recon_cli.capture.selection_record import FrameCandidate, Reason
from recon_cli.errors import InputError

SIDE = 64  # pixels of a signature
# Distance of two signatures below which they are one view. The same picture as JPEG of quality 20
# lies at .01 to .03, with noise of 10 at .01 to .02, moved by .1% of its width at .02 to .04; the
# closest two of 317 real photos and rendered frames lie at .08, of most captures above .2.
SAME_VIEW = 0.05
NAMED = 8  # photos that a message lists; all are in the record of the selection


@dataclass(frozen=True, eq=False)
class PhotoMeasures:
    """What is measured of one stored photo, by the functions of these names."""

    signature: NDArray[np.float32]
    exposure: tuple[float, float, float]
    sharpness: float


def measure_photo(
    rgb: NDArray[np.uint8],  # [H, W, 3]
) -> PhotoMeasures:
    """Returns what the selection among photos needs to know of one."""
    gray = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)
    return PhotoMeasures(signature(gray), measure_exposure(gray), measure_sharpness(gray))


def choose_photos(
    folder: str, sources: Sequence[str], names: Sequence[str],
    measures: Sequence[PhotoMeasures | None],
) -> tuple[FrameCandidate, ...]:
    """Returns which photos of a folder are kept, and why the others are not.

    All are, except those that cannot be read, show nothing, or show what a sharper one shows.

    Args:
        folder: its name, for messages.
        sources: file names of the photos; `names` are those of their frames.
        measures: of `measure_photo`, None for a photo that cannot be read.

    Raises:
        InputError: fewer than `MIN_FRAMES` different views remain.
    """
    readable = {index: photo for index, photo in enumerate(measures) if photo is not None}
    exposures = np.array([photo.exposure for photo in readable.values()], np.float64).reshape(-1, 3)
    check_exposure(folder, exposures, least=min(MIN_FRAMES, max(1, len(readable))), unit="photos")
    usable = [index for index, fine in zip(readable, has_content(exposures), strict=True) if fine]
    redundant = find_duplicates(
        np.stack([readable[index].signature for index in usable]),
        np.array([readable[index].sharpness for index in usable], np.float64))
    like = {usable[place]: usable[original] for place, original in redundant.items()}
    _check_left(folder, len(usable), len(like))
    candidates = []
    for index, photo in enumerate(measures):
        reason = (
            Reason.DAMAGED if photo is None else Reason.CLIPPED if index not in usable
            else Reason.DUPLICATE if index in like else Reason.KEPT)
        candidates.append(FrameCandidate(
            sources[index], index, reason, None if photo is None else round(photo.sharpness, 2),
            names[index] if reason is Reason.KEPT else None, like.get(index)))
    return tuple(candidates)


def describe_dropped(candidates: Sequence[FrameCandidate]) -> list[str]:
    """Returns notices about photos that could be read but are left out."""
    notices = []
    alike = [
        f"{photo.source} (like {candidates[photo.like].source})" for photo in candidates
        if photo.reason is Reason.DUPLICATE and photo.like is not None]
    if alike:
        notices.append(f"{len(alike)} photos are left out because others show the same: "
                       f"{list_names(alike)}.")
    empty = [photo.source for photo in candidates if photo.reason is Reason.CLIPPED]
    if empty:
        notices.append(f"{len(empty)} photos are left out because they are black, blown out or "
                       f"flat: {list_names(empty)}.")
    return notices


def list_names(names: Sequence[str]) -> str:
    """Returns the first names and the number of the others."""
    more = len(names) - NAMED
    return ", ".join(names[:NAMED]) + (f" and {more} more" if more > 0 else "")


def _check_left(folder: str, photos: int, alike: int) -> None:
    views = photos - alike
    if alike and views < MIN_FRAMES:
        raise InputError(
            f"{folder} holds {photos} photos but only {views} different view{'s' * (views != 1)}, "
            f"and at least {MIN_FRAMES} are needed: the others are copies or were taken from the "
            "same place.",
            hint="Add photos from other places in the room, a step apart.")


def signature(
    gray: NDArray[np.uint8],  # [H, W]
) -> NDArray[np.float32]:  # [SIDE * SIDE]
    """Returns a picture reduced by area, without its mean and of length 1; zero where it is flat.

    The same picture at another brightness or size has nearly the same signature.
    """
    small = cv2.resize(gray, (SIDE, SIDE), interpolation=cv2.INTER_AREA).astype(np.float32).ravel()
    small -= small.mean()
    length = float(np.linalg.norm(small))
    return np.asarray(small / length if length else small, np.float32)


def find_duplicates(
    signatures: NDArray[np.float32],  # [F, SIDE * SIDE]
    sharpness: NDArray[np.float64],  # [F]
) -> dict[int, int]:
    """Returns for each redundant photo the one that replaces it, by index.

    The sharpest of a group remains, the first of equally sharp ones; every other one is within
    `SAME_VIEW` of it. A flat picture is like no other.
    """
    unique: list[int] = []
    redundant: dict[int, int] = {}
    for index in np.argsort(-sharpness, kind="stable").tolist():
        distances = np.linalg.norm(signatures[unique] - signatures[index], axis=1)
        if len(unique) and distances.min() < SAME_VIEW and signatures[index].any():
            redundant[index] = unique[int(np.argmin(distances))]
        else:
            unique.append(index)
    return dict(sorted(redundant.items()))
