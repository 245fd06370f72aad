"""Corrections that a DNG asks its reader for, and LibRaw leaves out: lens shading and distortion.

Phones describe the shading of their lens by maps of gains (GainMap, before demosaicing), cameras by
a polynomial (FixVignetteRadial), and many the distortion (WarpRectilinear). Left out, corners are
dark, and a point's brightness depends on where in the picture it is. Gains are applied to the
values of the sensor, those for after demosaicing, too: they vary too slowly for neighbours to
differ. The warp is applied to the developed picture. Source: Digital Negative Specification 1.7.1,
chapter 7.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rawpy
from numpy.typing import NDArray
from PIL.ExifTags import Base as Tag

from recon_cli.capture.tiff import Photometric, read_directories

# The opcodes that change brightness or geometry, by their codes; three of them are applied.
_OPCODES = {
    1: "WarpRectilinear", 2: "WarpFisheye", 3: "FixVignetteRadial", 7: "MapTable",
    8: "MapPolynomial", 9: "GainMap", 10: "DeltaPerRow", 11: "DeltaPerColumn", 12: "ScalePerRow",
    13: "ScalePerColumn", 14: "WarpRectilinear2"}
UNREADABLE = (OSError, SyntaxError, ValueError, TypeError, IndexError, struct.error)
GRID = 65  # knots a side of a polynomial's grid: between them it is off by some 1e-4


@dataclass(frozen=True, eq=False)
class GainMap:
    """Gains in a grid over the picture, for some rows, columns and planes."""

    rows: slice
    columns: slice
    planes: range
    origin: tuple[float, float]  # of the grid, down and across, in shares of the picture
    spacing: tuple[float, float]
    gains: NDArray[np.float32]  # [V, H, P]; the last plane is for those that follow, too
    of_colours: bool = False  # its planes are colours, where a mosaic itself is one plane

    def at(self, height: int, width: int) -> NDArray[np.float32]:
        """Returns the gains [rows, columns, P] in a picture of this size, linear between knots."""
        down, across = (
            _weights((np.arange(size)[part] + 0.5) / size, knots, origin, spacing)
            for size, part, knots, origin, spacing in zip(
                (height, width), (self.rows, self.columns), self.gains.shape, self.origin,
                self.spacing, strict=False))
        return np.stack([down @ plane @ across.T for plane in np.moveaxis(self.gains, 2, 0)], 2)


@dataclass(frozen=True)
class Warp:
    """Where the pixels of the picture lie in the distorted one, by colour, or for all alike."""

    terms: tuple[tuple[float, ...], ...]  # [1 or 3] of kr0 to kr3, kt0 and kt1
    centre: tuple[float, float]  # across and down, in shares of the picture

    def apply(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Returns a picture [H, W, 3], as it lies on the sensor, without distortion."""
        parts = [rgb] if len(self.terms) == 1 else cv2.split(rgb)
        height, width = rgb.shape[:2]
        moved = [cv2.remap(part, *self.sources(height, width, plane), cv2.INTER_CUBIC,
                           borderMode=cv2.BORDER_REPLICATE)
                 for plane, part in enumerate(parts)]
        return np.asarray(moved[0] if len(moved) == 1 else cv2.merge(moved), np.uint8)

    def sources(
        self, height: int, width: int, plane: int = 0
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Returns column and row, [H, W] each, in the distorted picture."""
        kr0, kr1, kr2, kr3, kt0, kt1 = self.terms[plane]
        x, y, unit = _from_centre(self.centre, height, width)
        square = x**2 + y**2
        radial = kr0 + square * (kr1 + square * (kr2 + square * kr3))
        across = x * radial + kt0 * 2 * x * y + kt1 * (square + 2 * x**2)
        down = y * radial + kt1 * 2 * x * y + kt0 * (square + 2 * y**2)
        return (across * unit + (self.centre[0] * width - 0.5),
                down * unit + (self.centre[1] * height - 0.5))


@dataclass(frozen=True)
class Corrections:
    """The corrections that a DNG asks for: gains first, in their order, then the warp."""

    gains: tuple[GainMap, ...] = ()
    warp: Warp | None = None
    left_out: tuple[str, ...] = ()  # the names of those that are not applied


def read_corrections(path: Path) -> Corrections:
    """Returns the corrections of a RAW file; none where it is not a DNG, or they are damaged."""
    with suppress(*UNREADABLE):
        for tags in read_directories(path):
            if tags.get(Tag.PhotometricInterpretation) in (
                    Photometric.MOSAIC, Photometric.LINEAR):
                return _collect(tags)
    return Corrections()


def correct_shading(raw: rawpy.RawPy, gains: Iterable[GainMap]) -> None:
    """Multiplies the values of an open RAW file above their black level, in place."""
    values, white = raw.raw_image_visible, raw.white_level
    black = np.array(raw.black_level_per_channel, np.float32)
    for gain in gains:
        factor = gain.at(*values.shape[:2])
        part = values[gain.rows, gain.columns]
        if values.ndim == 3:
            for plane in gain.planes[:part.shape[2]]:
                own = factor[..., min(plane - gain.planes[0], factor.shape[2] - 1)]
                _multiply(part[..., plane], black[plane], own, white)
            continue
        channels = np.asarray(raw.raw_colors_visible)[gain.rows, gain.columns]
        own = factor[..., 0]
        if gain.of_colours:
            colours = np.where(channels == 3, 1, channels).astype(int)  # the second green
            plane = np.clip(colours - gain.planes[0], 0, factor.shape[2] - 1)
            own = np.take_along_axis(factor, plane[..., None], 2)[..., 0]
            own = np.where(np.isin(colours, gain.planes), own, 1)
        _multiply(part, black[channels], own, white)


def _multiply(
    values: NDArray[np.uint16], black: Any, factor: NDArray[np.float32], white: int
) -> None:
    values[:] = np.clip(black + (values - black) * factor + 0.5, 0, white)


def turn(picture: NDArray[np.uint8], flip: int) -> NDArray[np.uint8]:
    """Returns a picture as LibRaw turns it: its flip has bits for rows, columns and both."""
    picture = picture[::-1 if flip & 2 else 1, ::-1 if flip & 1 else 1]
    return np.ascontiguousarray(picture.swapaxes(0, 1) if flip & 4 else picture)


def describe_corrections(corrections: Sequence[Corrections]) -> list[str]:
    """Returns notices on what is, and is not, applied to the RAW photos of a set."""
    notices = []
    shaded = [one for one in corrections if one.gains]
    if shaded:
        most = max(float(gain.gains.max()) for one in shaded for gain in one.gains)
        notices.append(f"The lens shading of {_count(len(shaded))} is corrected as DNG says, by "
                       f"gains up to {most:.2f}.")
    if warped := sum(one.warp is not None for one in corrections):
        notices.append(f"The lens distortion of {_count(warped)} is corrected as DNG says.")
    for name, count in Counter(name for one in corrections for name in one.left_out).items():
        notices.append(f"A correction of {_count(count)} is not applied ({name}): brightness or "
                       "geometry may be off. The camera's program can save the photos as TIFF.")
    return notices


def _count(photos: int) -> str:
    return f"{photos} RAW photo{'s' * (photos != 1)}"


def _collect(tags: Mapping[int, Any]) -> Corrections:
    top, left, bottom, right = tags.get(
        Tag.ActiveArea, (0, 0, tags[Tag.ImageLength], tags[Tag.ImageWidth]))
    gains, warp, left_out = list[GainMap](), None, list[str]()
    for tag in (Tag.OpcodeList2, Tag.OpcodeList3):  # for before and after demosaicing
        for name, data in _opcodes(tags.get(tag, bytes(4))):
            if name not in ("WarpRectilinear", "GainMap", "FixVignetteRadial"):
                left_out.append(name)
            elif warp is not None:
                left_out.append("corrections behind a warp")
            elif name == "WarpRectilinear":
                warp = _read_warp(data)
            elif name == "GainMap":
                gains.append(_read_gain_map(data, of_colours=tag is Tag.OpcodeList3))
            else:
                gains.append(_read_vignette(data, bottom - top, right - left))
    return Corrections(tuple(gains), warp, tuple(dict.fromkeys(left_out)))


def _opcodes(data: bytes) -> Iterator[tuple[str, bytes]]:
    """Yields the names of `_OPCODES` in a list, each with its parameters; they are big-endian."""
    count, = struct.unpack_from(">I", data)
    place = 4
    for _ in range(count):
        code, _, _, length = struct.unpack_from(">4I", data, place)
        if code in _OPCODES:
            yield _OPCODES[code], data[place + 16:place + 16 + length]
        place += 16 + length


def _read_gain_map(data: bytes, *, of_colours: bool) -> GainMap:
    (top, left, bottom, right, plane, planes, row_pitch, column_pitch, down, across, *grid, parts
     ) = struct.unpack_from(">10I4dI", data)
    gains = np.frombuffer(data, ">f4", down * across * parts, struct.calcsize(">10I4dI"))
    return GainMap(
        slice(top, bottom, row_pitch), slice(left, right, column_pitch),
        range(plane, plane + planes), (grid[2], grid[3]), (grid[0], grid[1]),
        gains.reshape(down, across, parts).astype(np.float32), of_colours)


def _read_vignette(data: bytes, height: int, width: int) -> GainMap:
    """Returns 1 + k0 r^2 + ... + k4 r^10, with r = 1 in the farthest corner, as a grid."""
    *terms, x, y = struct.unpack_from(">7d", data)
    across, down = (np.linspace(0, 1, GRID) - at for at in (x, y))
    square = (across * width)[None] ** 2 + (down * height)[:, None] ** 2
    square /= max(x, 1 - x)**2 * width**2 + max(y, 1 - y)**2 * height**2
    gains = np.polynomial.polynomial.polyval(square, [1, *terms])
    step = 1 / (GRID - 1)
    return GainMap(slice(None), slice(None), range(4), (0, 0), (step, step),
                   gains[..., None].astype(np.float32))


def _read_warp(data: bytes) -> Warp:
    planes, = struct.unpack_from(">I", data)
    values = struct.unpack_from(f">{6 * planes + 2}d", data, 4)
    terms = tuple(values[6 * plane:6 * plane + 6] for plane in range(planes))
    # one for all colours, or one for each
    return Warp(terms if len(set(terms)) == 3 == planes else terms[:1], (values[-2], values[-1]))


def _from_centre(
    centre: tuple[float, float], height: int, width: int
) -> tuple[NDArray[np.float32], NDArray[np.float32], float]:
    """Returns how far pixels are right of and below a centre, and the pixels of their unit.

    The unit is the distance to the farthest corner.
    """
    x, y = centre[0] * width, centre[1] * height
    unit = float(np.hypot(max(x, width - x), max(y, height - y)))
    across = (np.arange(width, dtype=np.float32)[None] + np.float32(0.5 - x)) / unit
    down = (np.arange(height, dtype=np.float32)[:, None] + np.float32(0.5 - y)) / unit
    return across, down, unit


def _weights(
    at: NDArray[np.float64], knots: int, origin: float, spacing: float
) -> NDArray[np.float32]:
    """Returns the weights [N, knots] of a grid's knots for linear interpolation within it."""
    place = np.clip((at - origin) / (spacing or 1), 0, knots - 1)
    distance = np.abs(place[:, None] - np.arange(knots))
    return np.asarray(np.maximum(1 - distance, 0), np.float32)
