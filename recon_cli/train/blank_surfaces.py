"""Points on walls, ceilings and floors without texture, where structure from motion finds none.

A training that begins without Gaussians on a bare wall puts them anywhere in front of it or behind:
the views of the path look right, others do not, and a mesh has holes. Regions without texture whose
points lie in one level or upright plane vote for it; several views must agree, and nothing may be
seen through it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from recon_cli.scene.train_view import TrainView
from recon_cli.train.blank_regions import (
    Array,
    Fit,
    Picture,
    Region,
    choose_plane,
    fit_plane,
    look_at,
    plane_depths,
)

_VIEWS = 60  # looked at, at most
_MOST_PLANES = 20
_AGREE = 3  # views
_AGREE_SHARE = 0.2  # of the most views that agree anywhere on a plane
# Of the fits of one plane: their angle in degrees, and their distance in median depths
_TURN, _OFF = 4.0, 0.02
_APART_TURN, _APART = 6.0, 0.03  # from another plane; nearer ones are that one
_STEPS = 6  # of the reweighted fit
_UPRIGHT = 0.9  # cosine to the vertical from which a plane is level
_LEAST_POINTS = 3  # around a region that is in a plane
_COVERAGE = 0.3  # of a region that they enclose; points along one edge could lie in two planes
_FARTHEST = 6.0  # median depths
_CELL = 1 / 25  # of the median depth: the side of a cell, 10 cm in a room
_PIXELS = 2  # every so many of a region vote
_MARGIN = 0.02  # median depths beyond the points and cameras
_TAIL = 0.01  # of the points, which may lie outside of the room
_THROUGH = 0.03  # median depths behind a plane that a point lies which is seen through it
_MOST_THROUGH = 0.1  # points seen through a cell, for each view that votes for it
# A region takes the plane of others where they overlap by so much, hardly anything lies behind,
# and no other plane is nearer.
_OVERLAP, _NEAREST, _FEW_BEHIND = 0.3, 0.9, 0.05
_GROWTH = 3  # rounds


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points on blank surfaces."""

    points: Array  # [K, 3] world units
    colors: NDArray[np.uint8]  # [K, 3]


@dataclass(frozen=True, eq=False)
class SparseModel:
    """What structure from motion knows of the training views."""

    points: Array  # [P, 3] world units
    seen: Sequence[NDArray[np.int64]]  # rows of the points that each view sees
    up: Array | None  # [3] unit vector; None where it is not known


class BlankSurfaces:
    """The blank surfaces of some views, searched when they are first asked for."""

    def __init__(self, views: Sequence[TrainView], model: Callable[[], SparseModel]) -> None:
        self._views, self._model = views, model

    @cached_property
    def found(self) -> SurfacePoints:
        """Points on them; none where up is not known."""
        model = self._model()
        if model.up is None or not len(model.points):
            return SurfacePoints(np.empty((0, 3)), np.empty((0, 3), np.uint8))
        count = min(_VIEWS, len(self._views))
        rows = np.unique(np.linspace(0, len(self._views) - 1, count).round().astype(int))
        return find_surfaces([self._views[row] for row in rows], [model.seen[row] for row in rows],
                             model.points, model.up)


def find_surfaces(
    views: Sequence[TrainView], seen: Sequence[NDArray[np.int64]], points: Array, up: Array
) -> SurfacePoints:
    """Returns points on the blank surfaces of views, each of which sees some rows of the points."""
    looked = look_at(views, seen, points)
    depths = np.concatenate([picture.depths for picture, _ in looked])
    search = _Search(looked, points, up, float(np.median(depths)) if len(depths) else 1.0)
    search.find_planes()
    if search.surfaces:
        search.assign()
        for _ in range(_GROWTH):
            if not search.grow():
                break
    return search.result()


