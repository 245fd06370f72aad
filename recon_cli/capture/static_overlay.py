"""Finds overlays that stay in place in every frame: text, logos, dirt on the lens, a bonnet.

While the view moves, the edges of a scene pass over a pixel in all directions and cancel each other
in the mean; those of an overlay add up, in every part of the video. Views are compared only once
the scene has moved on, so that a camera that stands still says nothing. What is left out: things
that the camera carries along loosely, like a hand, clocks, whose digits change, and overlays that
are shown for a part of the video only.
"""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.capture.frame_measures import shrink
from recon_cli.io.images import read_image, write_png

PICTURE = "overlay.png"  # a frame with the masked area in red
# Pixels of the longer side on which edges are compared; strokes of small text are still 1 px wide.
SIZE = 480
SMOOTH = 0.8  # pixels; sigma against noise and the blocks of the codec
# An edge of this many gray values a pixel counts half as much as the strongest.
SOFT_EDGE = 2.0
# A view counts once at most STILL of the last one's corners are where they were: the others were
# lost or moved by this share of the longer side, which takes edges of 2 to 3 pixels 19 pixels on.
MOVED, STILL = 0.04, 0.5
MIN_VIEWS = 20  # edges of fewer views agree by chance
MAX_PARTS = 8  # of the video in which the edges are added up, at 1 MB each
# Standard deviation of gray values, over a view and over time. Where only noise changes, three
# quarters of the pixels vary by less; in walks they do by 41 to 85, before a bare wall by 4.
MIN_SPREAD = 8.0
# From this `OverlayMeter.strength` on an edge is static; chance alone gives some / sqrt(views).
# The 12th strongest pixel, times sqrt(views): 1.0 to 2.1 in 17 captures, 3.8 at a strength of .24
# for a drone's; with text, a logo and a bonnet over two of them 7.2 to 8.5, with blurred dirt of
# 40% 4.8 and 6.0. Checked over a third: 6.8 to 8.0, dirt 3.9 at a strength of .45.
STATIC, PER_ROOT = 0.35, 3.0
WEAKER = 0.7  # of that bound holds for pixels that adjoin
# Static pixels of an overlay. What is straight ahead in a walk without any sway stays in place too:
# up to 77 pixels in drawn corridors; none in the captures above, 232 to 2,600 in the overlays.
MIN_PIXELS = 120
MIN_EDGE, CLOSE = 12, 5  # pixels of one static edge, and of a gap in it that is closed
# A pixel whose gray values vary by a smaller share of what is usual in the frame is covered, and
# an area inside static edges by the median of its pixels.
COVERED, ENCLOSED = 0.2, 0.75
GROW = 3  # pixels around it, which windows of features and the codec mix with it
MOST = 0.5  # of the frame; whatever covers more was mistaken for an overlay
_TINT = np.array([255, 0, 0], np.float32)  # RGB


