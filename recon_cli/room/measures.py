"""Measures of a room from the planes of its mesh: ceiling height, footprint, lengths of its walls.

Each has an interval of about 95% from two errors: how far the surface scatters about its planes,
and the scale. Missing measures are reported, not guessed.
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.io.meshes import Mesh
from recon_cli.room.mesh_planes import face_geometry
from recon_cli.room.planes import Plane
from recon_cli.room.scale_fusion import INTERVAL

_LEVEL = 0.98  # cosine to up from which on a plane is level; 11 degrees
_UPRIGHT = 0.10  # cosine to up up to which it is upright
_SAME = 0.96  # cosine within which two walls face the same way
_SCATTER = 1.05  # times the distance of a wall; a cupboard is deeper, fog is not
_LEAST_WALL = 0.25  # of the area of the largest wall that faces the same way
_MOST_OUTSIDE = 0.1  # share of the floor outside the footprint, else the room is not convex
# Share of a plane's scatter that its place is uncertain by: bumps of a wall are as long as
# Gaussians, so that a wall has some tens of independent ones.
_SHARE_OF_SPREAD = 0.5


@dataclass(frozen=True, eq=False)
class RoomFrame:
    """Facts about the exported world that measures need: its unit is the metre."""

    up: NDArray[np.float64]  # [3] unit vector
    scale_error: float  # relative standard error of the scale


@dataclass(frozen=True)
class Measure:
    """A length or an area with its interval."""

    value: float  # m or m^2
    error: float  # half of the interval of 95%

    def text(self, unit: str) -> str:
        """Returns the value with its interval, to the digits that the interval leaves."""
        return f"{self.value:.2f} \u00b1 {max(self.error, 0.01):.2f} {unit}"

    def to_json(self) -> dict[str, float]:
        """Returns the two numbers."""
        return {"value": self.value, "error": self.error}


@dataclass(frozen=True, eq=False)
class RoomMeasures:
    """The measures of a room; lengths in metres."""

    height: Measure | None  # from floor to ceiling
    floor_area: Measure | None  # of the footprint
    walls: tuple[Measure, ...]  # lengths of the sides of the footprint, in order
    footprint: NDArray[np.float64] | None  # [W, 2] corners on the plan, counter-clockwise
    notes: tuple[str, ...]  # measures that were not found
    # [S, 2, 2] cut through the mesh at 1 m, on the plan
    cut: NDArray[np.float64] = field(repr=False)
    axes: NDArray[np.float64] = field(repr=False)  # [2, 3] right and up of the plan in the world

    def to_json(self) -> dict[str, Any]:
        """Returns the measures as JSON values."""
        return {
            "unit": "m",
            "ceiling_height": self.height.to_json() if self.height else None,
            "floor_area": self.floor_area.to_json() if self.floor_area else None,
            "walls": [wall.to_json() for wall in self.walls],
            "footprint": None if self.footprint is None else self.footprint.tolist(),
            "notes": list(self.notes)}


def measure_room(
    mesh: Mesh,
    planes: Sequence[tuple[Plane, Plane | None]],  # of the mesh, and as points confirm them
    centers: NDArray[np.float64],  # [C, 3] cameras
    up: NDArray[np.float64],  # [3] unit vector
    scale_error: float,  # relative standard error of the scale
) -> RoomMeasures:
    """Returns the measures of a room whose unit is the metre and whose up is known."""
    best = [confirmed or plane for plane, confirmed in planes]
    middle = centers.mean(axis=0)
    doubts = {id(row): _SHARE_OF_SPREAD * row.spread for row in best}
    reach = max((abs(row.heights(middle[None])[0]) for row in best), default=0.0)
    for plane, confirmed in planes:
        if confirmed is None:
            doubts[id(plane)] = float(np.hypot(
                doubts[id(plane)], _lean(plane, planes) * reach))
    notes: list[str] = []
    floors = [plane for plane in best
              if plane.normal @ up > _LEVEL and (plane.heights(centers) > 0).mean() > 0.9]
    ceilings = [plane for plane in best
                if plane.normal @ up < -_LEVEL and (plane.heights(centers) > 0).mean() > 0.9]
    floor = max(floors, key=lambda plane: plane.heights(middle[None])[0], default=None)
    ceiling = max(ceilings, key=lambda plane: plane.heights(middle[None])[0], default=None)
    if floor is None:
        notes.append("No floor was found.")
    if ceiling is None:
        notes.append("No ceiling was found, so its height is not known.")
    height = None
    if floor is not None and ceiling is not None:
        value = float(floor.heights(middle[None])[0] + ceiling.heights(middle[None])[0])
        height = _measure(value, np.hypot(doubts[id(floor)], doubts[id(ceiling)]), scale_error)
    base = middle @ up - (floor.heights(middle[None])[0] if floor is not None else 0.0)
    confirmed_ids = {id(confirmed) for _, confirmed in planes if confirmed is not None}
    walls = _outer_walls(best, centers, up, confirmed_ids)
    axes = _plan_axes(walls, up)
    footprint, lengths, area = _footprint(walls, axes, middle, doubts, scale_error)
    if footprint is None:
        notes.append(f"Walls were found on {len(walls)} sides, which do not enclose a room, so "
                     "there is no footprint.")
    elif floor is not None and _share_outside(mesh, floor, axes, footprint) > _MOST_OUTSIDE:
        notes.append("The floor continues beyond the walls found: the room is not convex, "
                     "or open, so there is no footprint.")
        footprint, lengths, area = None, (), None
    cut = cut_mesh(mesh, up, float(base) + 1.0)
    return RoomMeasures(height, area, lengths, footprint, tuple(notes), cut @ axes.T, axes)


def _lean(plane: Plane, planes: Sequence[tuple[Plane, Plane | None]]) -> float:
    """Returns by how much an unconfirmed wall leans against a confirmed one; 0 if against none.

    Walls in front of each other are parallel, most often: where points confirm one and the other,
    of surface alone, is not parallel, its surface is not the wall everywhere.
    """
    cosines = [abs(float(plane.normal @ confirmed.normal))
               for _, confirmed in planes if confirmed is not None]
    close = max((cosine for cosine in cosines if cosine > _SAME), default=1.0)
    return float(np.sqrt(max(0.0, 1 - close**2)))


def cut_mesh(mesh: Mesh, up: NDArray[np.float64], height: float) -> NDArray[np.float64]:
    """Returns the segments [S, 2, 3] in which a level plane cuts a mesh."""
    above = mesh.vertices @ up - height
    signs = above[mesh.faces] > 0
    crossed = mesh.faces[(signs.any(axis=1)) & (~signs.all(axis=1))]
    signs = above[crossed] > 0
    # the corner that lies alone on its side comes first
    alone = np.where(signs.sum(axis=1) == 1, signs.argmax(axis=1), (~signs).argmax(axis=1))
    order = (alone[:, None] + np.arange(3)) % 3
    corners = np.take_along_axis(crossed, order, axis=1)
    ends = []
    for other in (1, 2):
        a, b = above[corners[:, 0]], above[corners[:, other]]
        share = (a / np.where(a == b, 1, a - b))[:, None]
        ends.append(mesh.vertices[corners[:, 0]] * (1 - share)
                    + mesh.vertices[corners[:, other]] * share)
    return np.stack(ends, axis=1)


def _measure(value: float, error: float, scale_error: float) -> Measure:
    return Measure(value, float(INTERVAL * np.hypot(error, scale_error * value)))


def _outer_walls(
    planes: Sequence[Plane], centers: NDArray[np.float64], up: NDArray[np.float64],
    sure: Set[int],
) -> list[Plane]:
    """Returns upright planes that all cameras see from inside, the outermost of each direction.

    `sure` are the ids of those that points confirm. A plane without points that is a little
    further out than one of these is the scatter of the same wall.
    """
    upright = [plane for plane in planes if abs(plane.normal @ up) < _UPRIGHT
               and (plane.heights(centers) > 0).mean() > 0.95]
    middle = centers.mean(axis=0)
    walls: list[Plane] = []
    for plane in upright:
        alike = [other for other in upright if other.normal @ plane.normal > _SAME]
        large = [other for other in alike
                 if other.area >= _LEAST_WALL * max(one.area for one in alike)]
        known = [other.heights(middle[None])[0] for other in large if id(other) in sure]
        large = [other for other in large if id(other) in sure or not any(
            height < other.heights(middle[None])[0] < _SCATTER * height for height in known)]
        outermost = max(large, key=lambda other: other.heights(middle[None])[0])
        if outermost is plane:
            walls.append(plane)
    return walls


def _plan_axes(walls: Sequence[Plane], up: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns right and up of the plan [2, 3]: along the largest wall, or any level direction."""
    if walls:
        largest = max(walls, key=lambda wall: wall.area).normal
        ahead = largest - (largest @ up) * up
    else:
        ahead = np.eye(3)[np.argmin(np.abs(up))]
        ahead = ahead - (ahead @ up) * up
    ahead = ahead / np.linalg.norm(ahead)
    return np.stack([np.cross(ahead, up), ahead])


