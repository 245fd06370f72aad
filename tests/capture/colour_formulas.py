"""Colours of video by the formulas of the standards in float64, and frames that hold them.

Nothing here is the package's own: the formulas are the oracle that its tables are tested against.
"""

from itertools import product

import av
import numpy as np

# ITU-R BT.601, BT.709 and BT.2020: weights of red and blue by the code of H.273.
WEIGHTS = {1: (0.2126, 0.0722), 5: (0.299, 0.114), 6: (0.299, 0.114), 9: (0.2627, 0.0593)}
HLG, PQ = 18, 16  # codes of H.273
BLOCK = 16  # pixels along the side of a block of one colour: its centre is free of its neighbours
COLUMNS = 25
# Signals of R, G and B in steps of a quarter: the corners of the cube are fully saturated.
COLOURS = np.array(list(product((0, 0.25, 0.5, 0.75, 1), repeat=3)))


def depth(pixels):
    """Bits of a pixel format by its name."""
    return next((bits for bits in (10, 12, 14, 16) if f"p{bits}" in pixels or f"p0{bits}" in pixels
                 or f"p2{bits}" in pixels), 8)


def subsampling(pixels):
    """Rows and columns of luma for one of chroma."""
    if "420" in pixels or pixels in {"nv12", "p010le", "p012le"}:
        return 2, 2
    return (1, 2) if "422" in pixels or pixels in {"nv16", "p210le"} else (1, 1)


def to_codes(rgb, matrix, *, full, bits):
    """Codes [3, N] of Y, Cb and Cr for signals [N, 3]: BT.709 and H.273, equations 38 to 50."""
    red, blue = WEIGHTS[matrix]
    luma = rgb @ np.array([red, 1 - red - blue, blue])
    chroma = ((rgb[:, 2] - luma) / (2 - 2 * blue), (rgb[:, 0] - luma) / (2 - 2 * red))
    top, unit = 2**bits - 1, 2**(bits - 8)
    codes = (
        [top * luma, *(top * c + 2**(bits - 1) for c in chroma)] if full else
        [(219 * luma + 16) * unit, *((224 * c + 128) * unit for c in chroma)])
    return np.clip(np.rint(codes), 0, top).astype(int)


def to_signals(codes, matrix, *, full, bits):
    """Signals [N, 3] of codes [3, N], within [0, 1]: the inverse of `to_codes`."""
    red, blue = WEIGHTS[matrix]
    top, unit = 2**bits - 1, 2**(bits - 8)
    y, cb, cr = np.asarray(codes, float)
    luma = y / top if full else (y / unit - 16) / 219
    cb, cr = ((c - 2**(bits - 1)) / top if full else (c / unit - 128) / 224 for c in (cb, cr))
    r, b = luma + (2 - 2 * red) * cr, luma + (2 - 2 * blue) * cb
    return np.clip(np.stack([r, (luma - red * r - blue * b) / (1 - red - blue), b], axis=1), 0, 1)


