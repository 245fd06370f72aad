"""From the mapper's frame to the world: which way is up, where the floor is, how long a metre is.

A mapper's frame is that of its first pair of images, in an arbitrary scale. `world_transform`
combines what cameras, points and the user say about the world into one similarity, with its
evidence. The user gives a scale by --scale-between: a known distance between two places.
"""

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
from recon_cli.scene.gravity import Gravity, find_gravity, upright_axes
from recon_cli.scene.similarity import Similarity
from recon_cli.workspace.summaries import WorldEvidence, WorldSummary

ARBITRARY, DATA_SET, MEASURED = "arbitrary", "data set", "measured"  # where the scale comes from
# Largest distance of a sparse point from a pixel, as a share of the image's width. In two rendered
# rooms picks within two pixels of a corner had a depth 0.5% and 0.7% off in the middle, 5% in the
# worst tenth; of picks anywhere a third found a point within 3 pixels, a sixth another surface.
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
class Place:
    """A point in world units, the camera of a frame, or what a frame shows at a pixel."""

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

    def to_json(self) -> dict[str, Any]:
        """Returns what was measured as JSON values."""
        return {
            "a": self.request.a, "b": self.request.b, "metres": self.request.metres,
            "a_xyz": self.a.tolist(), "b_xyz": self.b.tolist(), "scale": self.scale}


@dataclass(frozen=True, eq=False)
class WorldFrame:
    """The world frame; see `WorldSummary`."""

    similarity: Similarity
    evidence: WorldEvidence
    measurement: Measurement | None  # what gave the scale, in the world before it was scaled
    sentences: tuple[str, ...]

    def summary(self) -> WorldSummary:
        """Returns the record for world.json and the summary of the stage."""
        return WorldSummary(
            similarity=self.similarity.to_json(), evidence=self.evidence,
            measurement=self.measurement.to_json() if self.measurement else None,
            sentences=self.sentences)


def world_transform(
    points: NDArray[np.float64],  # [P, 3] sparse points in the mapper's frame
    viewmats: Mapping[str, NDArray[np.float64]],  # [4, 4] world to camera of each frame
    *,
    gravity: bool,  # find up; False leaves the axes and the origin
    scale_between: ScaleBetween | None,
    metric: bool,  # the mapper's units are metres, as in a data set with measured poses
    pinholes: Mapping[str, Pinhole] | None = None,  # of undistorted frames, for FRAME:u,v
) -> WorldFrame:
    """Returns the world frame of a model.

    Up and the floor are used where cameras and points agree on them; otherwise the axes stay, and
    the evidence says why. The scale is that of `scale_between`, whose points x,y,z are in the
    turned frame, as a viewer shows it; the origin stays. ConfigError if a place is unknown.
    """
    names = sorted(viewmats)
    matrices = np.array([viewmats[name] for name in names]).reshape(-1, 4, 4)
    up = (find_gravity(points, matrices) if gravity
          else Gravity(None, None, None, "it was not looked for"))
    turn, axis, strength = Similarity(), "mapper", None
    if up.up is not None:
        axes = upright_axes(up, points, matrices)
        turn, strength = axes.similarity, axes.walls.strength
        axis = "walls" if axes.walls.found else "cameras"
    measured = None
    if scale_between:
        moved = {name: turn.viewmat(viewmats[name]) for name in names}
        measured = measure(scale_between, turn.points(points), moved, pinholes or {})
    source = MEASURED if measured else DATA_SET if metric else ARBITRARY
    evidence = _evidence(up, axis, strength, source)
    scale = Similarity(scale=measured.scale) if measured else Similarity()
    return WorldFrame(
        scale.after(turn), evidence, measured,
        (*_describe_up(evidence, gravity), _describe_scale(source, measured, metric)))


def _evidence(gravity: Gravity, axis: str, strength: float | None, source: str) -> WorldEvidence:
    cameras, floor = gravity.cameras, gravity.floor
    tilt = None
    if cameras is not None and floor is not None:
        tilt = float(np.degrees(np.arccos(np.clip(cameras.up @ floor.up, -1, 1))))
    return WorldEvidence(
        up_found=gravity.up is not None, up_reason=gravity.reason,
        camera_roll_deg=None if cameras is None else cameras.roll_deg,
        camera_spread_deg=None if cameras is None else cameras.spread_deg,
        camera_error_deg=None if cameras is None else cameras.error_deg,
        upright_share=None if cameras is None else cameras.upright,
        floor_found=floor is not None,
        floor_share=None if floor is None else floor.share,
        floor_contrast=None if floor is None else floor.contrast,
        floor_tilt_deg=tilt, axis=axis, wall_strength=strength,
        scale_source=source, metres=source != ARBITRARY)


