"""A decoded frame as it is displayed: deinterlaced, in sRGB, with square pixels, upright.

Pixels that are not square are stretched along the width, as players do, so that rows are never
mixed. A mirrored display matrix is read as its rotation.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from fractions import Fraction

import av
import cv2
import numpy as np
from av.filter import Graph
from av.video.reformatter import Colorspace, Interpolation
from av.video.stream import VideoStream
from numpy.typing import NDArray

from recon_cli.capture.tone import Transfer, gray_table, to_sdr

UNSPECIFIED = 2  # AVCOL_SPC_UNSPECIFIED
# Players take untagged video of more than standard definition as BT.709 (mpv: csputils.c).
SD_WIDTH, SD_HEIGHT = 1280, 576
# Without these, swscale cuts off where it should round, and repeats colours of half resolution
# instead of interpolating them. Against the frames that a rendered video was made from: 1.0 of 255
# too dark and 38.4 dB; with these 0.1 too bright and 39.0 dB, at 1.6 times the cost.
ROUNDED = Interpolation.BILINEAR | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT
# H.273, table 3: the transfer characteristics of HDR.
TRANSFERS = {16: Transfer.PQ, 18: Transfer.HLG}
# One frame per frame, not per field: the rows of the first field stay as recorded.
BWDIF = "mode=send_frame:parity=auto:deint=interlaced"


@dataclass(frozen=True)
class Gap:
    """A packet that gave no frame; `pts` is its place in the stream's time base, if known."""

    pts: int | None


@dataclass(frozen=True)
class Tags:
    """How the frames of a file are to be displayed."""

    aspect: Fraction = Fraction(1)  # width of a pixel over its height
    transfer: Transfer | None = None  # None for SDR
    primaries: int = UNSPECIFIED  # H.273 code


def tags_of(stream: VideoStream) -> Tags:
    """Returns how the frames of a video stream are to be displayed."""
    context = stream.codec_context
    return Tags(
        # The container's value, else the codec's; 0 where neither has one.
        stream.sample_aspect_ratio or Fraction(1),
        TRANSFERS.get(int(context.color_trc)),
        int(context.color_primaries))


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
        return (height, width) if self._quarter_turns() % 2 else (width, height)

    def rgb(self) -> NDArray[np.uint8]:
        """Returns the frame as it is displayed: upright, full-range RGB, [H, W, 3].

        Colour matrix and range come from the frame's tags. Ten-bit frames are reduced to eight
        bits, and HDR to SDR by the one curve of `capture.tone`.
        """
        transfer = self.tags.transfer
        if transfer is None:
            return self._upright(self._colours("rgb24", self._sdr_matrix()))
        untagged = self.frame.colorspace == UNSPECIFIED
        matrix = Colorspace.BT2020 if untagged else None
        signal = np.asarray(self._colours("rgb48le", matrix), np.uint16)
        return self._upright(to_sdr(signal, transfer, primaries=self.tags.primaries))

    def gray(self) -> NDArray[np.uint8]:
        """Returns the frame's gray values, upright, [H, W]; of HDR those of neutral colours."""
        gray = self.frame.reformat(width=self.square_size[0], format="gray").to_ndarray()
        if self.tags.transfer is not None:
            gray = cv2.LUT(gray, gray_table(self.tags.transfer))
        return self._upright(gray)

    def _colours(self, pixels: str, matrix: Colorspace | None) -> NDArray[np.generic]:
        return self.frame.reformat(
            width=self.square_size[0], format=pixels, src_colorspace=matrix,
            interpolation=ROUNDED).to_ndarray()

    def _sdr_matrix(self) -> Colorspace | None:
        untagged = self.frame.colorspace == UNSPECIFIED
        large = self.frame.width >= SD_WIDTH or self.frame.height > SD_HEIGHT
        return Colorspace.ITU709 if untagged and large else None

    def _quarter_turns(self) -> int:
        return round(self.frame.rotation / 90) % 4

    def _upright(self, pixels: NDArray[np.generic]) -> NDArray[np.uint8]:
        # Both count counterclockwise.
        turned = np.rot90(pixels, self._quarter_turns())
        return np.ascontiguousarray(turned, np.uint8)


def progressive(
    items: Iterable[av.VideoFrame | Gap],
) -> Iterator[tuple[av.VideoFrame, bool] | Gap]:
    """Yields each frame deinterlaced and whether it was interlaced; gaps keep their place.

    Args:
        items: frames of one size in presentation order, and gaps.
    """
    filter_: _Deinterlacer | None = None
    for item in items:
        if filter_ is None and isinstance(item, av.VideoFrame) and item.interlaced_frame:
            filter_ = _Deinterlacer(item)
        if filter_ is not None:
            yield from filter_.put(item)
        else:
            yield item if isinstance(item, Gap) else (item, False)
    if filter_ is not None:
        yield from filter_.finish()


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

    def put(self, item: av.VideoFrame | Gap) -> Iterator[tuple[av.VideoFrame, bool] | Gap]:
        self._waiting.append(item)
        if isinstance(item, av.VideoFrame):
            self._graph.vpush(item)
        yield from self._ready()

    def finish(self) -> Iterator[tuple[av.VideoFrame, bool] | Gap]:
        self._graph.vpush(None)
        yield from self._ready()

    def _ready(self) -> Iterator[tuple[av.VideoFrame, bool] | Gap]:
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
