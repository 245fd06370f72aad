"""Depth maps of data sets: z-depth with its unit, confidence and reliable range."""

from __future__ import annotations

import math
import struct
import warnings
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from recon_cli.datasets import lzfse_stream
from recon_cli.errors import FormatError
from recon_cli.io.exr import read_exr
from recon_cli.scene.camera import MODELS, Lens
from recon_cli.workspace.records import Confidence

MILLIMETRE = 1e-3
LIDAR_RANGE = 5.0  # metres; beyond it, phones' depth is a guess
_PACKED = (".depth", ".conf")  # Record3D's, without a header
_MAX_DEPTH = float(np.finfo(np.float32).max)
_HINT = "Copy the file again, or delete it to go without its depth."


@dataclass(frozen=True)
class ConfidenceFile:
    """Reads how far each value of a depth map can be trusted."""

    path: Path
    high: int = Confidence.HIGH  # value of the file that means high; medium is half of it

    def __call__(self, height: int, width: int) -> NDArray[np.uint8]:
        """Returns [height, width] of `Confidence`; FormatError if damaged or otherwise."""
        stored = _read(self.path, np.dtype(np.uint8), (height, width)).astype(np.float64)
        if stored.shape != (height, width):
            raise FormatError(
                f"{self.path} is {stored.shape[1]}x{stored.shape[0]} pixels, but its depth "
                f"{width}x{height}.", hint=_HINT)
        if stored.max(initial=0) > self.high:
            raise FormatError(
                f"{self.path} holds {stored.max():g}; known are 0 to {self.high}.", hint=_HINT)
        return np.asarray(np.rint(stored * (Confidence.HIGH / self.high)), np.uint8)


@dataclass(frozen=True)
class DepthFile:
    """Reads the z-depth of an image from its file.

    Depth of another size than the image is looked up at the nearest pixel along the same ray,
    because interpolation over an edge would give the depth of nothing. Distortion is left out.
    """

    path: Path  # the file
    unit: float  # world units of a value of 1
    lens: Lens  # intrinsics of the image
    own: Lens | None = None  # intrinsics of the depth; None if it covers the same field of view
    unknown: float = math.inf  # the value of the file that means unknown, as 0 does
    confidence: ConfidenceFile | None = None  # of each value; None where the data set has none
    reliable: float = math.inf  # world units; what is farther is a guess
    # (height, width) of a file that does not say it; None: as many of the image's shape as it has
    shape: tuple[int, int] | None = None
    make: Callable[[], NDArray[np.float32]] | None = None  # reads files that this module does not

    def __call__(self) -> NDArray[np.float32]:
        """Returns [H, W] z-depth at the size of the image, in world units, 0 where unknown.

        What has low confidence, or lies beyond the reliable range, is unknown. FormatError if the
        file is missing, damaged or no depth.
        """
        depth = self.read()
        depth[depth > self.reliable] = 0
        if self.confidence is not None:
            depth[self.confidence(*depth.shape) == Confidence.LOW] = 0
        height, width = depth.shape
        own = self.own_lens(width, height)
        if own == self.lens:
            return depth
        columns, inside_x = _nearest_pixels(self.lens, own, 0, self.lens.width, width)
        rows, inside_y = _nearest_pixels(self.lens, own, 1, self.lens.height, height)
        resampled: NDArray[np.float32] = depth[np.ix_(rows, columns)]
        resampled[~(inside_y[:, None] & inside_x[None, :])] = 0
        return resampled

    def read(self) -> NDArray[np.float32]:
        """Returns [h, w] z-depth as it lies in the file, in world units, 0 where unknown.

        FormatError if the file is missing, damaged or no depth.
        """
        if self.make is not None:
            return self.make() * np.float32(self.unit)
        shape = self.shape
        if shape is None and self.path.suffix.lower() in _PACKED:
            shape = _shape_like(self.path, self.lens)
        stored = _read(self.path, np.dtype("<f4"), shape).astype(np.float64)
        stored[~np.isfinite(stored)] = 0
        values = np.where(stored == self.unknown, 0, stored) * self.unit
        return np.where((values > 0) & (values < _MAX_DEPTH), values, 0).astype(np.float32)

    def read_confidence(self) -> NDArray[np.uint8] | None:
        """Returns [h, w] of `Confidence`, None where the data set has none."""
        return None if self.confidence is None else self.confidence(*self.read().shape)

    @property
    def files(self) -> tuple[Path, ...]:
        """The files that are read."""
        return (self.path, *([self.confidence.path] if self.confidence else []))

    def own_lens(self, width: int, height: int) -> Lens:
        """Returns the intrinsics of the depth map, of this size."""
        own = self.own if self.own is not None else self.lens.resized(width, height)
        return own if (width, height) == (own.width, own.height) else own.resized(width, height)

    def scaled(self, factor: float) -> DepthFile:
        """Returns the same depth in other units; the reliable range stays."""
        return replace(self, unit=self.unit * factor)

    def with_lens(self, lens: Lens) -> DepthFile:
        """Returns the depth of the same image with other intrinsics."""
        return replace(self, lens=lens)


