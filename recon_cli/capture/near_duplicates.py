"""Photos that show the same view twice: copies, resaved files, bursts from a hand held still.

A second picture from the same place adds no depth, costs as much as any, and, where one of two is
held out, lets a model pass a test that it has trained on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.capture.photos import MIN_FRAMES
from recon_cli.capture.scan import check_exposure, exposure, sharpness, telling
from recon_cli.capture.selection_record import Candidate, Reason
from recon_cli.errors import InputError

SIDE = 64  # pixels of a signature
# Distance of two signatures below which they are one view. The same picture as JPEG of quality 20
# lies at .01 to .03, with noise of 10 at .01 to .02, moved by .1% of its width at .02 to .04; the
# closest two of 317 real photos and rendered frames lie at .08, of most captures above .2.
SAME_VIEW = 0.05
NAMED = 8  # photos that a message lists; all are in the record of the choice


@dataclass(frozen=True, eq=False)
class PhotoLook:
    """What is measured of one photo, as it is stored.

    Attributes:
        signature: `signature` of it.
        exposure: `exposure.exposure` of it.
        sharpness: variance of its Laplacian, as of a video frame.
    """

    signature: NDArray[np.float32]
    exposure: tuple[float, float, float]
    sharpness: float


def look_at_photo(
    rgb: NDArray[np.uint8],  # [H, W, 3]
) -> PhotoLook:
    """Returns what the choice among photos needs to know of one."""
    gray = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)
    return PhotoLook(signature(gray), exposure(gray), sharpness(gray))


def choose_photos(
    folder: str, sources: Sequence[str], names: Sequence[str], looks: Sequence[PhotoLook | None]
) -> tuple[Candidate, ...]:
    """Returns which photos of a folder are kept, and why the others are not.

    All are, but for those that cannot be read, show nothing, or show what a sharper one shows.

    Args:
        folder: its name, for messages.
        sources: file names of the photos.
        names: under which they are stored if they are kept.
        looks: what `look_at_photo` found, None for a photo that cannot be read.

    Raises:
        InputError: fewer than `MIN_FRAMES` remain of those that can be read, by what they show.
    """
    readable = [index for index, look in enumerate(looks) if look is not None]
    seen = [look for look in looks if look is not None]
    exposures = np.array([look.exposure for look in seen], np.float64).reshape(-1, 3)
    check_exposure(folder, exposures, least=min(MIN_FRAMES, max(1, len(seen))), unit="photos")
    shown = [index for index, fine in zip(readable, telling(exposures), strict=True) if fine]
    usable = [look for look in seen if telling(np.array([look.exposure]))[0]]
    goes = duplicates(
        np.stack([look.signature for look in usable]),
        np.array([look.sharpness for look in usable], np.float64))
    like = {shown[place]: shown[stays] for place, stays in goes.items()}
    _check_left(folder, len(shown), len(like))
    found = []
    for index, look in enumerate(looks):
        reason = (
            Reason.DAMAGED if look is None else Reason.CLIPPED if index not in shown
            else Reason.DUPLICATE if index in like else Reason.KEPT)
        found.append(Candidate(
            sources[index], index, reason, None if look is None else round(look.sharpness, 2),
            names[index] if reason is Reason.KEPT else None, like.get(index)))
    return tuple(found)


def dropped_photos(candidates: Sequence[Candidate]) -> list[str]:
    """Returns what to tell about photos that could be read but are left out, by name."""
    told = []
    alike = [
        f"{one.source} (like {candidates[one.like].source})" for one in candidates
        if one.reason is Reason.DUPLICATE and one.like is not None]
    if alike:
        told.append(f"{len(alike)} photos are left out, for others show the same: {named(alike)}.")
    empty = [one.source for one in candidates if one.reason is Reason.CLIPPED]
    if empty:
        told.append(
            f"{len(empty)} photos are left out, all black, blown out or flat: {named(empty)}.")
    return told


def named(names: Sequence[str]) -> str:
    """Returns names for a message: the first, and how many more there are."""
    more = len(names) - NAMED
    return ", ".join(names[:NAMED]) + (f" and {more} more" if more > 0 else "")


def _check_left(folder: str, shown: int, alike: int) -> None:
    if alike and shown - alike < MIN_FRAMES:
        raise InputError(
            f"{folder} holds {shown} photos but only {shown - alike} different view"
            f"{'s' * (shown - alike != 1)}, and at least "
            f"{MIN_FRAMES} are needed: the others are copies or were taken from the same place.",
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


def duplicates(
    signatures: NDArray[np.float32],  # [F, SIDE * SIDE]
    sharpness: NDArray[np.float64],  # [F]
) -> dict[int, int]:
    """Returns for each photo that can go the one that stands for it, by index.

    The sharpest of a group stays, the first of equally sharp ones; every other one is within
    `SAME_VIEW` of the one that stands for it. A flat picture is like no other.
    """
    stays: list[int] = []
    goes: dict[int, int] = {}
    for index in np.argsort(-sharpness, kind="stable").tolist():
        distances = np.linalg.norm(signatures[stays] - signatures[index], axis=1)
        if len(stays) and distances.min() < SAME_VIEW and signatures[index].any():
            goes[index] = stays[int(np.argmin(distances))]
        else:
            stays.append(index)
    return dict(sorted(goes.items()))
