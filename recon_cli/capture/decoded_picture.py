"""A decoded frame as it is displayed: deinterlaced, in sRGB, with square pixels, upright.

Pixels that are not square are stretched along the width, as players do. Of a display matrix the
nearest of the eight orientations is applied, mirrored ones too; where it stretches, FFmpeg gives
that as the aspect of the pixels.
"""

from __future__ import annotations

import math
import struct
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from itertools import product

import av
import cv2
import numpy as np
from av.buffer import Buffer
from av.filter import Graph
from av.video.reformatter import ColorRange, Colorspace, Interpolation
from av.video.stream import VideoStream
from numpy.typing import NDArray

from recon_cli.capture.video_colour import (
    BT2020,
    TRANSFERS,
    WIDE_GAMUTS,
    Transfer,
    gray_table,
    to_srgb,
)

UNSPECIFIED, RESERVED = 2, 3  # codes of H.273
# Players take untagged video of more than standard definition as BT.709 (mpv: csputils.c).
SD_WIDTH, SD_HEIGHT = 1280, 576
# Without these, swscale truncates, and repeats chroma instead of interpolating it. Frames of a
# rendered video: 1.0 of 255 too dark and 38.4 dB; with these 0.1 and 39.0 dB, 1.6 times the cost.
ROUNDED = Interpolation.BILINEAR | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT
# Planes: with these flags packed RGB of 16 bits (rgb48le) is garbage for 4:2:0 (swscale 9.5).
DEEP = "gbrp16le"
# swscale's white at 16 bits of limited range (255 * 256), and of full range as far as 8 bits go.
WHITE = 65280
# H.273, table 4: how RGB became YCbCr. swscale converts RGB itself (0), BT.709, FCC, BT.601 (5 and
# 6), SMPTE 240M and BT.2020; these it refuses.
UNSUPPORTED_MATRICES = {
    8: "YCgCo", 10: "BT.2020 with constant luminance", 11: "SMPTE ST 2085",
    12: "derived from the primaries", 13: "derived from the primaries", 14: "ICtCp",
    15: "IPT-PQ-C2", 16: "YCgCo-Re", 17: "YCgCo-Ro"}
# One frame per frame, not per field: the rows of the first field stay as recorded.
BWDIF = "mode=send_frame:parity=auto:deint=interlaced"


@dataclass(frozen=True)
class Gap:
    """A packet that gave no frame; `pts` is its place in the stream's time base, if known."""

    pts: int | None


@dataclass(frozen=True)
class Orientation:
    """How a stored picture is turned and mirrored for display: transposed first, then mirrored."""

    transposed: bool = False  # rows become columns
    flip_x: bool = False  # left becomes right
    flip_y: bool = False  # top becomes bottom

    @property
    def mirrored(self) -> bool:
        """Whether writing is reversed, which no rotation does."""
        return self.transposed ^ self.flip_x ^ self.flip_y

    def apply(self, pixels: NDArray[np.generic]) -> NDArray[np.uint8]:
        """Returns pixels [H, W, ...] as displayed."""
        if self.transposed:
            pixels = pixels.swapaxes(0, 1)
        return np.ascontiguousarray(
            pixels[::-1 if self.flip_y else 1, ::-1 if self.flip_x else 1], np.uint8)


# Rotations before mirrored ones: the first of equally near ones is taken.
ORIENTATIONS = tuple(
    Orientation(transposed, flip_x, flip_y) for mirrored in (False, True)
    for transposed, flip_x, flip_y in product((False, True), repeat=3)
    if transposed ^ flip_x ^ flip_y == mirrored)


def nearest_orientation(a: float, b: float, c: float, d: float) -> Orientation:
    """Returns the orientation that is nearest to x' = a x + c y, y' = b x + d y.

    The lengths of the columns do not count. Of orientations that are equally near (of zeros, all
    eight) the first is taken: as stored, if it is among them.
    """
    across, down = math.hypot(a, c) or 1, math.hypot(b, d) or 1

    def likeness(shape: Orientation) -> float:
        x, y = (-1 if shape.flip_x else 1) / across, (-1 if shape.flip_y else 1) / down
        return round(c * x + b * y if shape.transposed else a * x + d * y, 6)

    return max(ORIENTATIONS, key=likeness)


@dataclass(frozen=True)
class Tags:
    """How the frames of a file are to be displayed."""

    aspect: Fraction = Fraction(1)  # width of a pixel over its height
    transfer: Transfer | None = None  # None for SDR
    primaries: int = UNSPECIFIED  # H.273 code
    orientation: Orientation = Orientation()


def read_tags(stream: VideoStream, frame: av.VideoFrame) -> Tags:
    """Returns how the frames of a video stream are to be displayed; `frame` is its first one."""
    context = stream.codec_context
    return Tags(
        # The container's value, else the codec's; 0 where neither has one.
        stream.sample_aspect_ratio or Fraction(1),
        TRANSFERS.get(int(context.color_trc)), int(context.color_primaries),
        nearest_orientation(*_display_matrix(frame)))


def _display_matrix(frame: av.VideoFrame) -> tuple[float, float, float, float]:
    """Returns a, b, c, d of x' = a x + c y, y' = b x + d y."""
    try:
        data = frame.side_data.get("DISPLAYMATRIX")
    except ValueError:  # PyAV cannot list side data of a kind that it does not know
        turn = math.radians(frame.rotation)  # counterclockwise; y points down
        return math.cos(turn), -math.sin(turn), math.sin(turn), math.cos(turn)
    if not isinstance(data, Buffer):
        return 1, 0, 0, 1
    a, b, _, c, d = struct.unpack("=5i", bytes(data)[:20])
    return a, b, c, d


