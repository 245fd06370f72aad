"""Positions, rotations and coefficients as the bytes of a .sog's images, there and back."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon_cli.io.splats.codebooks import codebook, nearest, palette
from recon_cli.scene.splats import TERMS

ROW = 64  # palette entries in a row of their image
_STEPS = 65535  # of a position along an axis
_TAG = 252  # of a quaternion whose greatest component is w
_ROOT2 = math.sqrt(2)  # no but the greatest component of a unit quaternion exceeds 1 / sqrt(2)
_MOST_ENTRIES = 65535  # of a palette, and one of zeros
# Gaussians an entry. A scene of photos with 60,000 (fox, degree 3) loses .15, .19, .25 and .33 dB
# with 4, 8, 16 and 32, and takes 23.7, 18.7, 16.1 and 14.7 bytes each.
_SHARE = 16
Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]


def pack_means(means: Floats) -> tuple[Doubles, Doubles, NDArray[np.int64]]:
    """Returns the least and greatest logarithms [3] and 16-bit positions [N, 3] between them."""
    wide = means.astype(np.float64)
    logs = np.copysign(np.log1p(np.abs(wide)), wide)
    low, high = logs.min(axis=0), logs.max(axis=0)
    span = np.where(high > low, high - low, 1)
    return low, high, np.rint((logs - low) / span * _STEPS).astype(np.int64)


def unpack_means(low_bytes: Bytes, high_bytes: Bytes, low: Doubles, high: Doubles) -> Floats:
    """Returns positions [N, 3]; infinite where the bounds are no bounds of any scene."""
    steps = low_bytes.astype(np.float64) + 256.0 * high_bytes
    logs = low + (high - low) * (steps / _STEPS)
    with np.errstate(over="ignore"):
        return np.copysign(np.expm1(np.abs(logs)), logs).astype(np.float32)


def morton(places: NDArray[np.int64]) -> NDArray[np.int64]:
    """Returns the Z-order [N] of 16-bit positions [N, 3]: their bits taken in turn."""
    codes = np.zeros(len(places), np.int64)
    for bit in range(16):
        for axis in range(3):
            codes |= (places[:, axis] >> bit & 1) << (3 * bit + axis)
    return codes


def pack_quats(quats: Floats) -> Bytes:
    """Returns unit quaternions [N, 4] as the three smaller components and a tag [N, 4]."""
    greatest = np.abs(quats).argmax(axis=1)
    sign = np.where(np.take_along_axis(quats, greatest[:, None], 1) < 0, -1, 1)
    others = (quats * sign)[np.arange(4) != greatest[:, None]].reshape(-1, 3)
    steps = np.rint((others * _ROOT2 + 1) / 2 * 255).clip(0, 255)
    return np.column_stack([steps, _TAG + greatest]).astype(np.uint8)


def unpack_quats(packed: Bytes) -> Floats | None:
    """Returns quaternions [N, 4] wxyz; None where a tag is none."""
    if (packed[:, 3] < _TAG).any():
        return None
    others = (packed[:, :3] / 255 * 2 - 1) / _ROOT2
    greatest = np.sqrt(np.maximum(0, 1 - (others ** 2).sum(axis=1)))
    is_greatest = np.arange(4) == (packed[:, 3] - _TAG)[:, None]
    quats = np.empty((len(packed), 4))
    quats[is_greatest] = greatest
    quats[~is_greatest] = others.ravel()
    return quats.astype(np.float32)


@dataclass(frozen=True, eq=False)
class Palette:
    """Coefficients as pixels.

    Attributes:
        count: entries.
        degree: 1 to 3.
        codebook: [256] ascending.
        entries: [ceil(count / 64), 64 T, 3] the image of the entries.
        labels: [N] an entry for each Gaussian.
    """

    count: int
    degree: int
    codebook: Floats
    entries: Bytes
    labels: NDArray[np.int64]


def pack_harmonics(sh_rest: Floats, colored: int, rng: np.random.Generator) -> Palette:
    """Returns the palette of coefficients [N, T, 3], of which the first `colored` have any.

    The others share an entry of zeros, and the codebook holds 0 for it.
    """
    n, terms = sh_rest.shape[:2]
    size = min(_MOST_ENTRIES, -(-colored // _SHARE))
    entries, labels = palette(sh_rest[:colored].reshape(colored, -1), size, rng)
    # Neighbours in space get neighbouring numbers, so that both images compress.
    order = np.argsort(np.bincount(labels, np.arange(colored)) / np.bincount(labels))
    labels, entries = np.argsort(order)[labels], entries[order]
    if colored < n:
        labels = np.append(labels, np.full(n - colored, len(entries)))
        entries = np.concatenate([entries, np.zeros((1, entries.shape[1]), np.float32)])
    book = codebook(entries, rng)
    book[np.abs(book).argmin()] = 0
    lines = -(-len(entries) // ROW)
    filled = np.pad(entries, ((0, lines * ROW - len(entries)), (0, 0)))
    pixels = nearest(filled, book).reshape(lines, ROW * terms, 3)
    return Palette(len(entries), TERMS.index(terms), book, pixels, labels)


def unpack_harmonics(harmonics: Palette) -> Floats:
    """Returns coefficients [N, T, 3]."""
    terms = TERMS[harmonics.degree]
    entries = harmonics.codebook[harmonics.entries].reshape(-1, terms, 3)
    return np.asarray(entries[harmonics.labels])