def lidar_depth(
    path: Path | None, level: Path | None, lens: Lens, *, high: int = Confidence.HIGH
) -> DepthFile | None:
    """Returns a phone's depth in millimetres, None without a file; `level` is its confidence."""
    if path is None:
        return None
    confidence = ConfidenceFile(level, high) if level else None
    return DepthFile(path, MILLIMETRE, lens, confidence=confidence, reliable=LIDAR_RANGE)


def _read(path: Path, dtype: np.dtype[np.generic], shape: tuple[int, int] | None
          ) -> NDArray[np.generic]:
    """Returns the values [h, w] of a file; `dtype` and `shape` are those of a packed one."""
    if not path.is_file():
        raise FormatError(f"{path} is missing.", hint=_HINT)
    try:
        if path.suffix.lower() == ".npy":
            values = np.array(np.load(path, mmap_mode="r"))  # refuses a shape that the file lacks
        elif path.suffix.lower() == ".exr":
            values = read_exr(path)
        elif path.suffix.lower() in _PACKED:
            if shape is None:
                raise ValueError("nothing says how many pixels it has")
            data = lzfse_stream.decompress(path.read_bytes(), shape[0] * shape[1] * dtype.itemsize)
            values = np.frombuffer(data, dtype).reshape(shape)
        else:
            # Not OpenCV, which returns the first rows of a damaged PNG without an error.
            with warnings.catch_warnings():
                warnings.simplefilter("error", Image.DecompressionBombWarning)
                with Image.open(path, formats=("PNG", "TIFF")) as image:
                    values = np.asarray(image)
    except (OSError, ValueError, EOFError, SyntaxError, struct.error, zlib.error,
            Image.DecompressionBombWarning, Image.DecompressionBombError) as error:
        raise FormatError(f"{path} cannot be read as depth: {error}.", hint=_HINT) from error
    if values.ndim != 2 or values.dtype.kind not in "uif" or not values.size:
        raise FormatError(
            f"{path} is not a depth image: it holds {values.dtype} of shape {values.shape}, "
            "needed one value a pixel.", hint=_HINT)
    return values


def _shape_like(path: Path, lens: Lens) -> tuple[int, int]:
    """Returns (height, width) of a packed file of float32 that has the shape of its image."""
    try:
        count = lzfse_stream.decoded_size(path.read_bytes()) / 4
    except (OSError, ValueError) as error:
        raise FormatError(f"{path} cannot be read as depth: {error}.", hint=_HINT) from error
    width = round(math.sqrt(count * lens.width / lens.height))
    height = round(count / max(width, 1))
    if width * height != count or abs(width * lens.height - height * lens.width) > max(
            lens.width, lens.height):
        raise FormatError(
            f"{path} holds {count:g} values, and nothing says in how many rows.", hint=_HINT)
    return height, width


def _nearest_pixels(
    image: Lens, own: Lens, axis: int, size: int, own_size: int
) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Returns the pixel of the depth that each pixel of the image falls in, and whether any."""
    focal, center = _axis(image, axis)
    own_focal, own_center = _axis(own, axis)
    rays = (np.arange(size) + 0.5 - center) / focal
    # The tiny offset decides exact halves, which rounding would otherwise do.
    at = np.floor(rays * own_focal + own_center + 1e-6).astype(np.intp)
    return at.clip(0, own_size - 1), (at >= 0) & (at < own_size)


def _axis(lens: Lens, axis: int) -> tuple[float, float]:
    """Returns focal length and principal point along x or y."""
    focals, _ = MODELS[lens.model]
    return lens.params[axis if focals == 2 else 0], lens.params[focals + axis]
