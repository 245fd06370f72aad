"""Edge-preserving filters that remove noise of a known level from 8-bit frames.

PSNR in dB and share of the edges kept (`compare.edges_kept`) at noise of 5, 10, 15 and 20 of 255:
means over ten frames of five captures (fox, two rendered rooms, desk_monitors, snowmiku; photos
halved first), each filter at its best strength; time relative to bilateral
(tests/bench/bench_denoise.py):

    none              34.2 1.00   28.2 1.00   24.7  .99   22.3  .99    0
    joint, 4          40.2 1.00   36.5  .99   34.3  .98   32.7  .97   4.5
    bilateral, 4      39.9  .99   35.8  .97   33.2  .94   31.3  .92   1
    guided, 1.5       39.3  .99   34.5  .96   31.5  .93   29.5  .90   2.6
    non-local means   37.6 1.00   33.7  .98   31.7  .94   30.4  .89   35

joint is closest to the truth and keeps most edges at every level: it is the default. The guided
filter (He et al. 2010) and non-local means lose to both others and are not offered.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray


class Filter(Protocol):
    """Takes noise of a level in 1/255 out of a frame [H, W, 3]."""

    def __call__(
        self, rgb: NDArray[np.uint8], noise: float, strength: float
    ) -> NDArray[np.uint8]:
        """Returns the filtered frame."""


# For bilateral, measured on four rendered frames and a photo of 430x770, noise of 15 added
# (24.8 dB): 7 pixels and 2.0 gain 7.3 dB at four times the noise, 5 pixels 6.8 dB, 9 pixels
# 7.4 dB for twice the time.
DIAMETER, SIGMA_SPACE = 7, 2.0
# The first guide is this much blurred. .5 keeps more noise (-.2 dB at noise of 20), .7 blurs fine
# texture (-.3 dB at noise of 5).
GUIDE_BLUR, GUIDE_BLUR_SIZE = 0.6, 5
# The second guide comes from a small window, so that nothing far away enters it; the result from
# 9 pixels, .5 dB more than 7 at noise of 20.
GUIDE_DIAMETER, GUIDE_SIGMA_SPACE = 5, 1.0
JOINT_DIAMETER, JOINT_SIGMA_SPACE = 9, 2.5


def bilateral(
    rgb: NDArray[np.uint8],  # [H, W, 3]
    noise: float,
    strength: float,
) -> NDArray[np.uint8]:  # [H, W, 3]
    """Returns a frame after a bilateral filter (Tomasi and Manduchi 1998).

    OpenCV compares colours by the sum of the three channels' differences, which for pure noise is
    3.4 times its sigma; a range of about four times the noise is therefore no wide one.

    Args:
        rgb: the frame.
        noise: its standard deviation in 1/255.
        strength: range sigma as a multiple of the noise.
    """
    return np.asarray(
        cv2.bilateralFilter(rgb, DIAMETER, strength * noise, SIGMA_SPACE), np.uint8)


def joint(
    rgb: NDArray[np.uint8],  # [H, W, 3]
    noise: float,
    strength: float,
) -> NDArray[np.uint8]:  # [H, W, 3]
    """Returns a frame after two joint bilateral filters, each led by a less noisy guide.

    The weights come from a guide in place of the frame (Petschnigg et al. 2004, Eisemann and
    Durand 2004): first from the frame slightly blurred, then from what that gave (Zhang et al.
    2014, rolling guidance). Less noise in the weights lets the range be half as wide, and edges
    stay.

    Args:
        rgb: the frame.
        noise: its standard deviation in 1/255.
        strength: range sigma as a multiple of the noise that is left in the blurred guide.
    """
    # Filtering with a kernel leaves this share of white noise: the root of its sum of squares,
    # which for a kernel that is the same along rows and columns is the sum along one of them.
    left = float(np.sum(cv2.getGaussianKernel(GUIDE_BLUR_SIZE, GUIDE_BLUR) ** 2))
    reach = strength * left * noise
    blurred = cv2.GaussianBlur(rgb, (GUIDE_BLUR_SIZE, GUIDE_BLUR_SIZE), GUIDE_BLUR)
    guide = cv2.ximgproc.jointBilateralFilter(
        blurred, rgb, GUIDE_DIAMETER, reach, GUIDE_SIGMA_SPACE)
    return np.asarray(cv2.ximgproc.jointBilateralFilter(
        guide, rgb, JOINT_DIAMETER, reach, JOINT_SIGMA_SPACE), np.uint8)


FILTERS: Mapping[str, Filter] = {"joint": joint, "bilateral": bilateral}
