"""Whether pictures of one channel and 16 bits show depth, whatever they are called."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.io.images import decode_file

# The inverse depth of a plane is linear in the image. Its second differences, relative to it and in
# the median of the pixels, were .003 to .006 in the depth of two rooms and of a phone, and .03 to
# .5 in the gray photos of ten captures, the least of them with blurred walls.
_SMOOTH, _ROUGH = 0.012, 0.03
# Between the two brightness decides. As a photo, depth in millimetres is nearly black: rooms end at
# 16 m, a quarter of the range. So are photos of 12 bits, but the brightest thousandth of other gray
# photos of ten captures lay above four fifths of it.
_DARK, _BRIGHTEST = 0.25, 0.999
_SIDE = 160  # pixels of the longer side that is looked at


def look_like_depth(paths: Sequence[Path]) -> bool:
    """Returns whether pictures are depth maps, by the median of what they show."""
    looks = [_look(data) for path in paths
             if (data := decode_file(path, cv2.IMREAD_UNCHANGED)) is not None and data.ndim == 2]
    measured = [look for look in looks if look is not None]
    if not measured:
        return False
    bright, rough = np.median(measured, axis=0)
    return bool(rough < (_ROUGH if bright < _DARK else _SMOOTH))


def _look(data: NDArray[Any]) -> tuple[float, float] | None:
    """Returns how bright and how rough a picture [H, W] is; None where it shows nothing."""
    most = float(np.iinfo(data.dtype).max) if data.dtype.kind in "ui" else 1.0
    side = max(data.shape)
    small = np.asarray(data[::max(1, side // _SIDE), ::max(1, side // _SIDE)], np.float32)
    known = small > 0
    if not known.any():
        return None
    inverse = np.where(known, 1 / np.maximum(small, 1e-12), 0).astype(np.float32)
    differences = np.abs(cv2.Laplacian(inverse, cv2.CV_32F))
    inside = cv2.erode(known.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    rough = float(np.median(differences[inside] / inverse[inside])) if inside.any() else np.inf
    return float(np.quantile(small[known], _BRIGHTEST)) / most, rough
