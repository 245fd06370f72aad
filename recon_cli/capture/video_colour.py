"""Colours of video and photos as sRGB: HDR (HLG or PQ) and SDR of wide gamut (BT.2020, P3).

HDR becomes sRGB with BT.709 primaries: the EOTF of ITU-R BT.2100 (for HLG with the OOTF of a
display of 1000 cd/m2), then the EETF of Report BT.2408, Annex 5, down to the white of SDR. It is
applied to the largest of R, G and B, which keeps the hue, with the same peak for all frames.

SDR is read as sRGB whatever its tag, as video of BT.709 is: grays stay, and only the primaries are
converted. Colours that BT.709 cannot show are clipped. Adobe RGB (1998), of photos, has no code in
H.273 and a power for its curve.
"""

from __future__ import annotations

import math
from enum import Enum
from functools import cache

import cv2
import numpy as np
from av.video.reformatter import ColorPrimaries, ColorTrc
from numpy.typing import NDArray

# cd/m2: the nominal peak of HLG (BT.2100, table 5), and what phones and films master PQ for.
PEAK = 1000.0
# cd/m2: white of a page in HDR (BT.2408, table 1); it is the brightest that SDR can show.
SDR_WHITE = 203.0
HLG_GAMMA = 1.2 + 0.42 * math.log10(PEAK / 1000)  # BT.2100, table 5: of the OOTF
# BT.2100, table 5: the OETF of HLG.
HLG_A = 0.17883277
HLG_B, HLG_C = 1 - 4 * HLG_A, 0.5 - HLG_A * np.log(4 * HLG_A)
# BT.2100, table 4: the EOTF of PQ.
PQ_M1, PQ_M2 = 2610 / 16384, 2523 / 4096 * 128
PQ_C2, PQ_C3 = 2413 / 4096 * 32, 2392 / 4096 * 32
PQ_C1 = PQ_C3 - PQ_C2 + 1
# CIE x, y of R, G, B by the code of ITU-T H.273: BT.709, BT.2020 and P3; white is D65 in all. The
# white of DCI P3 is that of projectors, which a display adapts to its own.
BT709, BT2020 = ColorPrimaries.BT709, ColorPrimaries.BT2020
DCI_P3, P3 = ColorPrimaries.SMPTE431, ColorPrimaries.SMPTE432
# Adobe RGB (1998) Color Image Encoding, 4.3.1: beyond the codes of H.273, which are bytes.
ADOBE_RGB, ADOBE_GAMMA = 256, 563 / 256
PRIMARIES: dict[int, tuple[tuple[float, float], ...]] = {
    BT709: ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06)),
    BT2020: ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046)),
    P3: ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060)),
    ADOBE_RGB: ((0.64, 0.33), (0.21, 0.71), (0.15, 0.06))}
PRIMARIES[DCI_P3] = PRIMARIES[P3]
WIDE_GAMUTS: dict[int, str] = {
    BT2020: "BT.2020", DCI_P3: "P3", P3: "Display P3", ADOBE_RGB: "Adobe RGB"}
D65 = (0.3127, 0.3290)
# Steps of the gain over the root of the light: neighbours differ by less than 0.2 %.
GAIN_STEPS = 4096
GAIN_REACH = 2.0  # of the peak: pure red of BT.2020 is 1.66 of it as red of BT.709
# Pixels at a time, to stay in the cache: 14 ms a megapixel of HLG on an EPYC core, else 37.
STRIP = 1 << 15


class Transfer(Enum):
    """The transfer functions of HDR."""

    HLG = "HLG"
    PQ = "PQ"


TRANSFERS: dict[int, Transfer] = {
    ColorTrc.SMPTE2084: Transfer.PQ, ColorTrc.ARIB_STD_B67: Transfer.HLG}


def full_range_white(bits: int) -> int:
    """Returns the white of full range at 16 bits: n bits end at 2^n - 1 of 2^n."""
    return 65536 - (1 << 16 - bits)


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


