"""A decoded frame as it is displayed: deinterlaced, in sRGB, with square pixels, upright.

Pixels that are not square are stretched along the width, as players do. A mirrored display matrix
is read as its rotation.

HDR (HLG or PQ) becomes sRGB with BT.709 primaries: the EOTF of ITU-R BT.2100 (for HLG with the OOTF
of a display of 1000 cd/m2), then the EETF of Report BT.2408, Annex 5, down to the white of SDR. It
is applied to the largest of R, G and B, which keeps the hue, with the same peak for all frames.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import Enum
from fractions import Fraction
from functools import cache

import av
import cv2
import numpy as np
from av.filter import Graph
from av.video.reformatter import Colorspace, Interpolation
from av.video.stream import VideoStream
from numpy.typing import NDArray

UNSPECIFIED = 2  # AVCOL_SPC_UNSPECIFIED
# Players take untagged video of more than standard definition as BT.709 (mpv: csputils.c).
SD_WIDTH, SD_HEIGHT = 1280, 576
# Without these, swscale truncates, and repeats chroma instead of interpolating it. Frames of a
# rendered video: 1.0 of 255 too dark and 38.4 dB; with these 0.1 and 39.0 dB, 1.6 times the cost.
ROUNDED = Interpolation.BILINEAR | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT
# One frame per frame, not per field: the rows of the first field stay as recorded.
BWDIF = "mode=send_frame:parity=auto:deint=interlaced"
# cd/m2: the nominal peak of HLG (BT.2100, table 5), and what phones and films master PQ for.
PEAK = 1000.0
# cd/m2: white of a page in HDR (BT.2408, table 1); it is the brightest that SDR can show.
SDR_WHITE = 203.0
HLG_GAMMA = 1.2  # BT.2100, table 5: of the OOTF at 1000 cd/m2
# BT.2100, table 5: the OETF of HLG.
HLG_A = 0.17883277
HLG_B, HLG_C = 1 - 4 * HLG_A, 0.5 - HLG_A * np.log(4 * HLG_A)
# BT.2100, table 4: the EOTF of PQ.
PQ_M1, PQ_M2 = 2610 / 16384, 2523 / 4096 * 128
PQ_C1, PQ_C2, PQ_C3 = 3424 / 4096, 2413 / 4096 * 32, 2392 / 4096 * 32
# CIE x, y of R, G, B by the code of ITU-T H.273: BT.709, BT.2020 and P3; white is D65 in all.
BT709, BT2020, P3 = 1, 9, 12
PRIMARIES = {
    BT709: ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06)),
    BT2020: ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046)),
    P3: ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060))}
D65 = (0.3127, 0.3290)
# Steps of the gain over the root of the light: neighbours differ by less than 0.2 %.
GAIN_STEPS = 4096
GAIN_REACH = 2.0  # of the peak: pure red of BT.2020 is 1.66 of it as red of BT.709
# swscale's white of limited range at 16 bits, 255 * 256; full range is up to 0.4 % more, and clips.
WHITE = 65280
# Pixels at a time, to stay in the cache: 14 ms a megapixel of HLG on an EPYC core, else 37.
STRIP = 1 << 15


class Transfer(Enum):
    """The transfer functions of HDR video."""

    HLG = "HLG"
    PQ = "PQ"


# H.273, table 3: the transfer characteristics of HDR.
TRANSFERS = {16: Transfer.PQ, 18: Transfer.HLG}


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


def read_tags(stream: VideoStream) -> Tags:
    """Returns how the frames of a video stream are to be displayed."""
    context = stream.codec_context
    return Tags(
        # The container's value, else the codec's; 0 where neither has one.
        stream.sample_aspect_ratio or Fraction(1),
        TRANSFERS.get(int(context.color_trc)), int(context.color_primaries))


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
        """Returns the frame as displayed: upright 8-bit full-range RGB [H, W, 3], HDR as SDR."""
        transfer, untagged = self.tags.transfer, self.frame.colorspace == UNSPECIFIED
        if transfer is None:
            large = self.frame.width >= SD_WIDTH or self.frame.height > SD_HEIGHT
            matrix = Colorspace.ITU709 if untagged and large else None
            return self._upright(self._colours("rgb24", matrix))
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

    def _quarter_turns(self) -> int:
        return round(self.frame.rotation / 90) % 4

    def _upright(self, pixels: NDArray[np.generic]) -> NDArray[np.uint8]:
        # Both count counterclockwise.
        return np.ascontiguousarray(np.rot90(pixels, self._quarter_turns()), np.uint8)


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


def pq_light(signal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the display light in cd/m2 of a PQ signal in [0, 1]; BT.2100, table 4."""
    root = signal ** (1 / PQ_M2)
    return np.asarray(1e4 * (np.maximum(root - PQ_C1, 0) / (PQ_C2 - PQ_C3 * root)) ** (1 / PQ_M1))


def pq_signal(light: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the PQ signal of display light in cd/m2: the inverse of `pq_light`."""
    power = (light / 1e4) ** PQ_M1
    return np.asarray(((PQ_C1 + PQ_C2 * power) / (1 + PQ_C3 * power)) ** PQ_M2)


def hlg_scene(signal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the scene light in [0, 1] of an HLG signal in [0, 1]; BT.2100, table 5."""
    return np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - HLG_C) / HLG_A) + HLG_B) / 12)


