"""How far the camera moves from frame to frame, in fractions of the image width.

Displacements are measured against an anchor frame that is replaced once the view has moved on.
Frame-to-frame sums would grow with the frame rate: tracking noise of .05 px, added up 60 times a
second, walks a tripod through the room.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

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