def srgb_light(signal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the light in [0, 1] of an sRGB signal in [0, 1]: the inverse of `srgb_code`."""
    return np.where(signal <= 0.04045, signal / 12.92, ((signal + 0.055) / 1.055) ** 2.4)


@cache
def gray_table(transfer: Transfer) -> NDArray[np.uint8]:
    """Returns the byte that each 8-bit gray becomes, [256]: `to_srgb` of neutral pixels."""
    signal = np.arange(256) / 255
    light = hlg_scene(signal) ** HLG_GAMMA * PEAK if transfer is Transfer.HLG else pq_light(signal)
    return srgb_code(tone_map(light) / SDR_WHITE)


def to_srgb(
    rgb: NDArray[np.uint16], transfer: Transfer | None, *, primaries: int, white: int,
) -> NDArray[np.uint8]:
    """Returns a signal [H, W, 3] from 0 to `white` as sRGB bytes [H, W, 3].

    `transfer` is None for SDR. `primaries` is an H.273 code or `ADOBE_RGB`; any that is not in
    `PRIMARIES` is taken as BT.709 in SDR and as BT.2020 in HDR.
    """
    if primaries not in PRIMARIES:
        primaries = BT709 if transfer is None else BT2020
    pixels = rgb.reshape(-1, 1, 3)
    srgb = np.empty(pixels.shape, np.uint8)
    to_bt709, luminance = _matrices(primaries)
    table = _light_table(transfer, white, primaries == ADOBE_RGB)
    for start in range(0, len(pixels), STRIP):
        light = table.take(pixels[start:start + STRIP])
        linear = cv2.transform(light, to_bt709)
        if transfer is Transfer.HLG:
            # The OOTF scales all three by a power of the luminance, so the matrix may come first.
            linear = _scale(linear, cv2.pow(cv2.transform(light, luminance), HLG_GAMMA - 1))
        if transfer is not None:
            linear = _scale(linear, _tone_gain(linear))
        linear = np.clip(linear, 0, 1)
        srgb[start:start + STRIP] = _code_table().take((linear * 65535 + 0.5).astype(np.uint16))
    return srgb.reshape(rgb.shape)


def _tone_gain(linear: NDArray[np.float32]) -> NDArray[np.float32]:
    """Returns the gain [N, 1] of the tone curve for pixels [N, 1, 3] in units of the peak."""
    # Below 0 are colours that BT.709 cannot show. Not linear.max(axis=2): 28 ms a megapixel.
    largest = np.maximum(np.maximum(linear[..., 0], linear[..., 1]), linear[..., 2])
    root = cv2.sqrt(np.maximum(largest, 0) / GAIN_REACH)
    index = (root * (GAIN_STEPS - 1) + 0.5).astype(np.uint16)
    return np.asarray(_gain_table().take(index))


def _scale(rgb: NDArray[np.float32], factor: NDArray[np.float32]) -> NDArray[np.float32]:
    """Returns pixels [N, 1, 3] times a factor each [N, 1]."""
    # Ten times as fast as broadcasting over an axis of three.
    return np.asarray(cv2.multiply(rgb, cv2.merge([factor] * 3)))


@cache
def _light_table(
    transfer: Transfer | None, white: int, adobe: bool
) -> NDArray[np.float32]:  # [65536]
    """Returns the light of each signal: of the scene for HLG, in units of the peak or of white."""
    signal = np.minimum(np.arange(65536) / white, 1)
    if transfer is Transfer.HLG:
        return hlg_scene(signal).astype(np.float32)
    if transfer is Transfer.PQ:
        return np.minimum(pq_light(signal) / PEAK, 1).astype(np.float32)
    if adobe:
        return (signal**ADOBE_GAMMA).astype(np.float32)
    return srgb_light(signal).astype(np.float32)


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
    source = _to_xyz(PRIMARIES[primaries])
    matrix = np.linalg.inv(_to_xyz(PRIMARIES[BT709])) @ source
    return matrix.astype(np.float32), source[1:2].astype(np.float32)


def _to_xyz(primaries: tuple[tuple[float, float], ...]) -> NDArray[np.float64]:  # [3, 3]
    """Returns the matrix from linear RGB to CIE XYZ (SMPTE RP 177)."""
    columns = np.array([(x / y, 1, (1 - x - y) / y) for x, y in (*primaries, D65)]).T
    scale = np.linalg.solve(columns[:, :3], columns[:, 3])
    return np.asarray(columns[:, :3] * scale)
