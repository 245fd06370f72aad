"""Regions without sparse points: blank surfaces, and far places outside, behind windows.

Structure from motion finds few points there, so training would paint them on whatever is near.
Parts of the pictures without points get Gaussians at the depth of the points around. Behind them,
directions in which several views see no point get one each on a sphere so large that it has no
parallax. All have the colour that the views show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from recon_cli.io.images import reduce_to
from recon_cli.scene.backdrop import fibonacci_sphere
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import SH_C0, TERMS, Splats
from recon_cli.scene.statistics import LEAST_WITNESSES
from recon_cli.scene.train_view import TrainView
from recon_cli.train.fit.task import Evidence
from recon_cli.train.parts.decisions import split
from recon_cli.train.parts.part import SEARCH_SIDE, Part, Sign, Start, TrialScene

_RADIUS = 100.0  # x extent: from one end of the path to the other it moves by a degree
_DIRECTIONS = 5000  # on the whole sphere: 3 degrees apart
_VIEWS = 50  # looked at, at most
# a surface covers this many times the median distance of its points in the image around each,
# within these reduced pixels: between dense points a window stays open, sparse ones close a wall
_COVER = 3.0
_COVER_RANGE = 1, 4
_SAMPLES = 500  # points that this median is taken over
_SHARE = 0.1  # of the views that look there: elsewhere a surface lacks points in some views only
_FACING = 5  # directions that must be free in a view that sees some of it; 50 square degrees
# Of views that look at one thing: the median sine of the angle between axis and point is .03 to .13
# on five captures of things and .37 to .96 on seven of rooms, and nine of ten come from within 18
# degrees or more, on a walk down a corridor 5.
_MISSED, _BEFORE, _SIDES_DEG = 0.25, 0.9, 10.0
_FILL_DEGREES = 12.0  # directions this close to a far one become far: frames and trees hide some
# Of gaps between points, in the reduced images. Set beforehand, and held against views in the
# middle of stretches that were taken away (tests/bench/notes/training.md); .1 gained as much.
_GAP_GRID = _COVER_RANGE[1]  # pixels from one place that is looked at to the next
_NEIGHBOURS = 12  # points whose median depth a gap has
_GAP_CELL = 0.06  # of the median depth of all gaps: places within are one
_THROUGH = 1.15  # times the depth of a gap: a point beyond it, this many pixels away or less, shows
_THROUGH_RANGE = _GAP_GRID / 2  # that the gap is seen through
_THROUGH_SHARE = 0.2  # of the views that look there; the points of some lie behind what hides them
_OPACITY = 0.5
_SPACING = 0.6  # of the distance between directions: the standard deviation


@dataclass(frozen=True, eq=False)
class Background:
    """Directions in which nothing near was found."""

    positions: NDArray[np.float64]  # [K, 3] float64 on the sphere, world units
    colors: NDArray[np.float64]  # [K, 3] float64 in [0, 1]
    scale: float  # standard deviation that closes the gaps between them, world units
    share: float  # of all looked-at pixels' directions that are far, 0 to 1
    # points [G, 3] at the depth of those around, with uint8 colours, where views see none
    gap_points: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    gap_colors: NDArray[np.uint8] = field(default_factory=lambda: np.zeros((0, 3), np.uint8))


def find_background(
    views: Sequence[TrainView], points: NDArray[np.float64], extent: float
) -> Background:
    """Returns the directions in which the views see no point [P, 3] of the scene, and its gaps.

    Around one thing, gaps are backgrounds at any depth, and stay empty.
    """
    centers = np.stack([view.camera.center for view in views])
    directions = fibonacci_sphere(_DIRECTIONS)
    sphere = centers.mean(axis=0) + _RADIUS * extent * directions
    looked_at, empty = np.zeros(len(sphere)), np.zeros(len(sphere))
    total = np.zeros((len(sphere), 3))
    searched = [_search_view(view, points) for view in views[::max(1, -(-len(views) // _VIEWS))]]
    for shown in searched:
        small = shown.view
        rows, column, line, _ = small.camera.find_visible(sphere)
        looked_at[rows] += 1
        free = shown.free[line, column]
        empty[rows[free]] += 1
        total[rows[free]] += small.image[line[free], column[free]] / 255
    far = (empty >= LEAST_WITNESSES) & (empty >= _SHARE * looked_at)
    share = float(far.sum() / max(1, (looked_at > 0).sum()))
    colors = total / np.maximum(empty, 1)[:, None]
    far, colors = _fill_gaps(directions, far, colors)
    spacing = _RADIUS * extent * np.sqrt(4 * np.pi / _DIRECTIONS)
    gaps = () if look_at_one_thing(views) else _find_gaps(searched)
    return Background(sphere[far], colors[far], float(_SPACING * spacing), share, *gaps)


@dataclass(frozen=True, eq=False)
class _SearchView:
    """A reduced view, and the points that it shows, the nearest one of each pixel."""

    view: TrainView
    free: NDArray[np.bool_]  # [H, W] no point lies near, and the pixel counts
    pixels: NDArray[np.int64]  # [P, 2] column and line
    depths: NDArray[np.float64]  # [P] world units


def _search_view(view: TrainView, points: NDArray[np.float64]) -> _SearchView:
    """Returns the points that a view shows."""
    small = reduce_to(view, SEARCH_SIDE)
    free = ~_cover_mask(small, points)
    if small.mask is not None:
        free &= small.mask
    rows, column, line, _ = small.camera.find_visible(points)
    depths = _depths(small.camera, points[rows])
    nearest = np.argsort(depths, kind="stable")
    _, first = np.unique((line * small.camera.width + column)[nearest], return_index=True)
    kept = nearest[first]
    return _SearchView(small, free, np.stack([column[kept], line[kept]], 1), depths[kept])


def _depths(camera: Camera, points: NDArray[np.float64]) -> NDArray[np.float64]:
    depths: NDArray[np.float64] = points @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
    return depths


def _find_gaps(searched: Sequence[_SearchView]) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Returns points [G, 3] on surfaces without points, and their colours.

    Each view places them at the median depth of the points around in its image. What two views
    place in the same cell counts, unless others see points through it.
    """
    searched = [shown for shown in searched if len(shown.depths) >= _NEIGHBOURS]
    found = [_place_gaps(shown) for shown in searched]
    if not any(len(places) for places, _, _ in found):
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    places, colors, depths = (np.concatenate(parts) for parts in zip(*found, strict=True))
    by = np.repeat(np.arange(len(found)), [len(part[0]) for part in found])
    cells = np.floor(places / (_GAP_CELL * np.median(depths))).astype(np.int64)
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    cell = cell.reshape(-1)
    count = np.bincount(cell)
    views = np.bincount(np.unique(np.stack([cell, by], 1), axis=0)[:, 0])
    places, colors = (
        np.stack([np.bincount(cell, column) for column in values.T], 1) / count[:, None]
        for values in (places, colors))
    kept = (views >= LEAST_WITNESSES) & ~_seen_through(places, searched)
    return places[kept], colors[kept].astype(np.uint8)