def _footprint(
    walls: Sequence[Plane], axes: NDArray[np.float64], middle: NDArray[np.float64],
    doubts: dict[int, float], scale_error: float,
) -> tuple[NDArray[np.float64] | None, tuple[Measure, ...], Measure | None]:
    """Returns the corners of the walls [W, 2], their lengths, and the area within."""
    if len(walls) < 3:
        return None, (), None
    normals = np.stack([axes @ wall.normal for wall in walls])
    order = np.argsort(np.arctan2(normals[:, 1], normals[:, 0]))
    ordered = [walls[row] for row in order]
    normals = normals[order] / np.linalg.norm(normals[order], axis=1, keepdims=True)
    # heights over the walls fall to zero at the distance of the middle
    reach = np.array([wall.heights(middle[None])[0] for wall in ordered])
    offsets = normals @ (axes @ middle) - reach
    count = len(ordered)
    corners = []
    for row in range(count):
        pair = [row, (row + 1) % count]
        turn = normals[pair[0]][0] * normals[pair[1]][1] - normals[pair[0]][1] * normals[pair[1]][0]
        if turn < 0.1:  # the next wall does not turn left: the walls leave a side open
            return None, (), None
        corners.append(np.linalg.solve(normals[pair], offsets[pair]))
    polygon = np.stack(corners)
    inside = polygon @ normals.T - offsets > -1e-6
    if not inside.all():  # a wall cuts a corner off that others make
        return None, (), None
    sides = polygon - np.roll(polygon, 1, axis=0)  # side k lies in wall k
    lengths = np.linalg.norm(sides, axis=1)
    errors = np.array([doubts[id(wall)] for wall in ordered])
    along = np.hypot(np.roll(errors, 1), np.roll(errors, -1))
    x, y = polygon.T
    area = float(abs((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()) / 2)
    area_error = INTERVAL * float(np.hypot(
        np.sqrt(((lengths * errors) ** 2).sum()), 2 * scale_error * area))
    return polygon, tuple(_measure(float(length), float(error), scale_error)
                          for length, error in zip(lengths, along, strict=True)), Measure(
        area, area_error)


def _share_outside(
    mesh: Mesh, floor: Plane, axes: NDArray[np.float64], footprint: NDArray[np.float64]
) -> float:
    """Returns the share of the mesh's floor that lies outside the footprint by over 10 cm."""
    centers, normals, areas = face_geometry(mesh.vertices, mesh.faces)
    level = (np.abs(floor.heights(centers)) < max(3 * floor.spread, 0.03)) & (
        normals @ floor.normal > _SAME)
    places = centers[level] @ axes.T
    sides = np.roll(footprint, -1, axis=0) - footprint
    inwards = np.stack([-sides[:, 1], sides[:, 0]], axis=1)
    inwards /= np.linalg.norm(inwards, axis=1, keepdims=True)
    inwards *= np.sign(((footprint.mean(axis=0) - footprint) * inwards).sum(1))[:, None]
    apart = ((places[:, None] - footprint) * inwards).sum(-1)
    outside = (apart < -0.1).any(axis=1)
    return float(areas[level][outside].sum() / max(areas[level].sum(), 1e-12))