class OverlayMeter:
    """Takes the gray frames of a video and its corners, one by one."""

    def __init__(self) -> None:
        self._numbers = np.zeros(0, np.int32)  # corners of the last view
        self._corners = np.zeros((0, 2), np.float32)
        self._parts: list[NDArray[np.float32]] = []  # [2, h, w], sums of edges over some views
        self._counts: list[int] = []  # views in each
        self._full = 1  # views in each part but the last
        self._gray = np.zeros((2, 0, 0), np.float32)  # [2, h, w], of the values and their squares
        self.views = 0

    def advance(
        self, gray: NDArray[np.uint8], numbers: NDArray[np.int32], corners: NDArray[np.float32]
    ) -> None:
        """Takes a frame [H, W] and its tracked corners: sorted numbers [K], shares of W, H [K, 2].

        All frames are of one size.
        """
        if self.views and not self._has_moved(gray.shape, numbers, corners):
            return
        self._numbers, self._corners = numbers, corners
        values = shrink(gray, SIZE).astype(np.float32)
        if values.std() < MIN_SPREAD:  # a darker view shows no overlay either
            return
        if not self.views:
            self._gray = np.zeros((2, *values.shape), np.float32)
        smooth = cv2.GaussianBlur(values, (0, 0), SMOOTH)
        # Scharr's weights add up to 32 gray values for a slope of one a pixel.
        across, down = (
            cv2.Scharr(smooth, cv2.CV_32F, dx, 1 - dx, scale=1 / 32) for dx in (1, 0))
        length = cv2.magnitude(across, down) + SOFT_EDGE
        self._add(np.stack([across / length, down / length]))
        self._gray += np.stack([smooth, smooth * smooth])
        self.views += 1

    def _add(self, edges: NDArray[np.float32]) -> None:
        """Adds the edges of a view [2, h, w] to the last part; halves the parts when too many."""
        if self._counts and self._counts[-1] < self._full:
            self._parts[-1] += edges
            self._counts[-1] += 1
            return
        if len(self._parts) == MAX_PARTS:
            self._parts = [self._parts[i] + self._parts[i + 1] for i in range(0, MAX_PARTS, 2)]
            self._full *= 2
            self._counts = [self._full] * len(self._parts)
        self._parts.append(edges)
        self._counts.append(1)

    def strength(self) -> NDArray[np.float32]:
        """Returns how long the mean edge is along that of all views, [h, w], at most 1.

        It is that of the part of the video where it is shortest.
        """
        whole = np.sum(self._parts, axis=0)
        along = whole / np.maximum(cv2.magnitude(whole[0], whole[1]), 1e-6)
        means = [(part * along).sum(axis=0) / count
                 for part, count in zip(self._parts, self._counts, strict=True)
                 if count > self._full / 2]
        return np.asarray(np.min(means, axis=0), np.float32)

    def overlay(self) -> NDArray[np.bool_] | None:  # [h, w]
        """Returns where something is fixed to the camera, at the reduced size; None if nowhere."""
        if self.views < MIN_VIEWS:
            return None
        bound = max(STATIC, PER_ROOT / math.sqrt(self.views))
        mean = np.sum(self._parts, axis=0) / self.views
        edges = _find_edges(self.strength(), cv2.magnitude(mean[0], mean[1]), bound)
        if not edges.any():
            return None
        gray, square = self._gray / self.views
        spread = np.sqrt(np.maximum(square - gray * gray, 0))
        usual = float(np.percentile(spread, 75))  # of the scene, even where half of it is covered
        if usual < MIN_SPREAD:
            return None
        covered = _fill(edges, spread, usual)
        return np.asarray(cv2.dilate(covered, _disk(GROW)), np.bool_)

    def _has_moved(
        self, shape: tuple[int, ...], numbers: NDArray[np.int32], corners: NDArray[np.float32]
    ) -> bool:
        _, before, after = np.intersect1d(
            self._numbers, numbers, assume_unique=True, return_indices=True)
        steps = (corners[after] - self._corners[before]) * (shape[1], shape[0])
        still = np.count_nonzero(np.hypot(steps[:, 0], steps[:, 1]) < MOVED * max(shape))
        return int(still) <= STILL * len(self._numbers)


def mask_overlay(
    overlay: NDArray[np.bool_], width: int, height: int
) -> NDArray[np.uint8]:  # [height, width]
    """Returns the mask of frames of this size: 255 where a pixel counts, 0 where one is covered."""
    covered = cv2.resize(overlay.astype(np.float32), (width, height))
    return np.where(covered > 0, 0, 255).astype(np.uint8)


def draw_overlay(frame: Path, mask: NDArray[np.uint8], path: Path) -> None:
    """Writes the picture of a frame with the pixels that its mask [H, W] leaves out in red."""
    rgb = read_image(frame, mask.shape[1], mask.shape[0]).astype(np.float32)
    rgb[mask == 0] = (rgb[mask == 0] + _TINT) / 2
    write_png(path, rgb.astype(np.uint8))


def _find_edges(
    strength: NDArray[np.float32], mean: NDArray[np.float32], bound: float
) -> NDArray[np.uint8]:
    """Returns the static edges, [h, w], closed, with the pixels that adjoin them.

    Those are found by the length of the mean edge of the whole video, [h, w]: soft dirt is hard to
    see in a part of it.
    """
    strong = strength > bound
    if np.count_nonzero(strong) < MIN_PIXELS:
        return np.zeros(strength.shape, np.uint8)
    weak = (mean > WEAKER * bound).astype(np.uint8)
    closed = cv2.morphologyEx(weak, cv2.MORPH_CLOSE, _disk(CLOSE // 2))
    count, labels = cv2.connectedComponents(closed)
    static = np.bincount(labels[strong], minlength=count) >= MIN_EDGE
    static[0] = False
    return static[labels].astype(np.uint8)


def _fill(
    edges: NDArray[np.uint8], spread: NDArray[np.float32], usual: float
) -> NDArray[np.uint8]:
    """Returns static edges with the areas that they belong to, both [h, w]."""
    # An opaque area: its pixels hardly vary.
    still = ((spread < COVERED * usual) | (edges > 0)).astype(np.uint8)
    count, labels = cv2.connectedComponents(still)
    adjoining = np.zeros(count, np.bool_)
    adjoining[labels[edges > 0]] = True
    covered = np.asarray(adjoining[labels], np.bool_)
    # A transparent one: edges, or the frame's border, enclose it, and it varies less than usual.
    count, labels = cv2.connectedComponents((~covered).astype(np.uint8), connectivity=4)
    scene = np.bincount(labels.ravel())[1:].argmax() + 1 if count > 1 else 0
    for label in set(range(1, count)) - {scene}:
        area = labels == label
        if np.median(spread[area]) < ENCLOSED * usual:
            covered |= area
    return covered.astype(np.uint8)


def _disk(radius: int) -> NDArray[np.uint8]:
    size = 2 * radius + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), np.uint8)