@dataclass(eq=False)
class _Surface:
    """A plane, and the cells of it that views show to be blank surface."""

    normal: Array  # [3]
    offset: float
    side: float  # of a cell
    cells: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))  # sorted

    @cached_property
    def axes(self) -> Array:
        """Two unit vectors [2, 3] in the plane."""
        first = np.cross(self.normal, np.eye(3)[np.argmin(np.abs(self.normal))])
        first /= np.linalg.norm(first)
        return np.stack([first, np.cross(self.normal, first)])

    def codes(self, places: Array) -> NDArray[np.int64]:
        """Returns the number of the cell of each place [N, 3]."""
        at = np.floor(places @ self.axes.T / self.side).astype(np.int64) + _HALF
        return np.asarray(at[:, 0] * 2 * _HALF + at[:, 1])

    def centers(self) -> Array:
        """Returns the middle of each cell, [K, 3]."""
        at = np.stack([self.cells // (2 * _HALF), self.cells % (2 * _HALF)], axis=1) - _HALF
        return np.asarray(self.normal * self.offset + (at + 0.5) * self.side @ self.axes)

    def has(self, places: Array) -> NDArray[np.bool_]:
        """Tells which places [N, 3] lie in one of the cells."""
        return np.isin(self.codes(places), self.cells)


_HALF = 1 << 20  # cells on each side of the origin


@dataclass(eq=False)
class _Search:
    looked: list[tuple[Picture, list[Region]]]
    points: Array
    up: Array
    depth: float  # median, world units
    surfaces: list[_Surface] = field(default_factory=list)
    owner: dict[tuple[int, int], int] = field(default_factory=dict)  # surface of (picture, region)

    def find_planes(self) -> None:
        """Finds the planes that fits of three views or more agree on, the largest first."""
        generator = np.random.default_rng(0)
        fits, of = [], []
        for number, (picture, regions) in enumerate(self.looked):
            for region in regions:
                fit = fit_plane(picture, region, self.up, generator)
                if fit is not None:
                    fits.append(fit)
                    of.append(number)
        if not fits:
            return
        normals, offsets = np.stack([fit.normal for fit in fits]), np.array(
            [fit.offset for fit in fits])
        pixels, pictures = np.array([fit.pixels for fit in fits]), np.array(of)
        agree = (normals @ normals.T > np.cos(np.radians(_TURN))) & (
            np.abs(offsets[:, None] - offsets) < _OFF * self.depth)
        left = np.ones(len(fits), bool)
        while left.any() and len(self.surfaces) < _MOST_PLANES:
            support = np.where(left, (agree & left) @ pixels, 0)
            best = int(support.argmax())
            members = np.flatnonzero(agree[best] & left)
            if len(np.unique(pictures[members])) < _AGREE:
                break
            surface = self._refine(fits, members, normals[best], float(offsets[best]))
            self.surfaces.append(surface)
            left[members] = False
            left &= ~((normals @ surface.normal > np.cos(np.radians(_APART_TURN))) & (
                np.abs(offsets - surface.offset) < _APART * self.depth))

    def _refine(
        self, fits: Sequence[Fit], members: NDArray[np.int64], normal: Array, offset: float
    ) -> _Surface:
        """Returns the plane through all points of some fits (Tukey's weights), level or upright."""
        points = self.points[np.unique(np.concatenate([fits[i].inside for i in members]))]
        for _ in range(_STEPS):
            share = (points @ normal - offset) / (_OFF * self.depth)
            weights = np.clip(1 - share**2, 0, None) ** 2
            if (weights > 0).sum() < _LEAST_POINTS:
                break
            middle = np.average(points, axis=0, weights=weights)
            if abs(normal @ self.up) < _UPRIGHT:
                flat = (points - middle) - np.outer((points - middle) @ self.up, self.up)
                scatter = (flat * weights[:, None]).T @ flat
                # the vertical counts as the widest direction, so that it is never the normal
                fitted = np.linalg.eigh(
                    scatter + 2 * np.trace(scatter) * np.outer(self.up, self.up))[1][:, 0]
                normal = fitted if fitted @ normal > 0 else -fitted
            offset = float(middle @ normal)
        return _Surface(normal, offset, _CELL * self.depth)

    def assign(self) -> None:
        """Gives regions to the surfaces that the points around them speak for."""
        normals = np.stack([surface.normal for surface in self.surfaces])
        offsets = np.array([surface.offset for surface in self.surfaces])
        for number, (picture, regions) in enumerate(self.looked):
            for index, region in enumerate(regions):
                chosen = choose_plane(
                    picture, region, normals, offsets, least=_LEAST_POINTS, coverage=_COVERAGE,
                    farthest=_FARTHEST * self.depth)
                if chosen is not None:
                    self.owner[number, index] = chosen
        self._count()

    def grow(self) -> bool:
        """Gives regions that overlap a surface to it; returns whether there were any."""
        taken = {}
        for number, (picture, regions) in enumerate(self.looked):
            for index, region in enumerate(regions):
                if (number, index) not in self.owner:
                    chosen = self._overlapped(picture, region)
                    if chosen is not None:
                        taken[number, index] = chosen
        self.owner.update(taken)
        if taken:
            self._count()
        return bool(taken)

    def _overlapped(self, picture: Picture, region: Region) -> int | None:
        rays = picture.rays(region.lines[::_PIXELS], region.columns[::_PIXELS])
        depths = np.full((len(rays), len(self.surfaces)), np.inf)
        hits = np.zeros(depths.shape, bool)
        for number, surface in enumerate(self.surfaces):
            depth, places = self._meet(picture, surface, rays)
            depths[:, number] = depth
            hits[:, number] = surface.has(places) & np.isfinite(depth)
        nearest = np.where(np.isfinite(depths).any(1), depths.argmin(1), -1)
        for number, surface in enumerate(self.surfaces):
            mine = nearest == number
            if mine.mean() > _NEAREST and hits[mine, number].mean() > _OVERLAP:
                heights = picture.points[region.around] @ surface.normal - surface.offset
                ahead = picture.camera.center @ surface.normal - surface.offset
                behind = -np.sign(ahead) * heights > _OFF * self.depth
                if behind.mean() <= _FEW_BEHIND:
                    return number
        return None

    def _meet(self, picture: Picture, surface: _Surface, rays: Array) -> tuple[Array, Array]:
        """Returns where rays meet a surface within the room: depths [N], infinite, and places."""
        depth = plane_depths(
            picture, rays, surface.normal[None], np.array([surface.offset]))[:, 0]
        depth[depth > _FARTHEST * self.depth] = np.inf
        places = picture.camera.center + rays * np.where(np.isfinite(depth), depth, 0)[:, None]
        for axis, low, high in self._bounds:
            along = places @ axis
            depth[(along < low) | (along > high)] = np.inf
        return depth, places

    @cached_property
    def _bounds(self) -> list[tuple[Array, float, float]]:
        """Directions, and from where to where the room reaches along each; it is open above."""
        upright = [surface.normal for surface in self.surfaces
                   if abs(surface.normal @ self.up) < _UPRIGHT]
        centers = np.stack([picture.camera.center for picture, _ in self.looked])
        level = np.linalg.svd(self.up[None])[2][1:]
        bounds = []
        for axis in (*level, *upright, self.up):
            low, high = np.quantile(self.points @ axis, [_TAIL, 1 - _TAIL])
            along, margin = centers @ axis, _MARGIN * self.depth
            bounds.append((axis, float(min(low, along.min())) - margin,
                           float(max(high, along.max())) + margin))
        bounds[-1] = (self.up, bounds[-1][1], np.inf)
        return bounds

    def _count(self) -> None:
        """Finds the cells of each surface that enough views vote for and none sees through."""
        for number, surface in enumerate(self.surfaces):
            votes = [np.unique(surface.codes(self._places(*item, surface)[0]))
                     for item in self._pictures_of(number).items()]
            cells, counts = np.unique(
                np.concatenate([*votes, np.empty(0, np.int64)]), return_counts=True)
            through = np.zeros(len(cells))
            for picture, _ in self.looked if len(cells) else ():
                ahead = picture.camera.center @ surface.normal - surface.offset
                heights = picture.points @ surface.normal - surface.offset
                crossing = (ahead * heights < 0) & (np.abs(heights) > _THROUGH * self.depth)
                share = ahead / (ahead - heights[crossing])
                codes = surface.codes(picture.camera.center + share[:, None] * (
                    picture.points[crossing] - picture.camera.center))
                at = np.minimum(np.searchsorted(cells, codes), len(cells) - 1)
                np.add.at(through, at[cells[at] == codes], 1)
            least = max(_AGREE, _AGREE_SHARE * float(counts.max(initial=0)))
            surface.cells = cells[(counts >= least) & (through <= _MOST_THROUGH * counts)]

    def _pictures_of(self, number: int) -> dict[int, list[int]]:
        """Returns the regions that belong to a surface, by picture."""
        found: dict[int, list[int]] = {}
        for (picture, region), owner in self.owner.items():
            if owner == number:
                found.setdefault(picture, []).append(region)
        return found

    def _places(
        self, number: int, regions: Sequence[int], surface: _Surface
    ) -> tuple[Array, NDArray[np.uint8]]:
        """Returns where the pixels of some regions meet a surface, and their colours."""
        picture, every = self.looked[number]
        lines, columns = (np.concatenate([getattr(every[index], name)[::_PIXELS]
                                          for index in regions]) for name in ("lines", "columns"))
        depth, places = self._meet(picture, surface, picture.rays(lines, columns))
        there = np.isfinite(depth)
        return places[there], picture.image[lines[there], columns[there]]

    def result(self) -> SurfacePoints:
        """Returns a point in the middle of each cell, in the mean colour that is seen there."""
        places, colors = [np.empty((0, 3))], [np.empty((0, 3))]
        for number, surface in enumerate(self.surfaces):
            total, count = np.zeros((len(surface.cells), 3)), np.zeros(len(surface.cells))
            for picture, regions in self._pictures_of(number).items():
                where, pixels = self._places(picture, regions, surface)
                at = np.searchsorted(surface.cells, surface.codes(where))
                at = np.minimum(at, max(0, len(surface.cells) - 1))
                own = surface.has(where)
                np.add.at(total, at[own], pixels[own])
                np.add.at(count, at[own], 1)
            places.append(surface.centers())
            colors.append(total / np.maximum(count, 1)[:, None])
        return SurfacePoints(
            np.concatenate(places), np.concatenate(colors).round().astype(np.uint8))
