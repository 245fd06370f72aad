"""The noise of a frame: its estimate, and the filter that removes it.

The estimate uses only the flat parts of a frame, where it reads at most 2.5/255 on clean frames of
a richly textured room (4 on whole frames). Noise below 3 is left: a codec has smoothed it already,
and no filter gains more than .2 dB (tests/bench/bench_denoise.py --decoded).

PSNR in dB and share of the edges kept at noise of 5, 10, 15 and 20 of 255: means over ten frames of
five captures (fox, two rendered rooms, desk_monitors, snowmiku; photos halved first), at the
default strength (tests/bench/bench_denoise.py):

    none              34.2 1.00   28.2 1.00   24.7  .99   22.3  .99
    bilateral, 4      39.9  .99   35.8  .97   33.2  .94   31.3  .92
"""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from recon_cli.capture.limits import CLIPPED_SHARE

# 64 tiles leave 800 wavelet coefficients each in a frame of 600x340: known to 3%. The middle of a
# larger one has 1,600: on 16 photos of four captures, with and without noise of 10, within .3 of
# 255 of what all pixels give, in an eighth of the time at 3 MP.
GRID, SMALLEST_TILE, LARGEST_TILE = 8, 16, 80
# The 10th percentile finds tiles without texture as long as a tenth of the frame is plain.
FLAT_PERCENTILE = 10
# Of the standard normal distribution; not by scipy.stats, which takes a second to import.
NORMAL_QUARTILE = float(ndtri(0.75))
# Daubechies' wavelet of two vanishing moments, by the second differences that it takes; its four
# weights of the pixels are of length 1.
DETAIL = np.array([3**0.5 - 1, 3**0.5 + 1], np.float32) / 32**0.5
# 7 pixels and 2.0 gain 7.3 dB at noise of 15, on four rendered frames and a photo;
# 5 pixels gain 6.8 dB, 9 pixels 7.4 dB for twice the time.
DIAMETER, SIGMA_SPACE = 7, 2.0


def estimate_noise(rgb: NDArray[np.uint8]) -> float:
    """Returns the noise of a frame [H, W, 3] as standard deviation in 1/255, 0 where it is flat.

    It is a low percentile over tiles of Donoho's median of the finest diagonal wavelet terms.
    """
    rows, columns = (
        np.linspace(0, length, max(1, min(GRID, length // SMALLEST_TILE)) + 1).astype(np.int64)
        for length in rgb.shape[:2])
    tiles = [rgb[_middle(*tall), _middle(*wide)]
             for tall in pairwise(rows) for wide in pairwise(columns)]
    # clipping cuts the noise in half
    usable = [tile for tile in tiles
              if np.mean((tile == 0) | (tile == 255)) <= CLIPPED_SHARE] or tiles
    by_shape: dict[tuple[int, ...], list[NDArray[np.uint8]]] = {}
    for tile in usable:
        by_shape.setdefault(tile.shape, []).append(tile)
    noise = np.concatenate([_tile_noise(np.stack(tiles)) for tiles in by_shape.values()])
    return float(np.percentile(noise, FLAT_PERCENTILE))


def _middle(start: int, end: int) -> slice:
    """Returns the middle of a tile's rows or columns, LARGEST_TILE at most."""
    cut = max(0, end - start - LARGEST_TILE) // 2
    return slice(start + cut, end - cut)


def _tile_noise(tiles: NDArray[np.uint8]) -> NDArray[np.float32]:  # [N]
    """Returns the noise of each tile [N, H, W, 3] in 1/255, the mean over its channels."""
    terms = tiles.transpose(0, 3, 1, 2).astype(np.float32, order="C")
    for _ in ("columns", "rows"):
        bends = np.diff(terms, 2)  # exactly 0 where a tile is flat
        terms = (DETAIL[0] * bends[..., :-1:2] + DETAIL[1] * bends[..., 1::2]).swapaxes(2, 3)
    sizes = np.abs(terms).reshape(*terms.shape[:2], -1)
    return np.asarray(np.median(sizes, axis=2).mean(axis=1), np.float32) / NORMAL_QUARTILE


def bilateral(
    rgb: NDArray[np.uint8],  # [H, W, 3]
    noise: float,  # its standard deviation in 1/255
    strength: float,  # range sigma as a multiple of the noise
) -> NDArray[np.uint8]:  # [H, W, 3]
    """Returns a frame after a bilateral filter (Tomasi and Manduchi 1998).

    OpenCV compares colours by the sum of the three channels' differences, which for pure noise is
    3.4 times its sigma; a range of about four times the noise is therefore narrow.
    """
    return np.asarray(cv2.bilateralFilter(rgb, DIAMETER, strength * noise, SIGMA_SPACE), np.uint8)