@dataclass(frozen=True, eq=False)
class DecodedPicture:
    """A decoded frame."""

    frame: av.VideoFrame  # deinterlaced, if it was interlaced
    tags: Tags = Tags()
    interlaced: bool = False  # its two fields were taken at different times

    @property
    def square_size(self) -> tuple[int, int]:
        """Width and height with square pixels, before rotation."""
        return max(1, round(self.frame.width * self.tags.aspect)), self.frame.height

    @property
    def size(self) -> tuple[int, int]:
        """Width and height as displayed."""
        width, height = self.square_size
        return (height, width) if self.tags.orientation.transposed else (width, height)

    def rgb(self) -> NDArray[np.uint8]:
        """Returns the frame as displayed: upright 8-bit full-range RGB [H, W, 3], HDR as SDR."""
        transfer, primaries, white = self.tags.transfer, self.tags.primaries, self._white()
        # To bytes swscale takes full range of more than 8 bits with this white, too: 1 of 255 off.
        if transfer is None and primaries not in WIDE_GAMUTS and white == WHITE:
            return self.tags.orientation.apply(self._colours("rgb24"))
        signal = np.asarray(self._colours(DEEP), np.uint16)
        return self.tags.orientation.apply(
            to_srgb(signal, transfer, primaries=primaries, white=white))

    def gray(self) -> NDArray[np.uint8]:
        """Returns the frame's gray values, upright, [H, W]; of HDR those of neutral colours.

        They weight R, G and B as BT.601 does, for any matrix: swscale's gray has no other.
        """
        gray = self._reformat("gray", Colorspace.ITU601 if self._untagged() else None)
        if self.tags.transfer is not None:
            gray = cv2.LUT(gray, gray_table(self.tags.transfer))
        return self.tags.orientation.apply(gray)

    def _colours(self, pixels: str) -> NDArray[np.generic]:
        return self._reformat(pixels, self._guessed_matrix() if self._untagged() else None, ROUNDED)

    def _reformat(
        self, pixels: str, matrix: Colorspace | None, interpolation: Interpolation | None = None,
    ) -> NDArray[np.generic]:
        return self.frame.reformat(
            width=self.square_size[0], format=pixels, src_colorspace=matrix,
            dst_colorspace=matrix, interpolation=interpolation).to_ndarray()

    def _untagged(self) -> bool:
        return self.frame.colorspace in (UNSPECIFIED, RESERVED)

    def _guessed_matrix(self) -> Colorspace:
        """Returns the matrix that players take where the frame names none."""
        if self.tags.transfer is not None or self.tags.primaries == BT2020:
            return Colorspace.BT2020
        large = self.frame.width >= SD_WIDTH or self.frame.height > SD_HEIGHT
        return Colorspace.ITU709 if large else Colorspace.ITU601

    def _white(self) -> int:
        """Returns swscale's white at 16 bits: full range of n bits ends at 2^n - 1 of 2^n."""
        full = self.frame.color_range == ColorRange.JPEG
        depth = self.frame.format.components[0].bits
        return 65536 - (1 << 16 - depth) if full and not self.frame.format.is_rgb else WHITE


def deinterlace(
    items: Iterable[av.VideoFrame | Gap],  # frames of one size in presentation order, and gaps
) -> Iterator[tuple[av.VideoFrame, bool] | Gap]:
    """Yields each frame deinterlaced and whether it was interlaced; gaps keep their place."""
    deinterlacer: _Deinterlacer | None = None
    for item in items:
        if deinterlacer is None and isinstance(item, av.VideoFrame) and item.interlaced_frame:
            deinterlacer = _Deinterlacer(item)
        if deinterlacer is not None:
            yield from deinterlacer.put(item)
        else:
            yield item if isinstance(item, Gap) else (item, False)
    if deinterlacer is not None:
        yield from deinterlacer.put(None)


class _Deinterlacer:
    """A filter graph, which is one frame late, and the items that wait for it."""

    def __init__(self, first: av.VideoFrame) -> None:
        self._waiting: deque[av.VideoFrame | Gap] = deque()
        self._graph = Graph()
        source = self._graph.add("buffer", ":".join((
            f"video_size={first.width}x{first.height}", f"pix_fmt={first.format.name}",
            f"time_base={first.time_base}", "pixel_aspect=1/1",
            f"colorspace={first.colorspace}", f"range={first.color_range}")))
        bwdif = self._graph.add("bwdif", BWDIF)
        self._graph.link_nodes(source, bwdif, self._graph.add("buffersink")).configure()

    def put(self, item: av.VideoFrame | Gap | None) -> Iterator[tuple[av.VideoFrame, bool] | Gap]:
        """Yields the items that are ready after the next one; None ends the frames."""
        if item is not None:
            self._waiting.append(item)
        if not isinstance(item, Gap):
            self._graph.vpush(item)
        while self._waiting:
            oldest = self._waiting[0]
            if isinstance(oldest, Gap):
                yield oldest
            else:
                try:
                    frame = self._graph.vpull()
                except (av.error.BlockingIOError, av.error.EOFError):
                    return
                # The filter counts in half frames.
                frame.pts, frame.time_base = oldest.pts, oldest.time_base
                yield frame, oldest.interlaced_frame
            self._waiting.popleft()
