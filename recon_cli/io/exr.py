"""OpenEXR images of one channel: depth maps, which OpenCV's wheel cannot read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

MAX_PIXELS = 1 << 28  # far more than any camera has; a header may say anything


def read_exr(path: Path) -> NDArray[np.float32]:
    """Returns the one channel [H, W] of an image; ValueError if damaged, or it has several.

    Depth is in Z, R or Y, by the program that wrote it. Values may be inf or nan.
    """
    import OpenEXR

    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            low, high = file.header()["dataWindow"]
            width, height = (int(b) - int(a) + 1 for a, b in zip(low, high, strict=True))
        if not (width > 0 and height > 0 and width * height <= MAX_PIXELS):
            raise ValueError(f"its header says {width}x{height} pixels")
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: np.asarray(channel.pixels)
                        for name, channel in file.channels().items()}
    except (RuntimeError, TypeError, KeyError) as error:
        raise ValueError(f"it is not an OpenEXR image, or damaged ({error})") from error
    names = [name for name in channels if name in ("Z", "R", "Y")]
    if len(channels) != 1 or not names:
        raise ValueError(f"it has the channels {', '.join(channels)}; needed is one of depth")
    return np.asarray(channels[names[0]], np.float32)
