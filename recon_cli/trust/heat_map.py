"""Expected errors as pictures: 16 bits for programs, colours for people."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

FULL = int(np.iinfo(np.uint16).max)  # steps of a picture for an error of 1, all of a channel
# Errors that are drawn blue and red; between them colours follow the logarithm, the same in every
# scene. Two rendered rooms have .004 to .07 between the best and the worst tenth of the pixels.
TRUSTED, INVENTED = 0.005, 0.2
_SPAN = (0.1, 0.95)  # of the colour map, whose ends are nearly black
_TINT = 0.65  # of a tinted colour


def error_steps(expected: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Returns expected errors of 0 to 1 in 16 bits."""
    return np.asarray(np.rint(expected.clip(0, 1).astype(np.float64) * FULL), np.uint16)


def heat_colors(expected: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Returns colours [..., 3] of expected errors [...]: blue is trusted, red is unreliable."""
    share = np.log(np.maximum(expected, 1e-6) / TRUSTED) / np.log(INVENTED / TRUSTED)
    level = _SPAN[0] + (_SPAN[1] - _SPAN[0]) * np.clip(share, 0, 1)
    steps = np.rint(255 * level).astype(np.uint8).reshape(1, -1)
    colors = cv2.applyColorMap(steps, cv2.COLORMAP_TURBO)[0, :, ::-1]
    return np.asarray(colors, np.uint8).reshape(*expected.shape, 3)


def tint(colors: NDArray[np.uint8], expected: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Returns colours [N, 3] mixed with those of expected errors [N]."""
    mixed = (1 - _TINT) * colors.astype(np.float32) + _TINT * heat_colors(expected)
    return np.asarray(np.rint(mixed), np.uint8)


def legend_stops() -> list[str]:
    """Returns CSS colours from trusted to unreliable, evenly spread."""
    errors = np.geomspace(TRUSTED, INVENTED, 9, dtype=np.float32)
    return [f"rgb({r},{g},{b})" for r, g, b in heat_colors(errors).tolist()]
