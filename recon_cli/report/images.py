"""Pictures as data URIs within a budget: one file holds all of them and can still be mailed."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from recon_cli.io.images import fitted_size

MAX_FILE_BYTES = 15_000_000
_PREFIX = "data:image/webp;base64,"
GAIN = 4  # of a difference, as in evaluate/difference
MOST_ERROR = 64  # mean error in 1/255 from which on colours no longer change: 255 / GAIN
_HIDDEN = (96, 96, 96)  # what a mask ignores, in a difference: no colour of the map


@dataclass(frozen=True)
class Rung:
    """One way to store pictures: longest side in pixels and WebP's quality, 0 to 100."""

    longest: int
    quality: int


# Tried in this order until the budget holds. At 86 no difference is seen at arm's length; sizes go
# down before qualities do, since what a slider compares is blur, not pixels.
RUNGS = (Rung(1600, 86), Rung(1200, 84), Rung(900, 82), Rung(680, 80), Rung(560, 78),
         Rung(480, 75), Rung(420, 73), Rung(360, 70), Rung(300, 66), Rung(240, 62))

_SHEET = Rung(2000, 80)  # as ingest draws it, so that its captions can be read
_SHEET_BYTES = 900_000


def reduced(image: NDArray[np.uint8], longest: int) -> NDArray[np.uint8]:
    """Returns an image [H, W, 3] reduced by area so that its longer side is at most `longest`."""
    height, width = image.shape[:2]
    size = fitted_size(width, height, longest)
    if size == (width, height):
        return image
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def data_uri(image: NDArray[np.uint8], quality: int) -> Markup:
    """Returns RGB pixels [H, W, 3] as WebP in an address that holds them; nothing to escape."""
    encoded, data = cv2.imencode(
        ".webp", np.ascontiguousarray(image[:, :, ::-1]), [cv2.IMWRITE_WEBP_QUALITY, quality])
    if not encoded:
        raise ValueError(f"OpenCV cannot encode an image of shape {image.shape}")
    return Markup(_PREFIX + base64.b64encode(data.tobytes()).decode())


def sheet(image: NDArray[np.uint8]) -> Markup:
    """Returns a contact sheet as large as its share of the file allows."""
    for rung in (_SHEET, *RUNGS):
        uri = data_uri(reduced(image, rung.longest), rung.quality)
        if len(uri) <= _SHEET_BYTES:
            break
    return uri


def error_of(
    truth: NDArray[np.uint8], render: NDArray[np.uint8], hidden: NDArray[np.bool_] | None,
    longest: int,
) -> NDArray[np.uint8]:
    """Returns the colours of what a render differs in, RGB [h, w, 3].

    The mean absolute difference of the channels is taken at full size, then reduced by area, so
    that a picture of any size shows the same error.

    Args:
        truth: [H, W, 3].
        render: [H, W, 3].
        hidden: [H, W], True where a mask ignores the pixel.
        longest: longest side of the picture.
    """
    apart = cv2.absdiff(truth, render)
    # channel by channel: a mean over the last axis takes six times as long
    error = (apart[..., 0].astype(np.float32) + apart[..., 1] + apart[..., 2]) / 3
    size = fitted_size(error.shape[1], error.shape[0], longest)
    if size != error.shape[::-1]:
        error = cv2.resize(error, size, interpolation=cv2.INTER_AREA)
    colors = colored(np.rint(error * GAIN).clip(0, 255).astype(np.uint8))
    if hidden is not None and hidden.any():
        small = cv2.resize(hidden.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        colors[small > 0.5] = _HIDDEN
    return colors


def colored(levels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Returns levels [H, W] as RGB from black over red to a pale yellow (matplotlib's inferno)."""
    return np.ascontiguousarray(cv2.applyColorMap(levels, cv2.COLORMAP_INFERNO)[..., ::-1])


def legend_stops(count: int = 9) -> Sequence[str]:
    """Returns the colours of a difference from none to the most, as CSS writes them."""
    levels = np.linspace(0, 255, count).round().astype(np.uint8)[None]
    return [f"rgb({r},{g},{b})" for r, g, b in colored(levels)[0]]
