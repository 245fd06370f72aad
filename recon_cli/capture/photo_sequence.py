"""Photos that are plainly the frames of a video: how they are told, and which of them are chosen.

A folder that holds every frame of a walk shows each view twenty times over. It is thinned by the
measures and functions of videos. What is left out here: frames that somebody has thinned already,
and sets of photos, which are few because each was taken on purpose.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags

from recon_cli.capture import frame_selection
from recon_cli.capture.frame_measures import (
    SHARPNESS_SIZE,
    MotionMeter,
    check_exposure,
    measure_exposure,
    measure_sharpness,
)
from recon_cli.capture.images import BROKEN, WHITE, Photo, open_image, read_photo, unreadable_error
from recon_cli.capture.ingested_source import IngestContext
from recon_cli.capture.photos import group_photos
from recon_cli.config.stages import IngestConfig
from recon_cli.errors import FormatError, InputError
from recon_cli.io.images import fit_size
from recon_cli.workspace import atomic

# Two neighbours are near where the view shifts by at most MAX_STEP widths and MIN_FOLLOWED of the
# corners are found again. In dumps of 11 walks 94 to 100% of the neighbours are near, in four photo
# sets 1 to 47%, among a drone's photos, two a second, 77%.
MAX_STEP, MIN_FOLLOWED, NEAR_SHARE = 0.05, 0.75, 0.88
MANY = 100  # no more are thinned unasked: all pairs of them are matched in minutes
# Numbers of the names that follow at the usual step: all in a dump, .67 of frames that were picked.
REGULAR_SHARE = 0.95
MAX_SECONDS = 1.0  # median time between neighbours by EXIF, which counts whole seconds
_NUMBER = re.compile(r"(.*?)(\d+)(\D*)")  # the last number of a name


@dataclass(frozen=True, eq=False)
class PhotoSequence:
    """The measures of F photos that are the frames of a video, in order."""

    motion: NDArray[np.float64]  # [F], `MotionMeter.advance`
    sharpness: NDArray[np.float64]  # [F], `measure_sharpness`
    exposure: NDArray[np.float64]  # [F, 3], rows of `measure_exposure`
    broken: Mapping[int, str]  # why a photo cannot be read, by index

    @property
    def whole(self) -> NDArray[np.bool_]:  # [F]
        """Which photos could be read."""
        return np.array([index not in self.broken for index in range(len(self.motion))])

    def to_json(self) -> dict[str, Any]:
        """Returns the measures as JSON values; NaN becomes null."""
        return {
            "motion": [None if np.isnan(step) else step for step in self.motion.tolist()],
            "sharpness": self.sharpness.tolist(), "exposure": self.exposure.tolist(),
            "broken": {str(index): reason for index, reason in self.broken.items()}}

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> PhotoSequence:
        """Returns the measures that `to_json` wrote."""
        return cls(
            np.array(value["motion"], np.float64), np.array(value["sharpness"], np.float64),
            np.array(value["exposure"], np.float64).reshape(-1, 3),
            {int(index): reason for index, reason in value["broken"].items()})


def find_sequence(
    config: IngestConfig, photos: Sequence[Photo], record: Path, ctx: IngestContext, *,
    white: int = WHITE,
) -> PhotoSequence | None:
    """Returns the measures of photos that are frames of a video and more than are wanted, or None.

    `record` keeps the measures for the next run; `white` is that of photos with 16 bits.
    """
    most = config.frames or MANY
    if len(photos) <= most or not looks_numbered(photos):
        return None
    known = _read_record(record, len(photos))
    if known is not None:
        return known
    with ctx.progress.bar("scan", len(photos), unit="photo") as bar:
        def read() -> Iterator[NDArray[np.uint8] | InputError]:
            for photo in photos:
                bar.advance()
                try:
                    yield _read_gray(photo, white)
                except InputError as error:
                    yield error

        sequence = measure_sequence(read(), len(photos))
    if sequence is not None:
        atomic.write_json(record, sequence.to_json())
    return sequence


def _read_record(record: Path, count: int) -> PhotoSequence | None:
    """Returns the measures that an earlier run left; None where they are missing or damaged."""
    if not record.exists():
        return None
    try:
        known = PhotoSequence.from_json(atomic.read_json(record))
    except (AttributeError, KeyError, TypeError, ValueError, FormatError):
        return None
    lengths = {len(known.motion), len(known.sharpness), len(known.exposure)}
    return known if lengths == {count} else None


def looks_numbered(photos: Sequence[Photo]) -> bool:
    """Returns whether photos are of one camera, numbered evenly, and not seconds apart by EXIF."""
    if len(photos) < 2 or any(photo.is_raw for photo in photos) or len(group_photos(photos)) > 1:
        return False
    names = [_NUMBER.fullmatch(photo.path.stem) for photo in photos]
    if len({name and (name[1], name[3]) for name in names}) > 1 or names[0] is None:
        return False
    steps = np.diff([int(name[2]) for name in names if name])
    (_, usual), = Counter(steps.tolist()).most_common(1)
    if usual < REGULAR_SHARE * len(steps):
        return False
    times = [time for photo in photos if (time := _read_time(photo.path)) is not None]
    gaps = [abs((after - before).total_seconds()) for before, after in pairwise(times)]
    return not gaps or float(np.median(gaps)) <= MAX_SECONDS


def _read_time(path: Path) -> datetime | None:
    """Returns when a photo was taken according to EXIF; None where that is not said."""
    try:
        with open_image(path) as image:
            detail = image.getexif().get_ifd(ExifTags.IFD.Exif)
        return datetime.strptime(
            str(detail.get(ExifTags.Base.DateTimeOriginal)), "%Y:%m:%d %H:%M:%S")
    except BROKEN:  # a ValueError where it is no time
        return None


def _read_gray(photo: Photo, white: int) -> NDArray[np.uint8]:
    """Returns the gray values of a photo, upright but perhaps mirrored or on its head.

    JPEG decodes to gray and to a fraction of its size in a quarter of the time.
    """
    try:
        with open_image(photo.path) as image:
            image.draft("L", fit_size(*image.size, SHARPNESS_SIZE))
            plain = (image.mode in ("L", "RGB") and not photo.wide
                     and not image.has_transparency_data)
            gray = np.array(image.convert("L")) if plain else None
    except BROKEN as error:
        raise unreadable_error(photo.path, error) from error
    if gray is None:
        return np.asarray(cv2.cvtColor(read_photo(photo, white), cv2.COLOR_RGB2GRAY), np.uint8)
    turned = (gray.shape[1] < gray.shape[0]) != (photo.width < photo.height)
    return np.ascontiguousarray(gray.T) if turned else gray


def measure_sequence(
    grays: Iterator[NDArray[np.uint8] | InputError], count: int
) -> PhotoSequence | None:
    """Returns the measures of `count` gray photos if they are frames of a video, else None.

    It stops reading as soon as too many neighbours lie too far apart.
    """
    meter = MotionMeter()
    motion, sharpness, exposure = (np.zeros(shape) for shape in (count, count, (count, 3)))
    broken: dict[int, str] = {}
    before: NDArray[np.uint8] | None = None
    far = 0  # photos that are not near the one before
    for index, gray in enumerate(grays):
        if isinstance(gray, InputError):
            broken[index] = gray.message
            far += 1
        else:
            motion[index] = meter.advance(gray)
            sharpness[index], exposure[index] = measure_sharpness(gray), measure_exposure(gray)
            far += before is not None and not _are_near(before, gray)
            before = gray
        if far > (1 - NEAR_SHARE) * count:
            return None
    return PhotoSequence(motion, sharpness, exposure, broken)


def _are_near(before: NDArray[np.uint8], after: NDArray[np.uint8]) -> bool:
    """Returns whether two gray pictures may be frames of a video that follow each other."""
    meter = MotionMeter()
    meter.advance(before)
    return meter.advance(after) <= MAX_STEP and meter.followed >= MIN_FOLLOWED  # NaN is far


def choose_from_sequence(
    config: IngestConfig, folder: str, photos: Sequence[Photo], names: Sequence[str],
    sequence: PhotoSequence, ctx: IngestContext,
) -> tuple[frame_selection.FrameCandidate, ...]:
    """Returns which photos are kept under which names, as from a video, and says how many.

    InputError if too few show anything, or the camera does not move.
    """
    whole = sequence.whole
    check_exposure(folder, sequence.exposure[whole], least=frame_selection.MIN_FRAMES,
                   unit="photos")
    warning = frame_selection.check_motion(folder, sequence.motion)
    if warning:
        ctx.notice(warning)
    lengths = frame_selection.path_length(sequence.motion)
    judgement = frame_selection.judge_frames(
        lengths, sequence.sharpness, sequence.exposure, whole, config.sharpness)
    count = config.frames or frame_selection.automatic_count(lengths, most=config.max_frames)
    chosen = frame_selection.choose_frames(
        lengths, sequence.sharpness, judgement.usable, count, bridges=judgement.bridges)
    if len(chosen) < frame_selection.MIN_FRAMES:
        raise InputError(
            f"Only {len(chosen)} of the {len(photos)} photos in {folder} are sharp, but at least "
            f"{frame_selection.MIN_FRAMES} are needed.", hint="Lower --sharpness.")
    ctx.notice(
        f"The photos in {folder} are the frames of a video: {len(chosen)} of {len(photos)} are "
        f"chosen by their sharpness and the camera's motion; --frames {len(photos)} keeps all.")
    candidates = frame_selection.video_candidates(
        folder, sequence.sharpness, judgement.refused, lengths,
        {int(index): names[index] for index in chosen})
    return tuple(
        replace(candidate, source=photo.name,
                sharpness=None if candidate.index in sequence.broken else candidate.sharpness)
        for candidate, photo in zip(candidates, photos, strict=True))
