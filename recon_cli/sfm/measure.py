"""--scale-between: the scale of a scene from a known distance between two of its places."""

from __future__ import annotations

import difflib
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import ConfigError
from recon_cli.io.colmap import Pinhole

# How far from a pixel a sparse point may lie, as a share of the image's width. In two rendered
# rooms picks within two pixels of a corner had a depth 0.5% and 0.7% off in the middle, 5% in the
# worst tenth; picks anywhere found a point within 3 pixels in a third of the cases, 1% off in the
# middle, and one of another surface in a sixth. Taking the foremost of all points around, rather
# than the nearest pixel, did worse: 8% in the worst tenth of the corners.
_REACH = 0.005
_LEAST_REACH = 4.0  # pixels
_EQUAL = 1e-6  # share of the distance to the origin; nearer than this is the same point
_HINT = (
    "A and B are each a frame's name, x,y,z or FRAME:u,v, such as --scale-between "
    "000003.png:120,200 000003.png:480,210 1.5")


@dataclass(frozen=True)
class ScaleBetween:
    """Two places, each a frame's name, "x,y,z" or "FRAME:u,v", and their distance."""

    a: str
    b: str
    metres: float  # above 0


@dataclass(frozen=True)
class CameraPlace:
    """Where the camera of a frame was."""

    name: str


@dataclass(frozen=True)
class PointPlace:
    """A point in world units."""

    xyz: tuple[float, float, float]


@dataclass(frozen=True)
class PixelPlace:
    """What a frame shows at a pixel; the centre of the first one is 0.5, 0.5."""

    name: str
    u: float
    v: float


Place = CameraPlace | PointPlace | PixelPlace


@dataclass(frozen=True, eq=False)
class Measurement:
    """The scale that follows from a `ScaleBetween`."""

    request: ScaleBetween
    a: NDArray[np.float64]  # [3] world units
    b: NDArray[np.float64]  # [3]
    scale: float  # metres in one world unit

    def to_json(self) -> dict[str, Any]:
        """Returns what was measured as JSON values."""
        return {
            "a": self.request.a, "b": self.request.b, "metres": self.request.metres,
            "a_xyz": self.a.tolist(), "b_xyz": self.b.tolist(), "scale": self.scale,
        }


def parse_place(text: str, names: Collection[str]) -> Place:
    """Returns the place that a text names: a frame (with or without its suffix), point or pixel.

    Raises:
        ConfigError: it is none of the three, or there is no such frame among `names`.
    """
    if (name := _frame(text, names)) is not None:
        return CameraPlace(name)
    front, colon, back = text.rpartition(":")
    if colon and (pixel := _numbers(back, 2)):
        if (name := _frame(front, names)) is None:
            raise _unknown_place(front, names)
        return PixelPlace(name, *pixel)
    if xyz := _numbers(text, 3):
        return PointPlace((xyz[0], xyz[1], xyz[2]))
    raise _unknown_place(text, names)


def measure(
    request: ScaleBetween,
    points: NDArray[np.float64],
    viewmats: Mapping[str, NDArray[np.float64]],
    pinholes: Mapping[str, Pinhole],
) -> Measurement:
    """Returns how many metres one world unit is.

    Args:
        request: two places and their distance.
        points: [P, 3] sparse points.
        viewmats: [4, 4] world to camera of each frame that has one.
        pinholes: its undistorted camera; asked only for frames that are named with a pixel.

    Raises:
        ConfigError: a place is unknown, or both are the same.
    """
    a, b = (
        _locate(parse_place(text.strip(), viewmats.keys()), points, viewmats, pinholes)
        for text in (request.a, request.b))
    distance = float(np.linalg.norm(a - b))
    if distance <= _EQUAL * max(float(np.abs([a, b]).max()), 1e-12):
        raise ConfigError(
            f"{request.a} and {request.b} are the same point, {format_point(a)}.", hint=_HINT)
    return Measurement(request, a, b, request.metres / distance)


def format_point(point: NDArray[np.float64]) -> str:
    """Returns a point as --scale-between takes it."""
    return ",".join(f"{value:.4g}" for value in point)


def _frame(text: str, names: Collection[str]) -> str | None:
    """Returns the frame of that name, or the only one of that name without its ending."""
    if text in names:
        return text
    stems = [name for name in names if name.rpartition(".")[0] == text]
    return stems[0] if text and len(stems) == 1 else None


def _numbers(text: str, count: int) -> tuple[float, ...] | None:
    try:
        values = tuple(float(word) for word in text.split(","))
    except ValueError:
        return None
    return values if len(values) == count and all(map(math.isfinite, values)) else None


def _unknown_place(text: str, names: Collection[str]) -> ConfigError:
    close = difflib.get_close_matches(text, names, n=3, cutoff=0.5) or sorted(names)[:3]
    return ConfigError(
        f"--scale-between names {text!r}, which is neither a point nor a frame with a camera; "
        f"similar names: {', '.join(close)}.", hint=_HINT)


def _locate(
    place: Place,
    points: NDArray[np.float64],
    viewmats: Mapping[str, NDArray[np.float64]],
    pinholes: Mapping[str, Pinhole],
) -> NDArray[np.float64]:
    if isinstance(place, PointPlace):
        return np.array(place.xyz)
    viewmat = viewmats[place.name]
    if isinstance(place, CameraPlace):
        return np.asarray(-viewmat[:3, :3].T @ viewmat[:3, 3])
    pinhole = pinholes[place.name]
    depth = _depth_at(place, points @ viewmat[:3, :3].T + viewmat[:3, 3], pinhole)
    ray = np.array([(place.u - pinhole.cx) / pinhole.fx, (place.v - pinhole.cy) / pinhole.fy, 1.0])
    return np.asarray(viewmat[:3, :3].T @ (depth * ray - viewmat[:3, 3]))


def _depth_at(place: PixelPlace, points: NDArray[np.float64], pinhole: Pinhole) -> float:
    """Returns the depth of that of the points [P, 3], in camera axes, nearest to a pixel."""
    if not (0 <= place.u <= pinhole.width and 0 <= place.v <= pinhole.height):
        raise ConfigError(
            f"The pixel {place.u:g},{place.v:g} lies outside {place.name}, which has "
            f"{pinhole.width}x{pinhole.height} pixels once undistorted.", hint=_HINT)
    points = points[points[:, 2] > 0]
    pixels = points[:, :2] / points[:, 2:] * (pinhole.fx, pinhole.fy) + (pinhole.cx, pinhole.cy)
    off = np.hypot(*(pixels - (place.u, place.v)).T)
    reach = max(_LEAST_REACH, _REACH * pinhole.width)
    if not (off <= reach).any():
        raise _nothing_near(place, pixels, off, reach)
    return float(points[off.argmin(), 2])


def _nothing_near(
    place: PixelPlace, pixels: NDArray[np.float64], off: NDArray[np.float64], reach: float
) -> ConfigError:
    hint = "Pick a corner or a textured spot."
    if len(off):
        u, v = pixels[off.argmin()]
        hint = f"The nearest is at {place.name}:{u:.0f},{v:.0f}."
    return ConfigError(
        f"The depth at {place.name}:{place.u:g},{place.v:g} is unknown: no sparse point lies "
        f"within {reach:.0f} pixels.", hint=hint)
