"""A decoded frame as it is displayed: deinterlaced, in sRGB, with square pixels, upright.

Of 3D video it is the view of the left eye alone. Pixels that are not square are stretched along the
width, as players do. Of a display matrix the nearest of the eight orientations is applied, mirrored
ones too; where it stretches, FFmpeg gives that as the aspect of the pixels.
"""

from __future__ import annotations

import math
import struct
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import Enum
from fractions import Fraction
from itertools import product

import av
import cv2
import numpy as np
from av.buffer import Buffer
from av.filter import Graph
from av.video.reformatter import (
    ColorPrimaries,
    ColorRange,
    Colorspace,
    ColorTrc,
    Interpolation,
)
from av.video.stream import VideoStream
from numpy.typing import NDArray

from recon_cli.capture.limits import SAME_SHAPE
from recon_cli.capture.video_colour import (
    BT2020,
    TRANSFERS,
    WIDE_GAMUTS,
    Transfer,
    full_range_white,
    gray_table,
    to_srgb,
)

# Players take untagged video of more than standard definition as BT.709 (mpv: csputils.c).
SD_SIZE = (1280, 576)
# Without these, swscale truncates, and repeats chroma instead of interpolating it. Frames of a
# rendered video: 1.0 of 255 too dark and 38.4 dB; with these 0.1 and 39.0 dB, 1.6 times the cost.
ROUNDED = Interpolation.BILINEAR | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT
# Planes: with these flags packed RGB of 16 bits (rgb48le) is garbage for 4:2:0 (swscale 9.5).
DEEP = "gbrp16le"
WHITE = full_range_white(8)  # swscale's at 16 bits, of limited range too
# H.273, table 4: how RGB became YCbCr. swscale converts RGB itself (0), BT.709, FCC, BT.601 (5 and
# 6), SMPTE 240M and BT.2020; these it refuses.
UNSUPPORTED_MATRICES = {
    8: "YCgCo", 10: "BT.2020 with constant luminance", 11: "SMPTE ST 2085",
    12: "derived from the primaries", 13: "derived from the primaries", 14: "ICtCp",
    15: "IPT-PQ-C2", 16: "YCgCo-Re", 17: "YCgCo-Ro"}
# One frame per frame, not per field: the rows of the first field stay as recorded.
BWDIF = "mode=send_frame:parity=auto:deint=interlaced"
_UNTAGGED = (ColorTrc.UNSPECIFIED, 3)  # codes of H.273 for primaries, curves and matrices
USUAL_SHAPE = 16 / 9  # of the view of one eye


@dataclass(frozen=True)
class LostPacket:
    """A packet that gave no frame; `pts` is its place in the stream's time base, if known."""

    pts: int | None
    other_size: tuple[int, int] | None = None  # of a whole frame, of another shape than the others


class Packing(Enum):
    """How the views of both eyes share a frame; values of AVStereo3DType (libavutil/stereo3d.h)."""

    SIDE_BY_SIDE = 1
    TOP_AND_BOTTOM = 2
    CHECKERBOARD = 4
    QUINCUNX = 5
    ROWS = 6
    COLUMNS = 7

    @property
    def words(self) -> str:
        """The name in messages."""
        return self.name.lower().replace("_", " ")


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
    primaries: int = ColorPrimaries.UNSPECIFIED  # H.273 code
    orientation: Orientation = Orientation()
    packing: Packing | None = None  # None where a frame is one view
    transfer_code: int = ColorTrc.UNSPECIFIED  # H.273
    right_first: bool = False  # the view of the right eye is at the left or at the top
    size: tuple[int, int] | None = None  # to which frames are scaled, as stored; None for their own


def read_tags(stream: VideoStream, frame: av.VideoFrame) -> Tags:
    """Returns how the frames of a video stream are to be displayed; `frame` is its first one."""
    context = stream.codec_context
    # The container's value, else the codec's; 0 where neither has one.
    aspect = stream.sample_aspect_ratio or Fraction(1)
    packing, right_first = read_packing(frame)
    if packing is not None:
        aspect *= _unsqueeze(frame.width * aspect / frame.height, packing)
    return Tags(
        aspect, TRANSFERS.get(int(context.color_trc)), int(context.color_primaries),
        nearest_orientation(*_display_matrix(frame)), packing=packing, right_first=right_first,
        transfer_code=int(context.color_trc))


