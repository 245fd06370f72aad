"""The plan of a room as SVG: walls and their lengths, over a cut through the mesh at 1 m."""

from __future__ import annotations

import math
from html import escape

import numpy as np
from numpy.typing import NDArray

from recon_cli.room.measures import RoomMeasures

_WIDTH, _MARGIN, _LINE = 800, 60, 18  # pixels
_SQUARE = "m\u00b2"
_MOST_SEGMENTS = 20_000
_REACH = 99.5  # percentile of the cut that the plan shows, where there is no footprint


def draw_plan(measures: RoomMeasures) -> str:
    """Returns the plan; without walls the cut alone, and the missing measures below it."""
    cut, footprint = measures.cut, measures.footprint
    cut = cut[:: max(1, -(-len(cut) // _MOST_SEGMENTS))]
    low, high = _bounds(cut, footprint)
    scale = (_WIDTH - 2 * _MARGIN) / float(max(high - low))
    drawn = (high - low) * scale + 2 * _MARGIN

    def at(places: NDArray[np.float64]) -> NDArray[np.float64]:
        pixels = (places - low) * scale + _MARGIN
        return np.stack([pixels[..., 0], drawn[1] - pixels[..., 1]], axis=-1)

    parts = [_cut_path(at(cut))] if len(cut) else []
    if footprint is not None:
        parts.append(_walls(at(footprint), measures))
    lines = describe(measures)
    height = drawn[1] + _LINE * (len(lines) + 1)
    parts += [f'<text x="{_MARGIN}" y="{drawn[1] + _LINE * row:.0f}">{escape(line)}</text>'
              for row, line in enumerate(lines)]
    parts.append(_scale_bar(scale, float(drawn[0]), float(drawn[1])))
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {drawn[0]:.0f} {height:.0f}" '
        f'width="{drawn[0]:.0f}" height="{height:.0f}" font-family="sans-serif" font-size="13">'
        '<title>Plan of the room</title><rect width="100%" height="100%" fill="white"/>'
        + "".join(parts) + "</svg>\n")


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


def _cut_path(pixels: NDArray[np.float64]) -> str:
    path = "".join(f"M{a:.1f},{b:.1f}L{c:.1f},{d:.1f}" for (a, b), (c, d) in pixels)
    return f'<path d="{path}" stroke="#888" stroke-width="1" fill="none"/>'


def _walls(corners: NDArray[np.float64], measures: RoomMeasures) -> str:
    outline = " ".join(f"{x:.1f},{y:.1f}" for x, y in corners)
    parts = [f'<polygon points="{outline}" fill="none" stroke="black" stroke-width="4"/>']
    middle = corners.mean(axis=0)
    for start, end, length in zip(
            np.roll(corners, 1, axis=0), corners, measures.walls, strict=True):
        place = (start + end) / 2
        out = place - middle
        place = place + 22 * out / max(float(np.linalg.norm(out)), 1e-9)
        turn = math.degrees(math.atan2(end[1] - start[1], end[0] - start[0]))
        turn -= 180 * round(turn / 180)  # never upside down
        parts.append(
            f'<text x="{place[0]:.1f}" y="{place[1]:.1f}" text-anchor="middle" '
            f'dominant-baseline="middle" transform="rotate({turn:.1f} {place[0]:.1f} '
            f'{place[1]:.1f})">{length.text("m")}</text>')
    return "".join(parts)


def _scale_bar(scale: float, width: float, bottom: float) -> str:
    x, y = width - _MARGIN - scale, bottom - 14
    return (f'<path d="M{x:.1f},{y - 5:.1f}v5h{scale:.1f}v-5" stroke="black" fill="none"/>'
            f'<text x="{x + scale / 2:.1f}" y="{y - 8:.1f}" text-anchor="middle">1 m</text>')