def _describe_up(evidence: WorldEvidence, asked: bool) -> tuple[str, ...]:
    if not asked:
        return ()
    if not evidence.up_found:
        return (f"Up is unknown, so the axes stay as they are: {evidence.up_reason}.",)
    if evidence.floor_found:
        return (
            f"z is up and the floor lies at 0: {evidence.floor_share:.0%} of the points lie in it, "
            f"{evidence.floor_tilt_deg:.1f} degrees off the horizon of the cameras.",)
    return (
        "z is up by the horizon of the cameras, to about "
        f"{evidence.camera_error_deg:.1f} degrees; no floor is seen, so 0 is their mean height.",)


def _describe_scale(source: str, measured: Measurement | None, metric: bool) -> str:
    if source == ARBITRARY:
        return "The scale is arbitrary; --scale-between A B METRES makes one unit a metre."
    if measured is None:
        return "One unit is one metre, as in the data set."
    request = measured.request
    sentence = f"One unit is one metre: {request.a} and {request.b} are {request.metres:g} m apart"
    return f"{sentence}, {1 / measured.scale:.4g} times as long in the data set." if metric else (
        f"{sentence}.")


def parse_place(text: str, names: Collection[str]) -> Place:
    """Returns the place that a text names: a frame (with or without its suffix), point or pixel.

    ConfigError if it is none of the three, or there is no such frame among `names`.
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
    pinholes: Mapping[str, Pinhole],  # needed only of frames that are named with a pixel
) -> Measurement:
    """Returns the metres of a world unit; ConfigError if a place is unknown or both are equal."""
    a, b = (
        _locate(parse_place(text.strip(), viewmats.keys()), points, viewmats, pinholes)
        for text in (request.a, request.b))
    distance = float(np.linalg.norm(a - b))
    if distance <= _EQUAL * max(float(np.abs([a, b]).max()), 1e-12):
        raise ConfigError(
            f"{request.a} and {request.b} are the same point, "
            f"{','.join(f'{value:.4g}' for value in a)}.", hint=_HINT)
    return Measurement(request, a, b, request.metres / distance)


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
    if place.frame is None:
        return np.array(place.xyz)
    viewmat = viewmats[place.frame]
    if place.pixel is None:
        return np.asarray(-viewmat[:3, :3].T @ viewmat[:3, 3])
    u, v = place.pixel
    pinhole = pinholes[place.frame]
    depth = _depth_at(place.frame, u, v, points @ viewmat[:3, :3].T + viewmat[:3, 3], pinhole)
    ray = np.array([(u - pinhole.cx) / pinhole.fx, (v - pinhole.cy) / pinhole.fy, 1.0])
    return np.asarray(viewmat[:3, :3].T @ (depth * ray - viewmat[:3, 3]))


def _depth_at(
    frame: str, u: float, v: float, points: NDArray[np.float64], pinhole: Pinhole
) -> float:
    """Returns the depth of the point nearest to a pixel, of points [P, 3] in camera axes."""
    if not (0 <= u <= pinhole.width and 0 <= v <= pinhole.height):
        raise ConfigError(
            f"The pixel {u:g},{v:g} lies outside {frame}, which has "
            f"{pinhole.width}x{pinhole.height} pixels once undistorted.", hint=_HINT)
    points = points[points[:, 2] > 0]
    pixels = points[:, :2] / points[:, 2:] * (pinhole.fx, pinhole.fy) + (pinhole.cx, pinhole.cy)
    off = np.hypot(*(pixels - (u, v)).T)
    reach = max(_LEAST_REACH, _REACH * pinhole.width)
    if not (off <= reach).any():
        hint = "Pick a corner or a textured spot."
        if len(off):
            hint = "The nearest is at {}:{:.0f},{:.0f}.".format(frame, *pixels[off.argmin()])
        raise ConfigError(
            f"The depth at {frame}:{u:g},{v:g} is unknown: no sparse point lies within "
            f"{reach:.0f} pixels.", hint=hint)
    return float(points[off.argmin(), 2])
