"""What one pass over all frames of a video tells: sharpness, motion, and which frames are whole."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from av.video.frame import PictureType
from numpy.typing import NDArray

from recon_cli.capture.decoded_picture import Gap, Picture
from recon_cli.capture.video import claimed_length, convert_hint, decode, open_video
from recon_cli.capture.video_notices import done_to
from recon_cli.errors import InputError

TRACK_WIDTH = 320  # pixels; wide enough for corners, small enough for 5 ms a frame
ANCHOR_REACH = 0.03  # of the width, about 10 px: still well inside the tracker's basin
MIN_TRACKS = 8  # fewer agree by chance
# Corners as in Shi and Tomasi; their spacing spreads 300 of them over the frame.
MAX_CORNERS, CORNER_QUALITY, CORNER_SPACING = 300, 0.005, 6
# 15 px windows on 4 pyramid levels follow about 40 px at this width.
WINDOW, LEVELS = (15, 15), 3
RETURN_ERROR = 1.0  # pixels between a corner and where following it there and back ends


class MotionMeter:
    """Follows corners through a video, one gray frame at a time."""

    def __init__(self) -> None:
        self._anchor: NDArray[np.uint8] | None = None
        self._corners: NDArray[np.float32] | None = None
        self._reached = 0.0  # furthest displacement from the anchor so far

    def advance(self, gray: NDArray[np.uint8]) -> float:
        """Returns how much further than ever since the anchor this frame lies.

        Args:
            gray: the next frame, [H, W] uint8, any size but always the same.

        Returns:
            the median displacement gained, as a fraction of the width; 0 for the first frame and
            for one that moves back; NaN where too little can be followed to tell.
        """
        small = _shrunk(gray)
        if self._anchor is None:
            self._drop_anchor(small)
            return 0.0
        displacement = self._displacement(small)
        if math.isnan(displacement):
            self._drop_anchor(small)
            return displacement
        gained = max(0.0, displacement - self._reached)
        self._reached += gained
        if self._reached >= ANCHOR_REACH:
            self._drop_anchor(small)
        return gained

    def _drop_anchor(self, small: NDArray[np.uint8]) -> None:
        self._anchor = small
        self._corners = cv2.goodFeaturesToTrack(
            small, MAX_CORNERS, CORNER_QUALITY, CORNER_SPACING)
        self._reached = 0.0

    def _displacement(self, small: NDArray[np.uint8]) -> float:
        """Returns the median displacement of the anchor's corners, NaN where most are lost."""
        if self._corners is None or len(self._corners) < MIN_TRACKS:
            return float("nan")
        found, there, _ = cv2.calcOpticalFlowPyrLK(
            self._anchor, small, self._corners, None, winSize=WINDOW, maxLevel=LEVELS)
        back, returned, _ = cv2.calcOpticalFlowPyrLK(
            small, self._anchor, found, None, winSize=WINDOW, maxLevel=LEVELS)
        # A corner counts when it is found again from where it went; onto a blank wall the tracker
        # slides without an error.
        astray = np.linalg.norm((back - self._corners).reshape(-1, 2), axis=1)
        kept = (there & returned)[:, 0].astype(bool) & (astray <= RETURN_ERROR)
        if kept.sum() < MIN_TRACKS:
            return float("nan")
        steps = np.linalg.norm((found - self._corners)[kept].reshape(-1, 2), axis=1)
        return float(np.median(steps) / small.shape[1])


def _shrunk(gray: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width = gray.shape
    if width <= TRACK_WIDTH:
        return gray
    size = (TRACK_WIDTH, max(1, round(height * TRACK_WIDTH / width)))
    return np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA))


# Gray values of 8 bits; a codec moves true black and white by a few.
BLACK, BLOWN_OUT = 16, 250
# More than this and the frame is clipped: it is passed over where neighbours are better.
MOST_CLIPPED = 0.5
# More than this and nothing in the frame can be matched: it is never taken.
ALL_CLIPPED = 0.95
# A frame whose areas differ by less than this many gray values (standard deviation) is flat: a
# lens cap, a wall that fills the view. Noise is averaged out before.
FLAT = 4.0
AREAS = 32  # along each side
EVERY = 4  # pixels; a share is known well enough from every 16th


def exposure(
    gray: NDArray[np.uint8],  # [H, W]
) -> tuple[float, float, float]:
    """Returns the share of black pixels, that of blown-out ones, and the spread of the rest.

    The spread is the standard deviation over 32x32 areas, in gray values of 8 bits.
    """
    few = gray[::EVERY, ::EVERY]
    areas = cv2.resize(gray, (AREAS, AREAS), interpolation=cv2.INTER_AREA)
    return float(np.mean(few <= BLACK)), float(np.mean(few >= BLOWN_OUT)), float(areas.std())


