"""Edge-preserving filters that remove noise of a known level from 8-bit frames.

Means over 10 crops and frames of five captures (fox, two rendered rooms, desk_monitors, snowmiku;
photos halved first), PSNR in dB | share of the edges kept, at noise of 5, 10 and 20 of 255
(tests/bench/bench_denoise.py):

    none              34.2 | .999   28.2 | .998   22.3 | .988   0    s/MP
    bilateral         39.5 | .995   35.4 | .975   31.0 | .917   .03
    joint             39.8 | .999   36.1 | .995   32.4 | .967   .14
    guided, 1.5       38.9 | .990   34.1 | .965   29.1 | .896   .06
    non-local means   38.3 | .999   34.7 | .965   31.6 | .839   .90

joint is best or equal everywhere and is the default. The guided filter (He et al. 2010) loses to
both others and is not offered; non-local means costs six times as much.
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


# Measured on four rendered frames and a photo of 430x770, noise of 15 added (24.8 dB): 7 pixels
# and 2.0 gain 7.3 dB at four times the noise, 5 pixels 6.8 dB, 9 pixels 7.4 dB for twice the time.
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