def read_side_data(frame: av.VideoFrame, kind: str) -> bytes | None:
    """Returns the side data of a frame by FFmpeg's name; that of the container is on each frame.

    None without it, and where the frame has some of a kind that PyAV does not know.
    """
    try:
        data = frame.side_data.get(kind)
    except ValueError:  # PyAV then lists none
        return None
    return bytes(data) if isinstance(data, Buffer) else None


def read_packing(frame: av.VideoFrame) -> tuple[Packing | None, bool]:
    """Returns how a frame holds two views by its tag, and whether the right eye's comes first.

    It is the SEI of frame packing (H.264 and HEVC), st3d in MP4, or StereoMode in Matroska.
    """
    data = read_side_data(frame, "STEREO3D")
    if data is None:
        return None, False
    kind, flags = struct.unpack_from("=ii", data)
    packed = next((one for one in Packing if one.value == kind), None)
    return packed, bool(flags & 1)  # AV_STEREO3D_FLAG_INVERT


def _unsqueeze(shape: Fraction, packing: Packing) -> Fraction:
    """Returns what the width of a pixel must be multiplied by in a frame of width / height `shape`.

    Nothing says whether two views were squeezed to share a frame of the usual shape, or stand in
    one of twice the size. Taken is what gives a view the shape that is nearer to 16:9.
    """
    part = Fraction(1, 2) if packing is Packing.SIDE_BY_SIDE else Fraction(2)
    squeezed, whole = (abs(math.log(one / USUAL_SHAPE)) for one in (shape, shape * part))
    return 1 / part if squeezed < whole else Fraction(1)


def _display_matrix(frame: av.VideoFrame) -> tuple[float, float, float, float]:
    """Returns a, b, c, d of x' = a x + c y, y' = b x + d y."""
    data = read_side_data(frame, "DISPLAYMATRIX")
    if data is None:  # PyAV gives the angle in any case
        turn = math.radians(frame.rotation)  # counterclockwise; y points down
        return math.cos(turn), -math.sin(turn), math.sin(turn), math.cos(turn)
    a, b, _, c, d = struct.unpack_from("=5i", data)
    return a, b, c, d


