"""Measuring in the browser: two clicked points for a distance, three or more for an area.

A click meets the scene where Gaussians are opaque: at the depth of the median along its ray, which
recon renders for that one pixel, not at the nearest centre.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray

from recon_cli.render.surface_depth import render_surface
from recon_cli.scene.camera import Camera, looking_at
from recon_cli.scene.splats import Splats

_WINDOW = 5  # pixels a side around a click that are rendered; the middle one's neighbours decide
# Metres. Sheets: ISO 216, ANSI/ASME Y14.1; door leaves: DIN 18101, and 80 inches in North America.
SHEETS: Mapping[str, tuple[float, float]] = {
    "A4 sheet, 4 corners": (0.297, 0.210), "Letter sheet, 4 corners": (0.2794, 0.2159)}
LENGTHS: Mapping[str, float] = {"door leaf, 198.5 cm high": 1.985, "door leaf, 80 in high": 2.032}
_MOST_UNLIKE = 0.15  # share by which the sides of a clicked sheet may differ from the paper
_FOCAL = 1000.0  # pixels, of the small camera that looks along a click


def locate_click(
    splats: Splats,
    origin: NDArray[np.float64],  # [3] of the ray
    direction: NDArray[np.float64],  # [3]
    backend: str,
) -> NDArray[np.float64] | None:
    """Returns where a ray meets the surface, [3]; None where nothing is opaque along it."""
    direction = direction / np.linalg.norm(direction)
    up = np.eye(3)[np.argmin(np.abs(direction))]
    camera = Camera(_WINDOW, _WINDOW, _FOCAL, _FOCAL, _WINDOW / 2, _WINDOW / 2,
                    looking_at(origin, origin + direction, up))
    with torch.no_grad():
        depth = render_surface(splats, camera, backend=backend).depth.cpu().numpy()
    found = depth[depth > 0]
    if 2 * len(found) < depth.size:
        return None
    return np.asarray(origin + float(np.median(found)) * direction)


def polygon_area(points: NDArray[np.float64]) -> float:
    """Returns the area of a polygon [P, 3], of its projection onto its mean plane (Newell)."""
    cross = np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)
    return float(np.linalg.norm(cross) / 2)


def describe_points(points: NDArray[np.float64], scale: float | None) -> str:
    """Returns the distances or angle of clicked points [P, 3] in words.

    `scale` is metres in one world unit, None where it is not known: nothing is called a metre then.
    """
    if len(points) < 2:
        return "Click two points for a distance, three or more for an area."
    unit = "units (the scale is not known)" if scale is None else "m"
    factor = 1.0 if scale is None else scale
    sides = factor * np.linalg.norm(np.diff(points, axis=0), axis=1)
    if len(points) == 2:
        return f"Distance: **{sides[0]:.3f} {unit}**"
    area = factor**2 * polygon_area(points)
    square = "square units (the scale is not known)" if scale is None else "m²"
    return f"Area: **{area:.3f} {square}**; last side {sides[-1]:.3f} {unit}"


def scale_of(points: NDArray[np.float64], metres: float) -> float | None:
    """Returns metres in one unit by the length of the last side; None where it says nothing."""
    if len(points) < 2 or not metres > 0 or not math.isfinite(metres):
        return None
    length = float(np.linalg.norm(points[-1] - points[-2]))
    return metres / length if length > 0 else None


def find_scale(
    points: NDArray[np.float64], known: str, metres: float
) -> tuple[float, str] | str:
    """Returns metres in one unit and the command that sets it, or why there are none.

    `known` is a key of SHEETS, whose corners are the last four points of [P, 3], or of LENGTHS; of
    anything else the length of the last side is `metres`.
    """
    if known in SHEETS:
        if len(points) < 4:
            return f"Click the four corners of the sheet in turn: {len(points)} of 4."
        corners = points[-4:]
        scale = _scale_of_sheet(corners, SHEETS[known])
        if scale is None:
            return f"The last four points are not the corners of an {known.split(',')[0]}, in turn."
        across = corners[[0, 2]]
        return scale, scale_command(across, scale * float(np.linalg.norm(across[1] - across[0])))
    scale = scale_of(points, LENGTHS.get(known, metres))
    if scale is None:
        return "Click two points, and say how far they are apart."
    return scale, scale_command(points, LENGTHS.get(known, metres))


def _scale_of_sheet(
    corners: NDArray[np.float64],  # [4, 3]
    size: tuple[float, float],  # metres, the longer side first
) -> float | None:
    """Returns metres in one unit by the circumference; None where the corners form none."""
    sides = np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1)
    longer = np.array(size if sides[::2].sum() > sides[1::2].sum() else size[::-1])
    wanted = np.tile(longer, 2)
    diagonals = np.linalg.norm(corners[:2] - corners[2:], axis=1)
    scale = float(wanted.sum() / max(sides.sum(), 1e-12))
    off = np.abs(np.r_[sides / wanted, diagonals / math.hypot(*size)] * scale - 1).max()
    return scale if off <= _MOST_UNLIKE else None


def scale_command(points: NDArray[np.float64], metres: float) -> str:
    """Returns the command that sets the scale of all exported files by the last two points."""
    a, b = (",".join(f"{value:.5g}" for value in point) for point in points[-2:])
    return f"recon export --scale-between {a} {b} {metres:.5g}"