def well_exposed(
    exposures: NDArray[np.float64],  # [F, 3], rows of `exposure`
) -> NDArray[np.bool_]:  # [F]
    """Returns which frames are neither black nor blown out for the most part."""
    return np.asarray(exposures[:, :2].sum(axis=1) <= MOST_CLIPPED)


def telling(
    exposures: NDArray[np.float64],  # [F, 3], rows of `exposure`
) -> NDArray[np.bool_]:  # [F]
    """Returns which frames show anything at all: neither all clipped nor flat."""
    seen = exposures[:, :2].sum(axis=1) <= ALL_CLIPPED
    return np.asarray(seen & (exposures[:, 2] >= FLAT))


def check_exposure(
    name: str,
    exposures: NDArray[np.float64],  # [F, 3], rows of `exposure`
    *,
    least: int,
    unit: str = "frames",
) -> None:
    """Raises InputError when too few frames show anything, and says what is wrong with most.

    Args:
        name: of the capture, for the message.
        exposures: of all frames that could be read.
        least: how many must show something.
        unit: what the capture consists of, for the message.

    Raises:
        InputError: with what is wrong with most of them.
    """
    shown = int(telling(exposures).sum())
    if shown >= least:
        return
    black, blown, _ = exposures.T
    kinds: Sequence[tuple[str, NDArray[np.bool_], str]] = (
        ("too dark", black > MOST_CLIPPED, "Turn on the light, take off the lens cap, and record "
         "again; a dark but clean recording can be brightened in an editor first."),
        ("over-exposed", blown > MOST_CLIPPED, "Record again with less exposure: tap on a bright "
         "part of the room before you start."),
        ("flat", ~telling(exposures), "Record again with furniture, edges and texture in view; "
         "bare walls cannot be reconstructed."),
    )
    kind, hit, hint = next((one for one in kinds if one[1].sum() * 2 > len(black)), kinds[-1])
    raise InputError(
        f"{name} is {kind}: so are {int(hit.sum())} of its {len(black)} {unit}. Only {shown} show "
        f"anything that can be matched, but at least {least} are needed.", hint=hint)


# Pixels on the longest side: makes sharpness comparable and keeps sensor noise of large frames
# from passing for detail.
SHARPNESS_SIZE = 960
# B-frames in a row: x264 places 3 by default and 8 at its slowest. HEVC encoders mark whole
# groups as B, so the search for them needs an end.
MAX_B_RUN = 8


@dataclass(frozen=True, eq=False)
class Scan:
    """F frames in the order of showing; a frame's index is its place here.

    Attributes:
        width: width of an upright frame in pixels.
        height: height of an upright frame in pixels.
        declared: how many frames the file claims to hold, by its duration where it keeps no
            count; 0 where it does not say.
        gaps: packets that gave no frame.
        sharpness: [F] float64 variance of the Laplacian of the 8-bit gray frame.
        motion: [F] float64 way gained since the frame before, in widths; NaN where unknown.
        exposure: [F, 3] float64 rows of `exposure.exposure`.
        seconds: time of showing of each frame, None where the file does not say.
        whole: [F] bool; False from a lost or damaged packet to the next key frame, because all
            frames between are predicted from what was lost.
    """

    width: int
    height: int
    declared: int
    gaps: int
    sharpness: NDArray[np.float64]
    motion: NDArray[np.float64]
    exposure: NDArray[np.float64]
    seconds: tuple[float | None, ...]
    whole: NDArray[np.bool_]
    notices: tuple[str, ...]

    @property
    def expected(self) -> int:
        """How many frames there should be."""
        return max(self.declared, len(self.whole) + self.gaps)

    @property
    def lost(self) -> int:
        """How many frames are missing or broken."""
        return self.expected - int(self.whole.sum())

    def to_json(self) -> dict[str, Any]:
        """Returns the scan as JSON values; NaN becomes null."""
        return {
            "width": self.width,
            "height": self.height,
            "declared": self.declared,
            "gaps": self.gaps,
            "sharpness": self.sharpness.tolist(),
            "motion": [None if np.isnan(step) else step for step in self.motion.tolist()],
            "exposure": self.exposure.tolist(),
            "seconds": list(self.seconds),
            "whole": self.whole.tolist(),
            "notices": list(self.notices),
        }

    @classmethod
    def from_json(cls, value: dict[str, Any]) -> Scan:
        """Returns what `to_json` was made of."""
        motion = [np.nan if step is None else step for step in value["motion"]]
        return cls(
            width=value["width"],
            height=value["height"],
            declared=value["declared"],
            gaps=value["gaps"],
            sharpness=np.array(value["sharpness"], np.float64),
            motion=np.array(motion, np.float64),
            exposure=np.array(value["exposure"], np.float64).reshape(-1, 3),
            seconds=tuple(value["seconds"]),
            whole=np.array(value["whole"], np.bool_),
            notices=tuple(value["notices"]),
        )


