"""Files of z-depth, read when they are asked for: 16-bit PNG, TIFF, or .npy."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from recon_cli.errors import FormatError
from recon_cli.scene.lens import MODELS, Lens

_FARTHEST = float(np.finfo(np.float32).max)


@dataclass(frozen=True)
class DepthFile:
    """Reads the z-depth of an image from its file.

    Depth of another size than the image is looked up at the nearest pixel along the same ray, for a
    mean over an edge would be the depth of nothing. The rays are compared without distortion.

    Attributes:
        path: the file.
        unit: world units of a value of 1.
        lens: intrinsics of the image.
        own: intrinsics of the depth; None where it covers the same field of view.
    """

    path: Path
    unit: float
    lens: Lens
    own: Lens | None = None

    def __call__(self) -> NDArray[np.float32]:
        """Returns [H, W] z-depth at the size of the image, in world units, 0 where there is none.

        Raises:
            FormatError: the file is missing, damaged or no depth.
        """
        values = _read(self.path)
        exact = values.astype(np.float64) * self.unit
        depth = np.where((exact > 0) & (exact < _FARTHEST), exact, 0).astype(np.float32)
        height, width = depth.shape
        own = self.own if self.own is not None else self.lens.resized(width, height)
        if (width, height) != (own.width, own.height):
            own = own.resized(width, height)
        if own == self.lens:
            return depth
        columns, inside_x = _nearest(_axis(self.lens, 0), _axis(own, 0), self.lens.width, width)
        rows, inside_y = _nearest(_axis(self.lens, 1), _axis(own, 1), self.lens.height, height)
        found: NDArray[np.float32] = depth[np.ix_(rows, columns)]
        found[~(inside_y[:, None] & inside_x[None, :])] = 0
        return found


def _read(path: Path) -> NDArray[np.generic]:
    hint = "Copy the file again, or delete it to go without its depth."
    if not path.is_file():
        raise FormatError(f"{path} is missing.", hint=hint)
    try:
        if path.suffix.lower() == ".npy":
            values = np.asarray(np.load(path, allow_pickle=False))
        else:
            # Not OpenCV, which gives the first rows of a damaged PNG for the whole.
            with Image.open(path, formats=("PNG", "TIFF")) as image:
                values = np.asarray(image)
    except (OSError, ValueError, EOFError, SyntaxError, struct.error, zlib.error) as error:
        raise FormatError(f"{path} is no depth that can be read: {error}.", hint=hint) from error
    if values.ndim != 2 or values.dtype.kind not in "uif" or not values.size:
        raise FormatError(
            f"{path} is no depth: it holds {values.dtype} of shape {values.shape}, needed one "
            "value a pixel.", hint=hint)
    return values


def _axis(lens: Lens, axis: int) -> tuple[float, float]:
    """Returns focal length and principal point along x or y."""
    focals, _ = MODELS[lens.model]
    return lens.params[axis if focals == 2 else 0], lens.params[focals + axis]


def _nearest(
    image: tuple[float, float], own: tuple[float, float], size: int, own_size: int
) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Returns the pixel of the depth that each pixel of the image falls in, and whether any."""
    rays = (np.arange(size) + 0.5 - image[1]) / image[0]
    # The tiny nudge decides for exact halves, where rounding would.
    at = np.floor(rays * own[0] + own[1] + 1e-6).astype(np.intp)
    return at.clip(0, own_size - 1), (at >= 0) & (at < own_size)