def tone_map(light: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns light of up to `PEAK` cd/m2 fitted below `SDR_WHITE`; BT.2408, Annex 5.

    Up to 88 cd/m2 nothing changes. Above, a Hermite spline in PQ takes 203 to 159, `PEAK` to 203.
    """
    top = pq_signal(np.array(PEAK))
    x = pq_signal(np.minimum(light, PEAK)) / top
    most = pq_signal(np.array(SDR_WHITE)) / top
    knee = 1.5 * most - 0.5
    t = np.maximum(x - knee, 0) / (1 - knee)
    spline = (
        (2 * t**3 - 3 * t**2 + 1) * knee
        + (t**3 - 2 * t**2 + t) * (1 - knee)
        + (-2 * t**3 + 3 * t**2) * most)
    return pq_light(np.where(x < knee, x, spline) * top)


def srgb_code(light: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Returns light in [0, 1] as sRGB bytes (IEC 61966-2-1), which viewers expect in a PNG."""
    code = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.asarray(np.round(255 * code), np.uint8)


@cache
def gray_table(transfer: Transfer) -> NDArray[np.uint8]:
    """Returns the byte that each 8-bit gray becomes, [256]: `to_sdr` of neutral pixels."""
    signal = np.arange(256) / 255
    light = hlg_scene(signal) ** HLG_GAMMA * PEAK if transfer is Transfer.HLG else pq_light(signal)
    return srgb_code(tone_map(light) / SDR_WHITE)


def to_sdr(
    rgb: NDArray[np.uint16], transfer: Transfer, *, primaries: int = BT2020
) -> NDArray[np.uint8]:
    """Returns a signal [H, W, 3] from 0 to `WHITE` as sRGB bytes [H, W, 3].

    `primaries` is an H.273 code; any that is not in `PRIMARIES` is taken as BT.2020.
    """
    pixels = rgb.reshape(-1, 1, 3)
    sdr = np.empty(pixels.shape, np.uint8)
    to_bt709, luminance = _matrices(primaries)
    for start in range(0, len(pixels), STRIP):
        light = _light_table(transfer).take(pixels[start:start + STRIP])
        linear = cv2.transform(light, to_bt709)
        if transfer is Transfer.HLG:
            # The OOTF scales all three by a power of the luminance, so the matrix may come first.
            linear = _scale(linear, cv2.pow(cv2.transform(light, luminance), HLG_GAMMA - 1))
        # Below 0 are colours that BT.709 cannot show. Not linear.max(axis=2): 28 ms a megapixel.
        largest = np.maximum(np.maximum(linear[..., 0], linear[..., 1]), linear[..., 2])
        root = cv2.sqrt(np.maximum(largest, 0) / GAIN_REACH)
        gain = _gain_table().take((root * (GAIN_STEPS - 1) + 0.5).astype(np.uint16))
        linear = np.clip(_scale(linear, gain), 0, 1)
        sdr[start:start + STRIP] = _code_table().take((linear * 65535 + 0.5).astype(np.uint16))
    return sdr.reshape(rgb.shape)


def _scale(rgb: NDArray[np.float32], factor: NDArray[np.float32]) -> NDArray[np.float32]:
    """Returns pixels [N, 1, 3] times a factor each [N, 1]."""
    # Ten times as fast as broadcasting over an axis of three.
    return np.asarray(cv2.multiply(rgb, cv2.merge([factor] * 3)))


@cache
def _light_table(transfer: Transfer) -> NDArray[np.float32]:  # [65536]
    """Returns the light of each signal: of the scene for HLG, in units of the peak for PQ."""
    signal = np.minimum(np.arange(65536) / WHITE, 1)
    if transfer is Transfer.HLG:
        return hlg_scene(signal).astype(np.float32)
    return np.minimum(pq_light(signal) / PEAK, 1).astype(np.float32)


@cache
def _gain_table() -> NDArray[np.float32]:  # [GAIN_STEPS]
    """Returns the gain that takes light in units of the peak to light in units of SDR's white."""
    light = np.linspace(0, 1, GAIN_STEPS) ** 2 * GAIN_REACH
    light[0] = light[1]  # below the knee the gain is constant
    return (tone_map(light * PEAK) / (light * SDR_WHITE)).astype(np.float32)


@cache
def _code_table() -> NDArray[np.uint8]:  # [65536]
    return srgb_code(np.arange(65536) / 65535)


@cache
def _matrices(primaries: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Returns the matrix [3, 3] to linear BT.709 and the weights [1, 3] of the luminance."""
    source = _to_xyz(PRIMARIES.get(primaries, PRIMARIES[BT2020]))
    matrix = np.linalg.inv(_to_xyz(PRIMARIES[BT709])) @ source
    return matrix.astype(np.float32), source[1:2].astype(np.float32)


def _to_xyz(primaries: tuple[tuple[float, float], ...]) -> NDArray[np.float64]:  # [3, 3]
    """Returns the matrix from linear RGB to CIE XYZ (SMPTE RP 177)."""
    columns = np.array([(x / y, 1, (1 - x - y) / y) for x, y in (*primaries, D65)]).T
    scale = np.linalg.solve(columns[:, :3], columns[:, 3])
    return np.asarray(columns[:, :3] * scale)
