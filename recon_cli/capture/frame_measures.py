"""Measures of every frame: sharpness, exposure, and how far the view moved."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.capture.limits import MEASURE_SIZE, MIN_TRACKS, RETURN_ERROR, TRACK_SIZE, WINDOW
from recon_cli.errors import InputError

Value = TypeVar("Value", np.uint8, np.float32)

TRACK_WIDTH = TRACK_SIZE // 2  # pixels; wide enough for corners, small enough for 5 ms a frame
ANCHOR_REACH = 0.03  # of the width, about 10 px: still well inside the tracker's basin
# Corners as in Shi and Tomasi; their spacing spreads 300 of them over the frame.
MAX_CORNERS, CORNER_QUALITY, CORNER_SPACING = 300, 0.005, 6
# Gray values of 8 bits; a codec moves true black and white by a few.
UNCLIPPED = (16, 250)
# More than this and the frame is clipped: it is avoided where neighbours are better.
MOST_CLIPPED = 0.5
# More than this and nothing in the frame can be matched: it is never chosen.
ALL_CLIPPED = 0.95
# A frame whose areas differ by a smaller standard deviation (gray values) is flat: a wall, a cap.
FLAT = 4.0
AREAS = 32  # along each side
EVERY = 4  # pixels; a share is known well enough from every 16th


def shrink(image: NDArray[Value], longest: int) -> NDArray[Value]:
    """Returns an image [H, W, ...] reduced by area to so many pixels on its longer side.

    `io.images.fit_image` fits its sides to whole pixels instead, which shifts edges by a fraction.
    """
    scale = longest / max(image.shape[:2])
    if scale >= 1:
        return image
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.asarray(small, image.dtype)


class MotionMeter:
    """Follows corners through a video, one gray frame at a time.

    Args:
        hidden: [h, w] where a frame, at any size, shows nothing of the scene; None for nowhere.
    """

    def __init__(self, hidden: NDArray[np.bool_] | None = None) -> None:
        self._hidden = hidden
        self._anchor: NDArray[np.uint8] | None = None
        self._corners: NDArray[np.float32] | None = None
        self._reached = 0.0  # furthest displacement from the anchor so far
        self.followed = 0.0  # share of the anchor's corners that the last frame shows

    def advance(self, gray: NDArray[np.uint8]) -> float:
        """Returns how much further from the anchor this frame is than any frame since the anchor.

        That is the median displacement of the next frame [H, W] as a fraction of the width; 0 for
        the first frame and one that moves back; NaN where too few corners can be followed.
        """
        small, (height, width) = gray, gray.shape
        if width > TRACK_WIDTH:
            size = (TRACK_WIDTH, max(1, round(height * TRACK_WIDTH / width)))
            small = np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), np.uint8)
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
            small, MAX_CORNERS, CORNER_QUALITY, CORNER_SPACING,
            mask=None if self._hidden is None else _visible(self._hidden, small.shape))
        self._reached = 0.0

    def _displacement(self, small: NDArray[np.uint8]) -> float:
        """Returns the median displacement of the anchor's corners, NaN where most are lost."""
        self.followed = 0.0
        if self._corners is None or len(self._corners) < MIN_TRACKS:
            return float("nan")
        # on four levels of a pyramid, as OpenCV has it, windows follow about 40 px at this width
        tracked, forward, _ = cv2.calcOpticalFlowPyrLK(
            self._anchor, small, self._corners, None, winSize=WINDOW)
        returned, backward, _ = cv2.calcOpticalFlowPyrLK(
            small, self._anchor, tracked, None, winSize=WINDOW)
        # Tracking a corner back must end where it began; on a blank wall the tracker slides.
        error = np.linalg.norm((returned - self._corners).reshape(-1, 2), axis=1)
        good = (forward & backward)[:, 0].astype(bool) & (error <= RETURN_ERROR)
        self.followed = float(good.mean())
        if good.sum() < MIN_TRACKS:
            return float("nan")
        steps = np.linalg.norm((tracked - self._corners)[good].reshape(-1, 2), axis=1)
        return float(np.median(steps) / small.shape[1])


def measure_exposure(gray: NDArray[np.uint8]) -> tuple[float, float, float]:
    """Returns the shares of black and of blown-out pixels of a frame [H, W], and its spread.

    The spread is the standard deviation over 32x32 areas, in gray values of 8 bits.
    """
    few = gray[::EVERY, ::EVERY]
    areas = cv2.resize(gray, (AREAS, AREAS), interpolation=cv2.INTER_AREA)
    black, blown_out = few <= UNCLIPPED[0], few >= UNCLIPPED[1]
    return float(np.mean(black)), float(np.mean(blown_out)), float(areas.std())


def well_exposed(exposures: NDArray[np.float64]) -> NDArray[np.bool_]:  # [F]
    """Returns which frames are not black or blown out for the most part, by `measure_exposure`."""
    return np.asarray(exposures[:, :2].sum(axis=1) <= MOST_CLIPPED)


def has_content(exposures: NDArray[np.float64]) -> NDArray[np.bool_]:  # [F]
    """Returns which frames are neither all clipped nor flat, by rows of `measure_exposure`."""
    visible = exposures[:, :2].sum(axis=1) <= ALL_CLIPPED
    return np.asarray(visible & (exposures[:, 2] >= FLAT))


def check_exposure(
    name: str, exposures: NDArray[np.float64], *, least: int, unit: str = "frames"
) -> None:
    """Raises InputError when fewer than `least` of the `unit` of a capture show anything.

    `exposures` [F, 3] are rows of `measure_exposure` for all frames that could be read.
    """
    usable = int(has_content(exposures).sum())
    if usable >= least:
        return
    black, blown, _ = exposures.T
    kinds: Sequence[tuple[str, NDArray[np.bool_], str]] = (
        ("too dark", black > MOST_CLIPPED, "Turn on the light, remove the lens cap, and record "
         "again; a dark but clean recording can be brightened in an editor first."),
        ("over-exposed", blown > MOST_CLIPPED, "Record again with less exposure: tap on a bright "
         "part of the room before you start."),
        ("flat", ~has_content(exposures), "Record again with furniture, edges and texture in view; "
         "bare walls cannot be reconstructed."))
    kind, hit, hint = next((row for row in kinds if row[1].sum() * 2 > len(black)), kinds[-1])
    raise InputError(
        f"{name} is {kind}: {int(hit.sum())} of its {len(black)} {unit}. Only {usable} show "
        f"anything that can be matched, but at least {least} are needed.", hint=hint)


def measure_sharpness(
    gray: NDArray[np.uint8], hidden: NDArray[np.bool_] | None = None
) -> float:
    """Returns the variance of the Laplacian of a gray frame [H, W] at a common size.

    `hidden` [h, w], at any size, leaves out pixels that do not show the scene.
    """
    gray = shrink(gray, MEASURE_SIZE)
    edges = np.asarray(cv2.Laplacian(gray, cv2.CV_32F))
    return float((edges if hidden is None else edges[_visible(hidden, gray.shape) > 0]).var())


def _visible(hidden: NDArray[np.bool_], shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """Returns 255 where a frame of `shape` shows the scene, else 0."""
    seen = np.where(hidden, 0, 255).astype(np.uint8)
    return np.asarray(cv2.resize(
        seen, (shape[1], shape[0]), interpolation=cv2.INTER_NEAREST), np.uint8)
