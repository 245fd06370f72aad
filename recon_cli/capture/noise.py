"""How noisy a frame is.

The estimate looks at the flat parts of a frame alone. Taken over whole frames, the same estimator
reads up to 4/255 off clean frames of a richly textured room, as much as off truly noisy ones;
over the flat parts it reads at most 2.5/255 there, and 4.6 to 5.5 where noise of 5 was added.

A threshold of 3 leaves noise alone that a video codec has already smoothed: decoded frames of two
noisy room videos read .8 to 2.4, and no filter at any strength brings them more than .2 dB closer
to their clean originals (tests/bench/bench_denoise.py --decoded).
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from skimage.restoration import estimate_sigma

# 64 tiles leave 800 wavelet coefficients each in a frame of 600x340: known to 3%.
GRID, SMALLEST_TILE = 8, 16
# The 10th percentile finds tiles without texture as long as a tenth of the frame is plain.
FLAT_PERCENTILE = 10
# Tiles with more pixels than this at 0 or 255 are left out: clipping cuts the noise in half.
CLIPPED_SHARE = 0.02


def estimate_noise(
    rgb: NDArray[np.uint8],  # [H, W, 3]
) -> float:
    """Returns the standard deviation of the noise in 1/255, 0 where a frame is plainly flat.

    The source is Donoho's median of the finest diagonal wavelet coefficients (scikit-image), here
    by tiles, of which a low percentile is taken. Frames that a video codec has smoothed read low,
    as they should: nothing is left in them to remove.
    """
    height, width = rgb.shape[:2]
    rows, columns = _edges(height), _edges(width)
    sigmas, clipped = [], []
    for top, bottom in pairwise(rows):
        for left, right in pairwise(columns):
            tile = rgb[top:bottom, left:right]
            sigmas.append(_tile_noise(tile))
            clipped.append(np.mean((tile == 0) | (tile == 255)) > CLIPPED_SHARE)
    telling = np.array(sigmas)[~np.array(clipped)] if not all(clipped) else np.array(sigmas)
    return float(np.percentile(telling, FLAT_PERCENTILE)) * 255


def _edges(length: int) -> NDArray[np.int64]:
    """Returns where the tiles along one side begin and end."""
    count = max(1, min(GRID, length // SMALLEST_TILE))
    return np.linspace(0, length, count + 1).astype(np.int64)


def _tile_noise(tile: NDArray[np.uint8]) -> float:
    """Returns the noise of a tile in [0, 1], the mean over its channels."""
    channels = [channel for channel in np.moveaxis(tile / 255.0, -1, 0) if np.ptp(channel) > 0]
    # The estimator has no answer (NaN) where all coefficients are exactly 0.
    return float(np.sum(np.nan_to_num([estimate_sigma(channel) for channel in channels]))) / 3
