"""A decoded frame and how it is shown: its colours, square pixels, upright.

Pixels that are not square are stretched along the width and the height is kept, as players do:
rows are never mixed. A mirrored display matrix is read as its rotation.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import av
import cv2
import numpy as np
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
ROUNDED = (
    Interpolation.BILINEAR | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT)
# H.273, table 3: the transfer characteristics of HDR.
TRANSFERS = {16: Transfer.PQ, 18: Transfer.HLG}


@dataclass(frozen=True)
class Gap:
    """A packet that gave no frame; `pts` is its place in the stream's time base, if known."""

    pts: int | None


@dataclass(frozen=True)
class Tags:
    """What a file says about the looks of all its frames.

    Attributes:
        aspect: width of a pixel over its height.
        transfer: how HDR video codes light, None for SDR.
        primaries: H.273 code of its primary colours.
    """

    aspect: Fraction = Fraction(1)
    transfer: Transfer | None = None
    primaries: int = UNSPECIFIED


def tags_of(stream: VideoStream) -> Tags:
    """Returns what a video stream says about the looks of its frames."""
    context = stream.codec_context
    return Tags(
        # The container's word, else the codec's; 0 where neither has one.
        stream.sample_aspect_ratio or Fraction(1),
        TRANSFERS.get(int(context.color_trc)),
        int(context.color_primaries))


@dataclass(frozen=True, eq=False)
class Picture:
    """A decoded frame.

    Attributes:
        frame: as it was decoded, or deinterlaced.
        tags: what the file says about its looks.
        interlaced: whether its two fields were taken at different times.
    """

    frame: av.VideoFrame
    tags: Tags = Tags()
    interlaced: bool = False

    @property
    def square_size(self) -> tuple[int, int]:
        """Width and height with square pixels, as it lies in the file."""
        return max(1, round(self.frame.width * self.tags.aspect)), self.frame.height

    @property
    def size(self) -> tuple[int, int]:
        """Width and height as shown."""
        width, height = self.square_size
        return (height, width) if self._quarter_turns() % 2 else (width, height)

    def rgb(self) -> NDArray[np.uint8]:
        """Returns the frame as it is shown: upright, full-range RGB, [H, W, 3].

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
        """Returns the frame's brightness, upright, [H, W]; of HDR as its neutral colours show."""
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
