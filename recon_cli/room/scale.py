"""How long a metre is, from a known distance between two places: --scale-between."""

from __future__ import annotations

import difflib
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import ConfigError
from recon_cli.scene.camera import Camera, Lens
from recon_cli.scene.statistics import ROUNDING, at_least

# where the scale comes from
ARBITRARY, DATA_SET, MEASURED, FUSED = "arbitrary", "data set", "measured", "fused"
# Relative error of a distance between two pixels: the depth of a pick in the middle was 0.5% and
# 0.7% off in two rendered rooms, see _REACH. Of other places that of the measuring itself.
PICKED_ERROR, PLACED_ERROR = 0.007, 0.003
END_METRES = 0.003  # by which each end of a length is missed with a tape or a click: assumed
# Largest distance of a sparse point from a pixel, as a share of the image's width. In two rendered
# rooms picks within two pixels of a corner had a depth 0.5% and 0.7% off in the middle, 5% in the
# worst tenth; of picks anywhere a third found a point within 3 pixels, a sixth another surface.
_REACH = (4, 0.005)  # pixels at least, and of the width
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
class Place:
    """A point in world units, the camera of a frame, or the surface at a pixel of a frame."""

    frame: str | None = None
    pixel: tuple[float, float] | None = None  # the centre of the first one is 0.5, 0.5
    xyz: tuple[float, float, float] | None = None


@dataclass(frozen=True, eq=False)
class Measurement:
    """The scale that follows from a `ScaleBetween`."""

    request: ScaleBetween
    a: NDArray[np.float64]  # [3] world units
    b: NDArray[np.float64]  # [3]
    scale: float  # metres in one world unit
    error: float  # relative standard error of the scale

    def to_json(self) -> dict[str, Any]:
        """Returns the measurement as JSON values."""
        return {
            "a": self.request.a, "b": self.request.b, "metres": self.request.metres,
            "a_xyz": self.a.tolist(), "b_xyz": self.b.tolist(), "scale": self.scale}


def parse_place(text: str, names: Collection[str]) -> Place:
    """Returns the place that a text names: a frame (with or without its suffix), point or pixel.

    ConfigError if it is not one of the three, or its frame is not among `names`.
    """
    if (name := _frame(text, names)) is not None:
        return Place(name)
    front, colon, back = text.rpartition(":")
    if colon and (pixel := _numbers(back, 2)):
        if (name := _frame(front, names)) is None:
            raise _unknown_place(front, names)
        return Place(name, pixel=(pixel[0], pixel[1]))
    if xyz := _numbers(text, 3):
        return Place(xyz=(xyz[0], xyz[1], xyz[2]))
    raise _unknown_place(text, names)


def measure(
    request: ScaleBetween,
    points: NDArray[np.float64],  # [P, 3] sparse points
    viewmats: Mapping[str, NDArray[np.float64]],  # [4, 4] world to camera of each frame
    pinholes: Mapping[str, Lens],  # needed only of frames that are named with a pixel
) -> Measurement:
    """Returns the metres of a world unit; ConfigError if a place is unknown or both are equal."""
    (a, a_reach), (b, b_reach) = (
        _locate(parse_place(text.strip(), viewmats.keys()), points, viewmats, pinholes)
        for text in (request.a, request.b))
    distance = float(np.linalg.norm(a - b))
    if distance <= ROUNDING * max(float(np.abs([a, b]).max()), 1e-12):
        raise ConfigError(
            f"{request.a} and {request.b} are the same point, "
            f"{','.join(f'{value:.4g}' for value in a)}.", hint=_HINT)
    # A pick is wrong along its ray, by a share of its depth.
    along = float(np.hypot(a_reach @ (b - a), b_reach @ (b - a))) / distance**2
    least = PICKED_ERROR if a_reach.any() or b_reach.any() else PLACED_ERROR
    ends = math.sqrt(2) * END_METRES / request.metres
    return Measurement(request, a, b, request.metres / distance, math.hypot(
        max(least, PICKED_ERROR * along), ends))


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
    pinholes: Mapping[str, Lens],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns a place [3], and the way [3] from the camera whose pixel it is, else 0."""
    if place.frame is None:
        return np.array(place.xyz), np.zeros(3)
    viewmat = viewmats[place.frame]
    center = np.asarray(-viewmat[:3, :3].T @ viewmat[:3, 3])
    if place.pixel is None:
        return center, np.zeros(3)
    u, v = place.pixel
    lens = pinholes.get(place.frame)
    if lens is None:
        raise ConfigError(
            f"{place.frame} is a panorama or of a wide lens: several undistorted images show it, "
            "so that none can be pointed into.",
            hint="Name frames (their cameras) or points x,y,z instead of FRAME:u,v.")
    camera = lens.pinhole(viewmat)
    depth = _depth_at(place.frame, u, v, points, camera)
    (point,) = camera.unproject(np.array([[u, v]]), np.array([depth]))
    return point, point - center


def _depth_at(
    frame: str, u: float, v: float, points: NDArray[np.float64], camera: Camera
) -> float:
    """Returns the depth of the point [P, 3] that is nearest to a pixel."""
    if not (0 <= u <= camera.width and 0 <= v <= camera.height):
        raise ConfigError(
            f"The pixel {u:g},{v:g} lies outside {frame}, which has "
            f"{camera.width}x{camera.height} pixels once undistorted.", hint=_HINT)
    pixels, depths = camera.project(points)
    pixels, depths = pixels[depths > 0], depths[depths > 0]
    off = np.hypot(*(pixels - (u, v)).T)
    reach = at_least(_REACH, camera.width)
    if not (off <= reach).any():
        hint = "Pick a corner or a textured spot."
        if len(off):
            hint = "The nearest is at {}:{:.0f},{:.0f}.".format(frame, *pixels[off.argmin()])
        raise ConfigError(
            f"The depth at {frame}:{u:g},{v:g} is unknown: no sparse point lies within "
            f"{reach:.0f} pixels.", hint=hint)
    return float(depths[off.argmin()])