def frame_of(codes, pixels, *, matrix, full):
    """A frame with a block for each colour of codes [3, N]."""
    rows, columns = subsampling(pixels)
    planes = [_blocks(plane) for plane in codes]
    planes[1:] = [plane[::rows, ::columns] for plane in planes[1:]]
    if pixels.startswith(("nv", "p0", "p2")):  # chroma in pairs, bits at the upper end
        planes[1:] = [np.stack(planes[1:], axis=2).reshape(len(planes[1]), -1)]
        planes = [plane << (16 - depth(pixels) if depth(pixels) > 8 else 0) for plane in planes]
    frame = av.VideoFrame(COLUMNS * BLOCK, -(-codes.shape[1] // COLUMNS) * BLOCK, pixels)
    kind = np.dtype("u1" if depth(pixels) == 8 else "<u2")
    for target, plane in zip(frame.planes, planes, strict=True):
        lines = np.zeros((target.height, target.line_size // kind.itemsize), kind)
        lines[:, :plane.shape[1]] = plane
        target.update(lines.tobytes())
    frame.colorspace, frame.color_range = matrix, 2 if full else 1
    return frame


def _blocks(values):
    cells = np.zeros(-(-len(values) // COLUMNS) * COLUMNS, int)
    cells[:len(values)] = values
    return np.kron(cells.reshape(-1, COLUMNS), np.ones((BLOCK, BLOCK), int))


def centres(pixels):
    """The middle pixel of the block of each of `COLOURS`, [N, ...], as floats."""
    middle = pixels[BLOCK // 2::BLOCK, BLOCK // 2::BLOCK]
    return middle.reshape(-1, *pixels.shape[2:])[:len(COLOURS)].astype(float)


def to_xyz(primaries):
    """From linear RGB to CIE XYZ for CIE x, y of R, G, B; white is D65 (SMPTE RP 177)."""
    xyz = np.array([(x, y, 1 - x - y) for x, y in primaries]).T
    white = np.array([0.3127, 0.3290, 1 - 0.3127 - 0.3290]) / 0.3290
    return xyz * np.linalg.solve(xyz, white)


XY = {
    1: ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06)),
    9: ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046)),
    12: ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060))}


def to_bt709(light, primaries):
    """Linear light [N, 3] of these primaries as that of BT.709."""
    matrix = np.linalg.inv(to_xyz(XY[1])) @ to_xyz(XY[primaries])
    return light @ matrix.T


def to_primaries(light, primaries):
    """Linear light [N, 3] of BT.709 as that of these primaries: the inverse of `to_bt709`."""
    return light @ np.linalg.inv(to_bt709(np.eye(3), primaries))


def srgb_encode(light):
    """IEC 61966-2-1, of light that is cut to [0, 1]."""
    light = np.clip(light, 0, 1)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def srgb_decode(signal):
    """IEC 61966-2-1."""
    return np.where(signal <= 0.04045, signal / 12.92, ((signal + 0.055) / 1.055) ** 2.4)


def pq_decode(signal):
    """SMPTE ST 2084: display light in cd/m2."""
    root = signal ** (32 / 2523)
    return 1e4 * (np.maximum(root - 0.8359375, 0) / (18.8515625 - 18.6875 * root)) ** (8192 / 1305)


def pq_encode(light):
    """SMPTE ST 2084, of display light in cd/m2."""
    power = (np.asarray(light) / 1e4) ** (1305 / 8192)
    return ((0.8359375 + 18.8515625 * power) / (1 + 18.6875 * power)) ** (2523 / 32)


def hlg_decode(signal, primaries):
    """BT.2100: display light in cd/m2 of signals [N, 3] on a display of 1000 cd/m2."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    scene = np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)
    luminance = scene @ to_xyz(XY[primaries])[1]
    return 1000 * scene * luminance[:, None] ** 0.2


def hlg_encode(light):
    """BT.2100: signals [N, 3] of display light in cd/m2 with the primaries of BT.2020."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    luminance = np.maximum(light @ to_xyz(XY[9])[1] / 1000, 1e-9)[:, None]
    scene = np.maximum(light / 1000 * luminance ** (1 / 1.2 - 1), 0)
    return np.where(scene <= 1 / 12, np.sqrt(3 * scene),
                    a * np.log(np.maximum(12 * scene - b, 1e-9)) + c)


def eetf(light):
    """BT.2408, Annex 5: light of up to 1000 cd/m2 fitted below 203."""
    e1 = pq_encode(np.minimum(light, 1000)) / pq_encode(1000)
    most = pq_encode(203) / pq_encode(1000)
    knee = 1.5 * most - 0.5
    t = (e1 - knee) / (1 - knee)
    p = ((2 * t**3 - 3 * t**2 + 1) * knee + (t**3 - 2 * t**2 + t) * (1 - knee)
         + (-2 * t**3 + 3 * t**2) * most)
    return pq_decode(np.where(e1 < knee, e1, p) * pq_encode(1000))


def displayed(signals, transfer, primaries):
    """Signals [N, 3] in sRGB, in units of 255; `transfer` 1 is SDR."""
    if transfer not in (HLG, PQ):
        return 255 * (signals if primaries == 1 else srgb_encode(
            to_bt709(srgb_decode(signals), primaries)))
    light = (hlg_decode(signals, primaries) if transfer == HLG
             else np.minimum(pq_decode(signals), 1000))
    light = to_bt709(light, primaries)
    largest = np.maximum(light.max(axis=1, keepdims=True), 1e-9)
    return 255 * srgb_encode(light * eetf(largest) / largest / 203)
