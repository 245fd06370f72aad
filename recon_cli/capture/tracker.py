"""Follows corners through every frame of a video (Lucas and Kanade 1981, Shi and Tomasi 1994).

Between two frames of a video nothing can be mistaken for something else that looks alike, so what
these tracks say of two frames holds where matches of features are fooled.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.capture.frame_measures import shrink
from recon_cli.capture.limits import RETURN_ERROR, TRACK_SIZE, WINDOW
from recon_cli.io.tracks import Tracks

# A cell of this many pixels holds a corner, its best one: plain walls get what they have, too.
CELL = 20
# Smallest eigenvalue (Shi and Tomasi) of a corner over 7 x 7 pixels. A tenth of it doubled the
# time by corners that were lost in the next frame.
MIN_EIGENVALUE, BLOCK = 1e-4, 7
# New corners are searched for when fewer than this share of those after the last search are left,
# and after so many frames at the latest: what comes to light pushes no corner out of view.
TOP_UP, EVERY = 0.6, 5
LEVELS = 4  # of the pyramid follow fast turns: 1.4 times the tracks that 3 keep
BACK_LEVELS = 1  # the way back starts where it should end
CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 15, 0.03)
# Mean difference of the gray values in a window. 90% of the corners of four videos stay below 6 to
# 16; of the few that find something alike beyond a cut, half are above it.
MAX_DIFFERENCE = 25.0
MARGIN = BLOCK // 2  # pixels at the border, where windows are cut off
MERGED = 4  # pixels; of two tracks in one cell of this size the older is kept
# Exposure changes from frame to frame; contrast by areas takes that off (CLAHE).
CLIP_LIMIT = 2.0


class Tracker:
    """Takes the gray frames of a video one by one."""

    def __init__(self) -> None:
        self._equalise = cv2.createCLAHE(CLIP_LIMIT)
        self._last: NDArray[np.uint8] | None = None
        self._corners = np.zeros((0, 2), np.float32)
        self._numbers = np.zeros(0, np.int32)  # sorted, as new ones come last
        self._count = 0  # tracks so far
        self._full = 0  # corners after the last search
        self._seen: list[tuple[NDArray[np.int32], NDArray[np.float32]]] = []

    def advance(self, gray: NDArray[np.uint8]) -> None:
        """Follows the corners into the next frame, [H, W]; all frames are of one size."""
        gray = np.asarray(self._equalise.apply(shrink(gray, TRACK_SIZE)), np.uint8)
        if self._last is not None and len(self._corners):
            self._follow(self._last, gray)
        if len(self._seen) % EVERY == 0 or len(self._corners) < TOP_UP * self._full:
            self._top_up(gray)
        self._last = gray
        size = np.array(gray.shape[::-1], np.float32)
        self._seen.append((self._numbers, (self._corners + np.float32(0.5)) / size))

    @property
    def corners(self) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """The tracks in the last frame: sorted numbers [K], and shares of width and height [K, 2].

        IndexError before the first frame.
        """
        return self._seen[-1]

    def tracks(self) -> Tracks:
        """Returns the tracks through all frames so far; a frame is named by its number."""
        counts = [len(numbers) for numbers, _ in self._seen]
        return Tracks(
            tuple(map(str, range(len(counts)))),
            np.repeat(np.arange(len(counts), dtype=np.int32), counts),
            np.concatenate([np.zeros(0, np.int32), *(numbers for numbers, _ in self._seen)]),
            np.concatenate([np.zeros((0, 2), np.float32), *(xy for _, xy in self._seen)]))

    def _follow(self, last: NDArray[np.uint8], gray: NDArray[np.uint8]) -> None:
        start = self._corners
        ahead, forward, difference = cv2.calcOpticalFlowPyrLK(
            last, gray, start, None, winSize=WINDOW, maxLevel=LEVELS, criteria=CRITERIA)
        back, backward, _ = cv2.calcOpticalFlowPyrLK(
            gray, last, ahead, start.copy(), winSize=WINDOW, maxLevel=BACK_LEVELS,
            criteria=CRITERIA, flags=cv2.OPTFLOW_USE_INITIAL_FLOW)
        inside = ((ahead >= MARGIN) & (ahead < np.array(gray.shape[::-1]) - MARGIN)).all(axis=1)
        good = np.flatnonzero(
            inside & (forward[:, 0] == 1) & (backward[:, 0] == 1)
            & (difference[:, 0] < MAX_DIFFERENCE)
            & (np.abs(back - start).max(axis=1) < RETURN_ERROR))
        _, oldest = np.unique(ahead[good] // MERGED, axis=0, return_index=True)
        rows = good[np.sort(oldest)]
        self._corners, self._numbers = ahead[rows], self._numbers[rows]

    def _top_up(self, gray: NDArray[np.uint8]) -> None:
        corners = find_corners(gray)
        near = np.zeros(len(corners), np.bool_)
        if len(self._corners):
            far = np.abs(corners[:, None] - self._corners).max(axis=2).min(axis=1)
            near = far < CELL / 2
        new = corners[~near]
        self._corners = np.concatenate([self._corners, new])
        self._numbers = np.concatenate([
            self._numbers, np.arange(self._count, self._count + len(new), dtype=np.int32)])
        self._count += len(new)
        self._full = len(self._corners)


def find_corners(gray: NDArray[np.uint8]) -> NDArray[np.float32]:  # [K, 2]
    """Returns the best corner of each cell of a frame [H, W], in pixels; plain cells have none."""
    quality = cv2.cornerMinEigenVal(gray, BLOCK)
    quality[:MARGIN] = quality[-MARGIN:] = quality[:, :MARGIN] = quality[:, -MARGIN:] = 0
    rows, columns = -(-gray.shape[0] // CELL), -(-gray.shape[1] // CELL)
    padded = np.zeros((rows * CELL, columns * CELL), np.float32)
    padded[:gray.shape[0], :gray.shape[1]] = quality
    cells = padded.reshape(rows, CELL, columns, CELL).transpose(0, 2, 1, 3).reshape(-1, CELL * CELL)
    best = cells.argmax(axis=1)
    good = np.flatnonzero(cells[np.arange(len(cells)), best] > MIN_EIGENVALUE)
    y, x = good // columns * CELL + best[good] // CELL, good % columns * CELL + best[good] % CELL
    return np.stack([x, y], axis=1).astype(np.float32)