@dataclass(frozen=True)
class _Look:
    """What is kept of one frame."""

    sharpness: float
    motion: float
    exposure: tuple[float, float, float]
    seconds: float | None
    pts: int | None
    key: bool
    bidirectional: bool
    corrupt: bool
    interlaced: bool


def scan_video(path: Path, *, threads: int, step: Callable[[], None]) -> Scan:
    """Returns the scan of a video; the same one for any number of threads.

    A damaged stream is scanned again by one thread: only then is it certain which frames come out
    around the damage, here and when they are decoded again (`decode_threads`).

    Args:
        path: the video.
        threads: decoder threads.
        step: called after each frame.

    Raises:
        InputError: the file is no video, or no frame of it can be decoded.
    """
    scan = _scan_once(path, threads=threads, step=step)
    if scan.lost and threads > 1:
        scan = _scan_once(path, threads=1, step=step)
    return scan


def decode_threads(scan: Scan, threads: int) -> int:
    """Returns with how many threads a scanned video gives the frames of its scan again."""
    return 1 if scan.lost else threads


def _scan_once(path: Path, *, threads: int, step: Callable[[], None]) -> Scan:
    looks: list[_Look] = []
    gaps: list[tuple[int, int | None]] = []  # (frames seen before it, pts)
    first: Picture | None = None
    meter = MotionMeter()
    for item in decode(path, threads=threads):
        if isinstance(item, Gap):
            gaps.append((len(looks), item.pts))
            continue
        first = first or item
        looks.append(_look(item, meter))
        step()
    if first is None:
        raise _undecodable(path)
    width, height = first.size
    claim = claimed_length(path)
    return Scan(
        width=width,
        height=height,
        declared=claim.count(_rate(looks) or claim.rate),
        gaps=len(gaps),
        sharpness=np.array([look.sharpness for look in looks], np.float64),
        motion=np.array([look.motion for look in looks], np.float64),
        exposure=np.round([look.exposure for look in looks], 4),
        seconds=tuple(look.seconds for look in looks),
        whole=_whole(looks, gaps),
        notices=done_to(path, first, sum(look.interlaced for look in looks)),
    )


def _undecodable(path: Path) -> InputError:
    with open_video(path) as (_, stream):
        codec = stream.codec_context.name
    return InputError(
        f"No frame of {path} can be decoded; its codec is {codec}.",
        hint=f"Copy it from the camera again. {convert_hint(path)}")


def _look(picture: Picture, meter: MotionMeter) -> _Look:
    gray, frame = picture.gray(), picture.frame
    return _Look(
        sharpness=sharpness(gray),
        motion=meter.advance(gray),
        exposure=exposure(gray),
        seconds=frame.time,
        pts=frame.pts,
        key=bool(frame.key_frame),
        bidirectional=frame.pict_type == PictureType.B,
        corrupt=bool(frame.is_corrupt),
        interlaced=picture.interlaced,
    )


def _rate(looks: Sequence[_Look]) -> float:
    """Returns the mean frames per second that were seen, 0 where there are no times to tell."""
    first, last = looks[0].seconds, looks[-1].seconds
    if first is None or last is None or last <= first:
        return 0.0
    return (len(looks) - 1) / (last - first)


def sharpness(gray: NDArray[np.uint8]) -> float:
    """Returns the variance of the Laplacian of a gray frame [H, W] at a common size."""
    scale = SHARPNESS_SIZE / max(gray.shape)
    if scale < 1:
        gray = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(gray, cv2.CV_32F).var())


def _whole(
    looks: Sequence[_Look], gaps: Sequence[tuple[int, int | None]]
) -> NDArray[np.bool_]:  # [F]
    """Returns False for each frame that was predicted, at whatever remove, from lost data."""
    whole = np.ones(len(looks), np.bool_)
    for index, look in enumerate(looks):
        if look.corrupt:
            _spoil(whole, looks, index, index + 1)
    near = np.zeros(len(looks) + 2, np.bool_)  # with a place before the first and behind the last
    for seen, pts in gaps:
        after = seen
        if pts is not None:
            after = next((i for i, look in enumerate(looks) if (look.pts or 0) > pts), len(looks))
        _spoil(whole, looks, after, after)
        near[after:after + 2] = True
    # Deinterlacing looks at the frame on either side.
    near[2:] |= ~whole
    near[:-2] |= ~whole
    return whole & ~(near[1:-1] & [look.interlaced for look in looks])


def _spoil(whole: NDArray[np.bool_], looks: Sequence[_Look], first: int, search: int) -> None:
    """Clears the frames from `first` to the next key frame at or behind `search`."""
    end = next((i for i in range(search, len(looks)) if looks[i].key), len(looks))
    # B-frames shown before the damage are predicted from it as well.
    earliest = max(0, first - MAX_B_RUN)
    while first > earliest and looks[first - 1].bidirectional:
        first -= 1
    whole[first:end] = False
