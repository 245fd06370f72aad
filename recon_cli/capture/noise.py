"""The noise of a frame: its estimate, and the filters that remove it.

The estimate uses only the flat parts of a frame, where it reads at most 2.5/255 on clean frames of
a richly textured room (4 on whole frames). Noise below 3 is left: a codec has smoothed it already,
and no filter gains more than .2 dB (tests/bench/bench_denoise.py --decoded).

PSNR in dB and share of the edges kept at noise of 5, 10, 15 and 20 of 255: means over ten frames of
five captures (fox, two rendered rooms, desk_monitors, snowmiku; photos halved first), each filter
at its best strength; time relative to bilateral (tests/bench/bench_denoise.py):

    none              34.2 1.00   28.2 1.00   24.7  .99   22.3  .99    0
    joint, 4          40.2 1.00   36.5  .99   34.3  .98   32.7  .97   4.5
    bilateral, 4      39.9  .99   35.8  .97   33.2  .94   31.3  .92   1

joint is the default.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Protocol

import cv2
import numpy as np
import pywt
from numpy.typing import NDArray

from recon_cli.errors import ConfigError

# 64 tiles leave 800 wavelet coefficients each in a frame of 600x340: known to 3%.
GRID, SMALLEST_TILE = 8, 16
# The 10th percentile finds tiles without texture as long as a tenth of the frame is plain.
FLAT_PERCENTILE = 10
NORMAL_QUARTILE = 0.6744897501960817  # of the standard normal distribution, at three quarters
# Tiles with more pixels than this at 0 or 255 are left out: clipping cuts the noise in half.
CLIPPED_SHARE = 0.02
# For bilateral: 7 pixels and 2.0 gain 7.3 dB at noise of 15, on four rendered frames and a photo;
# 5 pixels gain 6.8 dB, 9 pixels 7.4 dB for twice the time.
DIAMETER, SIGMA_SPACE = 7, 2.0
# Blur of the first guide. .5 keeps more noise (-.2 dB at 20), .7 blurs fine texture (-.3 dB at 5).
GUIDE_BLUR, GUIDE_BLUR_SIZE = 0.6, 5
# Window of the second guide; that of the result is 9, .5 dB more than 7 at noise of 20.
GUIDE_DIAMETER, GUIDE_SIGMA_SPACE = 5, 1.0
JOINT_DIAMETER, JOINT_SIGMA_SPACE = 9, 2.5


def estimate_noise(rgb: NDArray[np.uint8]) -> float:
    """Returns the noise of a frame [H, W, 3] as standard deviation in 1/255, 0 where it is flat.

    It is a low percentile over tiles of Donoho's median of the finest diagonal wavelet terms.
    """
    rows, columns = (
        np.linspace(0, length, max(1, min(GRID, length // SMALLEST_TILE)) + 1).astype(np.int64)
        for length in rgb.shape[:2])
    tiles = [rgb[top:bottom, left:right]
             for top, bottom in pairwise(rows) for left, right in pairwise(columns)]
    usable = [tile for tile in tiles
              if np.mean((tile == 0) | (tile == 255)) <= CLIPPED_SHARE] or tiles
    by_shape: dict[tuple[int, ...], list[NDArray[np.uint8]]] = {}
    for tile in usable:
        by_shape.setdefault(tile.shape, []).append(tile)
    noise = [level for tiles in by_shape.values() for level in _tile_noise(np.stack(tiles))]
    return float(np.percentile(noise, FLAT_PERCENTILE)) * 255


def _tile_noise(tiles: NDArray[np.uint8]) -> list[float]:
    """Returns the noise of each tile [N, H, W, 3] in [0, 1], the mean over its channels."""
    # All tiles in one transform; skimage's estimate_sigma, which does the same for one channel,
    # imports scipy.stats for the one number below.
    terms = pywt.dwtn(np.moveaxis(tiles / 255.0, -1, 1), "db2", axes=(-2, -1))["dd"]
    terms[np.ptp(tiles, axis=(1, 2)) == 0] = 0  # a flat channel's terms are rounding
    return [float(np.sum([_deviation(channel) for channel in tile])) / 3 for tile in terms]


def _deviation(terms: NDArray[np.float64]) -> float:
    """Returns the standard deviation of normal noise by the median of its terms that are not 0."""
    present = terms[np.nonzero(terms)]
    return float(np.median(np.abs(present))) / NORMAL_QUARTILE if len(present) else 0.0


class Filter(Protocol):
    """Removes noise of a level in 1/255 from a frame [H, W, 3]."""

    def __call__(self, rgb: NDArray[np.uint8], noise: float, strength: float) -> NDArray[np.uint8]:
        """Returns the filtered frame."""


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


def joint(
    rgb: NDArray[np.uint8],  # [H, W, 3]
    noise: float,  # its standard deviation in 1/255
    strength: float,  # range sigma as a multiple of the noise that is left in the blurred guide
) -> NDArray[np.uint8]:  # [H, W, 3]
    """Returns a frame after two joint bilateral filters, each with a less noisy guide.

    The weights come from a guide instead of the frame (Petschnigg et al. 2004, Eisemann and Durand
    2004): first the frame slightly blurred, then the result of that (Zhang et al. 2014, rolling
    guidance). Less noise in the weights lets the range be half as wide, which keeps edges.

    Raises:
        ConfigError: OpenCV lacks its contributed modules.
    """
    if not hasattr(cv2, "ximgproc"):
        raise ConfigError(
            "This OpenCV has no joint bilateral filter: another package of OpenCV was installed "
            "over opencv-contrib-python-headless.",
            hint="Type `pip uninstall opencv-python opencv-python-headless`, then `pip install "
            "--force-reinstall opencv-contrib-python-headless`; or take "
            "`recon denoise --filter bilateral`.")
    # Share of white noise that the separable blur leaves: the sum of squares along one axis.
    left = float(np.sum(cv2.getGaussianKernel(GUIDE_BLUR_SIZE, GUIDE_BLUR) ** 2))
    reach = strength * left * noise
    blurred = cv2.GaussianBlur(rgb, (GUIDE_BLUR_SIZE, GUIDE_BLUR_SIZE), GUIDE_BLUR)
    guide = cv2.ximgproc.jointBilateralFilter(
        blurred, rgb, GUIDE_DIAMETER, reach, GUIDE_SIGMA_SPACE)
    return np.asarray(cv2.ximgproc.jointBilateralFilter(
        guide, rgb, JOINT_DIAMETER, reach, JOINT_SIGMA_SPACE), np.uint8)


FILTERS: Mapping[str, Filter] = {"joint": joint, "bilateral": bilateral}
