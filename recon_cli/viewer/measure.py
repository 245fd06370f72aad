"""Measuring in the browser: two clicked points for a distance, three or more for an area.

A click meets the scene where Gaussians are opaque: at the depth of the median along its ray, which
recon renders for that one pixel, not at the nearest centre.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray

from recon_cli.render.surface_depth import render_surface
from recon_cli.scene.camera import Camera, looking_at
from recon_cli.scene.splats import Splats

_WINDOW = 5  # pixels a side around a click that are rendered; the middle one's neighbours decide
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


def scale_command(points: NDArray[np.float64], metres: float) -> str:
    """Returns the command that sets the scale of all exported files by the last two points."""
    a, b = (",".join(f"{value:.5g}" for value in point) for point in points[-2:])
    return f"recon export --scale-between {a} {b} {metres:g}"
