"""The plan: cameras and points of the capture from above, as inline SVG.

Points are a faint picture of their density, so that a hundred thousand of them weigh no more than a
hundred; cameras are marks whose line shows where they look, as long as it is level.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from recon_cli.report.chart import mark
from recon_cli.scene.gravity import MIN_CAMERAS, camera_up, find_gravity
from recon_cli.scene.scene import Scene, View

WIDTH = 640  # pixels of the drawing; the page scales it
_MOST_HEIGHT = 560
_MARGIN = 26  # pixels around what is shown
_CELL = 2  # pixels of the drawing in a cell of the picture of the points
_SHARE = (2.0, 98.0)  # percentiles of the points that are shown whole; the rest may lie far outside
_GRAY = 128  # of the points: seen on white and on black
_MANY = 150  # cameras from which on marks are smaller
_BAR = 0.25  # of the width that the scale bar takes at most
# (color, mark) of the page's charts; green and blue are those of the contact sheet
PARTS = {"training": (2, "circle"), "validation": (5, "square"), "held out": (0, "diamond")}
LOST = (3, "cross")


@dataclass(frozen=True, eq=False)
class Frame:
    """The axes of a plan.

    Attributes:
        axes: [2, 3] unit vectors of the world: to the right and upwards on the page.
        known: up is known, from the mapping or from cameras and floor.
    """

    axes: NDArray[np.float64]
    known: bool


def frame_of(scene: Scene, *, z_up: bool) -> Frame:
    """Returns the axes of a plan: x and y where z is up, else level ones as far as can be told.

    Args:
        scene: whose points and training cameras say where up is.
        z_up: the world's z axis is known to be up.
    """
    if z_up:
        return Frame(np.eye(3)[:2], known=True)
    viewmats = np.stack([view.camera.viewmat for view in _views(scene)])
    found = find_gravity(scene.points, viewmats).up if len(viewmats) >= MIN_CAMERAS else None
    up = found
    if up is None:
        up = (camera_up(viewmats).up if len(viewmats) >= MIN_CAMERAS else -viewmats[0, 1, :3])
    right = np.eye(3)[np.argmin(np.abs(up))]
    right = right - (right @ up) * up
    right = right / np.linalg.norm(right)
    return Frame(np.stack([right, np.cross(up, right)]), known=found is not None)


def draw(scene: Scene, frame: Frame, *, metres: bool) -> Markup:
    """Returns the plan as SVG.

    Args:
        scene: cameras and points.
        frame: what is right and upwards.
        metres: one unit is a metre, so that a scale bar says something.
    """
    parts = by_part(scene)
    cameras = np.stack([view.camera.center for views in parts.values() for view in views])
    points, places = scene.points @ frame.axes.T, cameras @ frame.axes.T
    paper = _fitted(*_bounds(points, places))
    size = 3.0 if len(cameras) > _MANY else 4.5
    marks = [_camera(view, frame, paper, part, size)
             for part, views in parts.items() for view in views]
    bar = _scale_bar(paper) if metres else Markup("")
    return Markup(
        '<svg class="plan" viewBox="0 0 {} {}" role="img" '
        'aria-label="Cameras and points from above">{}{}{}</svg>').format(
            WIDTH, paper.height, _density(points, paper), Markup("").join(marks), bar)


def by_part(scene: Scene) -> Mapping[str, Sequence[View]]:
    """Returns the views of a scene by the names of PARTS."""
    return dict(zip(PARTS, (scene.train, scene.validation, scene.test), strict=True))


def _views(scene: Scene) -> tuple[View, ...]:
    return scene.train + scene.validation + scene.test


def _bounds(
    points: NDArray[np.float64], places: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the corners [2] of what is shown: every camera and nearly all points."""
    most = np.percentile(points, _SHARE, axis=0) if len(points) else places
    low, high = (np.minimum(most.min(0), places.min(0)), np.maximum(most.max(0), places.max(0)))
    room = np.maximum(0.02 * (high - low), 1e-6 + 0.02 * float((high - low).max()))
    return low - room, high + room


@dataclass(frozen=True, eq=False)
class _Paper:
    """Where a place lies on the drawing: pixels a unit, the left lower corner, the height."""

    scale: float
    corner: NDArray[np.float64]
    height: int

    def at(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns pixels from the left and from the top, [..., 2], of places [..., 2]."""
        found = (places - self.corner) * self.scale
        return np.stack([found[..., 0], self.height - found[..., 1]], axis=-1)


def _fitted(low: NDArray[np.float64], high: NDArray[np.float64]) -> _Paper:
    """Returns the drawing that holds a box, in its middle, as large as there is room."""
    size, room = high - low, np.array([WIDTH, _MOST_HEIGHT]) - 2 * _MARGIN
    scale = float((room / size).min())
    height = round(float(size[1]) * scale) + 2 * _MARGIN
    middle = np.array([WIDTH, height]) / 2
    return _Paper(scale, (low + high) / 2 - middle / scale, height)


def _density(points: NDArray[np.float64], paper: _Paper) -> Markup:
    """Returns the points as a picture whose opacity grows with the logarithm of their number."""
    rows, columns = math.ceil(paper.height / _CELL), math.ceil(WIDTH / _CELL)
    found = paper.at(points)
    counts, _, _ = np.histogram2d(
        found[:, 1], found[:, 0], bins=(rows, columns),
        range=((0, rows * _CELL), (0, columns * _CELL)))
    full = np.percentile(counts[counts > 0], 99) if counts.any() else 1
    opacity = np.where(counts > 0, 0.4 + 0.6 * np.log1p(counts) / np.log1p(full), 0).clip(0, 1)
    picture = np.full((rows, columns, 4), _GRAY, np.uint8)
    picture[..., 3] = np.rint(230 * opacity)
    _, data = cv2.imencode(".png", picture)
    return Markup('<image width="{}" height="{}" href="data:image/png;base64,{}"/>').format(
        columns * _CELL, rows * _CELL, base64.b64encode(data.tobytes()).decode())


def _camera(view: View, frame: Frame, paper: _Paper, part: str, size: float) -> Markup:
    color, shape = PARTS[part]
    camera = view.camera
    x, y = map(float, paper.at(frame.axes @ camera.center))
    ahead = frame.axes @ camera.viewmat[2, :3]  # z of the camera, looked at from above
    big = size * (1.25 if part == "held out" else 1.0)
    line = Markup('<path class="line c{}" d="M{},{}l{},{}"/>').format(
        color, round(x, 1), round(y, 1),
        round(4 * size * float(ahead[0]), 1), round(-4 * size * float(ahead[1]), 1))
    return line + mark(shape, x, y, big, color, f"{view.name} ({part})")


def _scale_bar(paper: _Paper) -> Markup:
    """Returns a bar of 1, 2 or 5 times a power of ten of metres."""
    most = _BAR * WIDTH / paper.scale
    power = 10.0 ** math.floor(math.log10(most))
    metres = max(factor * power for factor in (1, 2, 5) if factor * power <= most)
    length, y = metres * paper.scale, paper.height - 10
    x = WIDTH - _MARGIN - length
    return Markup(
        '<path class="axis scale" d="M{},{}v6h{}v-6"/>'
        '<text class="label" x="{}" y="{}" text-anchor="middle">{} m</text>').format(
            round(x, 1), y - 6, round(length, 1), round(x + length / 2, 1), y - 9,
            f"{metres:g}")