def _place_gaps(
    shown: _SearchView,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Returns places [K, 3] in one view's regions without points, their colours and depths."""
    camera = shown.view.camera
    line, column = np.mgrid[_GAP_GRID // 2:camera.height:_GAP_GRID,
                            _GAP_GRID // 2:camera.width:_GAP_GRID]
    free = shown.free[line, column]
    line, column = line[free], column[free]
    _, near = cKDTree(shown.pixels).query(np.stack([column, line], 1), k=_NEIGHBOURS)
    depths = np.median(shown.depths[near], axis=1)
    places = camera.unproject(np.stack([column, line], 1) + 0.5, depths)
    return places, shown.view.image[line, column].astype(np.float64), depths


def _seen_through(
    places: NDArray[np.float64], searched: Sequence[_SearchView]
) -> NDArray[np.bool_]:
    """Tells of which places [G, 3] too many views show points beyond."""
    looked_at, through = np.zeros(len(places)), np.zeros(len(places))
    for shown in searched:
        rows, column, line, _ = shown.view.camera.find_visible(places)
        distance, near = cKDTree(shown.pixels).query(np.stack([column, line], 1))
        beyond = shown.depths[near] > _THROUGH * _depths(shown.view.camera, places[rows])
        looked_at[rows] += 1
        through[rows[beyond & (distance <= _THROUGH_RANGE)]] += 1
    return through > _THROUGH_SHARE * looked_at


def faces(view: TrainView, content: Background, points: NDArray[np.float64]) -> bool:
    """Tells whether a view sees places far outside, past the points [P, 3]."""
    small = reduce_to(view, SEARCH_SIDE)
    _, column, line, _ = small.camera.find_visible(content.positions)
    return int((~_cover_mask(small, points)[line, column]).sum()) >= _FACING


def look_at_one_thing(views: Sequence[TrainView]) -> bool:
    """Tells whether the views stand around a thing and look at it, as opposed to a room or a walk.

    Their optical axes then pass near one point before them, and meet there from different sides:
    those of a walk straight ahead run side by side.
    """
    centers = np.stack([view.camera.center for view in views])
    forward = np.stack([view.camera.viewmat[2, :3] for view in views])
    across = np.eye(3) - forward[:, :, None] * forward[:, None]  # [V, 3, 3]
    sums = across.sum(0), (across @ centers[..., None]).sum(0)[:, 0]
    point = np.linalg.lstsq(*sums, rcond=None)[0]
    offsets = point - centers
    distance = np.maximum(np.linalg.norm(offsets, axis=1), 1e-12)
    ahead = (offsets * forward).sum(1)
    missed = np.sqrt(np.maximum(1 - (ahead / distance) ** 2, 0))
    sides = offsets / distance[:, None]
    middle = sides.mean(0) / max(float(np.linalg.norm(sides.mean(0))), 1e-12)
    spread = np.degrees(np.arccos(np.clip(sides @ middle, -1, 1)))
    return bool(np.median(missed) < _MISSED and (ahead > 0).mean() > _BEFORE
                and np.quantile(spread, _BEFORE) > _SIDES_DEG)


def _cover_mask(view: TrainView, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Returns where a point lies near, [H, W]; it may lie outside the image."""
    camera, edge = view.camera, _COVER_RANGE[1]
    wider = replace(camera, width=camera.width + 2 * edge, height=camera.height + 2 * edge,
                    cx=camera.cx + edge, cy=camera.cy + edge)
    _, column, line, _ = wider.find_visible(points)
    hit = np.zeros((wider.height, wider.width), np.uint8)
    hit[line, column] = 1
    pixels = np.argwhere(hit)
    if len(pixels) < 2:
        return hit[edge:-edge, edge:-edge] > 0
    some = pixels[::max(1, len(pixels) // _SAMPLES)]
    distance = cKDTree(pixels).query(some, k=2)[0][:, 1]
    radius = int(np.clip(round(_COVER * float(np.median(distance)) / 2), *_COVER_RANGE))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return np.asarray(cv2.dilate(hit, disc)[edge:-edge, edge:-edge] > 0)


def _fill_gaps(
    directions: NDArray[np.float64], far: NDArray[np.bool_], colors: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Returns the far directions with their surroundings, coloured by their neighbours."""
    if not far.any():
        return far, colors
    tree = cKDTree(directions[far])
    count = min(6, int(far.sum()))
    distance, nearest = tree.query(directions, k=list(range(1, count + 1)))
    weight = 1 / np.maximum(distance, 1e-6) ** 2
    blended = (colors[far][nearest] * weight[..., None]).sum(1) / weight.sum(1, keepdims=True)
    around = ~far & (distance[:, 0] < 2 * np.sin(np.radians(_FILL_DEGREES) / 2))
    return far | around, np.where(around[:, None], blended, colors)


def splats_of(content: Background, sh_rest: int) -> Splats:
    """Returns one round Gaussian a direction, with `sh_rest` rows of higher coefficients."""
    n = len(content.positions)
    return Splats(
        means=torch.tensor(content.positions, dtype=torch.float32),
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        log_scales=torch.full((n, 3), float(np.log(content.scale))),
        logit_opacities=torch.logit(torch.full((n,), _OPACITY)),
        sh_dc=(torch.tensor(content.colors, dtype=torch.float32) - 0.5) / SH_C0,
        sh_rest=torch.zeros(n, sh_rest, 3))


def _find(evidence: Evidence) -> Background:
    return find_background(evidence.views, evidence.points, evidence.extent)


def _is_seen(scene: TrialScene) -> Sign:
    """Returns the sign: on in rooms, where full runs gain -.1 to 2.3 dB; around a thing, where all
    five lose up to .5 dB, a trial must show a gain (tests/bench/notes/training.md).
    """
    found, task = scene.evidence.once(_find), scene.task
    if found.share == 0:
        return Sign(on=False, reason="points cover all that the views see")
    if look_at_one_thing(task.train) or split(len(task.train), len(task.validation)) is None:
        return Sign()
    return Sign(on=True, reason=f"no point lies in {100 * found.share:.0f}% of the directions")


def _find_telling(scene: TrialScene, views: Sequence[TrainView]) -> list[int]:
    found = scene.evidence.once(_find)
    return [row for row, view in enumerate(views) if faces(view, found, scene.points)]


def _attach(start: Start) -> None:
    """Adds what lies far outside by the sparse points alone: walls have its colour behind them too.
    """
    found = start.evidence.once(_find)
    start.add_points(found.gap_points, found.gap_colors)
    start.splats.append(splats_of(found, TERMS[start.task.schedule.config.sh_degree]))


PART = Part("background", _is_seen, telling=_find_telling, attach=_attach)