@dataclass(frozen=True, eq=False)
class DecodedPicture:
    """A decoded frame."""

    frame: av.VideoFrame  # deinterlaced, if it was interlaced
    tags: Tags = Tags()
    interlaced: bool = False  # its two fields were taken at different times

    @property
    def _whole_size(self) -> tuple[int, int]:
        """Width and height with square pixels of all views, before rotation."""
        width, height = self.tags.size or (self.frame.width, self.frame.height)
        return max(1, round(width * self.tags.aspect)), height

    @property
    def _view(self) -> tuple[slice, slice]:
        """Rows and columns of the picture that count: those of the left eye in 3D video."""
        width, height = self._whole_size
        axes = [slice(0, height), slice(0, width)]
        if self.tags.packing is not None:
            axis = int(self.tags.packing is Packing.SIDE_BY_SIDE)
            half = max(1, (height, width)[axis] // 2)
            axes[axis] = slice(half, 2 * half) if self.tags.right_first else slice(0, half)
        return axes[0], axes[1]

    @property
    def square_size(self) -> tuple[int, int]:
        """Width and height with square pixels, before rotation."""
        rows, columns = self._view
        return columns.stop - columns.start, rows.stop - rows.start

    @property
    def fits(self) -> bool:
        """Whether the frame has the shape of those that it is scaled to."""
        width, height = self.tags.size or (1, 1)
        shape = self.frame.width * height / (self.frame.height * width)
        return self.tags.size is None or abs(shape - 1) <= SAME_SHAPE

    @property
    def size(self) -> tuple[int, int]:
        """Width and height as displayed."""
        width, height = self.square_size
        return (height, width) if self.tags.orientation.transposed else (width, height)

    @property
    def may_be_log(self) -> bool:
        """Whether the tags say that the signal is logarithmic, or leave it open as log video does.

        Phones write log (Apple Log and others) with the primaries of BT.2020 and no transfer.
        """
        code = self.tags.transfer_code
        return code in (ColorTrc.LOG, ColorTrc.LOG_SQRT) or (
            self.tags.primaries == BT2020 and code in (0, *_UNTAGGED))

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
        gray = self._reformat("gray", Colorspace.ITU601 if self._is_untagged else None)
        if self.tags.transfer is not None:
            gray = cv2.LUT(gray, gray_table(self.tags.transfer))
        return self.tags.orientation.apply(gray)

    def _colours(self, pixels: str) -> NDArray[np.generic]:
        matrix = self._guessed_matrix() if self._is_untagged else None
        return self._reformat(pixels, matrix, ROUNDED)

    def _reformat(
        self, pixels: str, matrix: Colorspace | None, interpolation: Interpolation | None = None,
    ) -> NDArray[np.generic]:
        width, height = self._whole_size
        rows, columns = self._view
        return self.frame.reformat(
            width=width, height=height, format=pixels, src_colorspace=matrix,
            dst_colorspace=matrix, interpolation=interpolation).to_ndarray()[rows, columns]

    @property
    def _is_untagged(self) -> bool:
        return self.frame.colorspace in _UNTAGGED

    def _guessed_matrix(self) -> Colorspace:
        """Returns the matrix that players take where the frame names none."""
        if self.tags.transfer is not None or self.tags.primaries == BT2020:
            return Colorspace.BT2020
        large = self.frame.width >= SD_SIZE[0] or self.frame.height > SD_SIZE[1]
        return Colorspace.ITU709 if large else Colorspace.ITU601

    def _white(self) -> int:
        """Returns swscale's white at 16 bits."""
        full = self.frame.color_range == ColorRange.JPEG
        depth = self.frame.format.components[0].bits
        return full_range_white(depth) if full and not self.frame.format.is_rgb else WHITE


def deinterlace(
    items: Iterable[av.VideoFrame | LostPacket],  # frames in presentation order, and gaps
) -> Iterator[tuple[av.VideoFrame, bool] | LostPacket]:
    """Yields each frame deinterlaced and whether it was interlaced; gaps keep their place."""
    deinterlacer: _Deinterlacer | None = None
    for item in items:
        if isinstance(item, av.VideoFrame):
            if deinterlacer is not None and deinterlacer.size != (item.width, item.height):
                yield from deinterlacer.put(None)
                deinterlacer = None
            if deinterlacer is None and item.interlaced_frame:
                deinterlacer = _Deinterlacer(item)
        if deinterlacer is not None:
            yield from deinterlacer.put(item)
        else:
            yield item if isinstance(item, LostPacket) else (item, False)
    if deinterlacer is not None:
        yield from deinterlacer.put(None)


class _Deinterlacer:
    """A filter graph, which is one frame late, and the items that wait for it."""

    def __init__(self, first: av.VideoFrame) -> None:
        self.size = (first.width, first.height)
        self._waiting: deque[av.VideoFrame | LostPacket] = deque()
        self._graph = Graph()
        source = self._graph.add("buffer", ":".join((
            f"video_size={first.width}x{first.height}", f"pix_fmt={first.format.name}",
            f"time_base={first.time_base}", "pixel_aspect=1/1",
            f"colorspace={first.colorspace}", f"range={first.color_range}")))
        bwdif = self._graph.add("bwdif", BWDIF)
        self._graph.link_nodes(source, bwdif, self._graph.add("buffersink")).configure()

    def put(
        self, item: av.VideoFrame | LostPacket | None
    ) -> Iterator[tuple[av.VideoFrame, bool] | LostPacket]:
        """Yields the items that are ready after the next one; None ends the frames."""
        if item is not None:
            self._waiting.append(item)
        if not isinstance(item, LostPacket):
            self._graph.vpush(item)
        while self._waiting:
            oldest = self._waiting[0]
            if isinstance(oldest, LostPacket):
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
