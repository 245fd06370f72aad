"""The plan of a room as SVG: walls and their lengths, over a cut through the mesh at 1 m."""

from __future__ import annotations

import math

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from recon_cli.io.svg import PlanLayout, element, join_points, label
from recon_cli.room.measures import RoomMeasures
from recon_cli.scene.statistics import FINE_SAMPLE

_WIDTH, _MARGIN, _LINE = 800, 60, 18  # pixels
_SQUARE = "m\u00b2"
_REACH = 99.5  # percentile of the cut that the plan shows, where there is no footprint


def draw_plan(measures: RoomMeasures) -> str:
    """Returns the plan; without walls the cut alone, and the missing measures below it."""
    cut, footprint = measures.cut, measures.footprint
    cut = cut[:: max(1, -(-len(cut) // FINE_SAMPLE))]
    low, high = _bounds(cut, footprint)
    scale = (_WIDTH - 2 * _MARGIN) / float(max(high - low))
    width, bottom = map(float, (high - low) * scale + 2 * _MARGIN)
    layout = PlanLayout(scale, low - _MARGIN / scale, bottom)
    parts = [element("title", "Plan of the room"),
             element("rect", width="100%", height="100%", fill="white")]
    if len(cut):
        parts.append(_cut_path(layout.at(cut)))
    if footprint is not None:
        parts += _walls(layout.at(footprint), measures)
    lines = describe(measures)
    height = round(bottom + _LINE * (len(lines) + 1))
    parts += [element("text", line, x=_MARGIN, y=round(bottom + _LINE * row))
              for row, line in enumerate(lines)]
    parts.append(layout.scale_bar(
        (width - _MARGIN, bottom - 14), 1, 5, stroke="black", fill="none"))
    return element(
        "svg", Markup("").join(parts), xmlns="http://www.w3.org/2000/svg",
        viewBox=f"0 0 {width:.0f} {height}", width=round(width), height=height,
        font_family="sans-serif", font_size=13) + "\n"


def describe(measures: RoomMeasures) -> list[str]:
    """Returns the measures and notes about missing ones, a line each."""
    lines = []
    if measures.height is not None:
        lines.append(f"Ceiling height {measures.height.text('m')}")
    if measures.floor_area is not None:
        lines.append(f"Floor area {measures.floor_area.text(_SQUARE)}")
    return lines + list(measures.notes)


def _bounds(
    cut: NDArray[np.float64], footprint: NDArray[np.float64] | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    if footprint is not None:
        low, high = footprint.min(axis=0), footprint.max(axis=0)
    elif len(cut):
        low, high = np.percentile(cut.reshape(-1, 2), (100 - _REACH, _REACH), axis=0)
    else:
        low, high = np.zeros(2), np.ones(2)
    room = 0.03 * max(float((high - low).max()), 1e-6)
    return low - room, high + room


def _cut_path(pixels: NDArray[np.float64]) -> Markup:
    return element("path", d="".join(f"M{join_points(ends)}" for ends in pixels), stroke="#888",
                   stroke_width=1, fill="none")


def _walls(corners: NDArray[np.float64], measures: RoomMeasures) -> list[Markup]:
    parts = [element("polygon", points=join_points(corners, " "), fill="none", stroke="black",
                     stroke_width=4)]
    middle = corners.mean(axis=0)
    for start, end, length in zip(
            np.roll(corners, 1, axis=0), corners, measures.walls, strict=True):
        place = (start + end) / 2
        out = place - middle
        place = place + 22 * out / max(float(np.linalg.norm(out)), 1e-9)
        turn = math.degrees(math.atan2(end[1] - start[1], end[0] - start[0]))
        turn -= 180 * round(turn / 180)  # never upside down
        parts.append(label(
            float(place[0]), float(place[1]), length.text("m"), dominant_baseline="middle",
            transform=f"rotate({turn:.1f} {place[0]:.1f} {place[1]:.1f})"))
    return parts
