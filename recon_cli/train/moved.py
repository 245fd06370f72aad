"""Finds what was moved once: things that one part of a capture shows and the other does not.

No view is in the minority, so the others together cannot tell which are wrong. But all views of the
other part agree. Errors of the model do so too, as at a window that is passed from two sides; what
was moved is besides in one place in space: from wherever a view of the one part looks there it
shows an error, and from wherever one of the other part looks it shows none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, label

from recon_cli.scene.camera import Camera
from recon_cli.stereo.depths import places
from recon_cli.train.moving import (
    TOO_NOISY,
    ComparedView,
    contradict,
    find_others,
    find_regions,
    find_suspects,
    noise_level,
    project,
)

# A tenth of a region must contradict as much, and half of it be so far beyond the spread: less than
# of what moves, as a model of both states has a ghost of either.
_CLEAR, _LIKELY = 0.12, 5.0
_LEAST = 3  # views of each part must look at a place, and of the other part at a surface
_CELL, _MOST_CELLS = 0.04, 400_000  # of the median depth; a side of the cells that space is cut in
_NEAREST = 0.25  # of the median depth; cells nearer to a camera are not looked at
_BEHIND = 0.06  # of a depth, within which a place is not behind a surface
# Of the views of one part that look at a cell show what was moved, and of the other part show any
# error, at most. In a first look things must have a sure part.
_SURE, _SHOWS, _ELSEWHERE = 0.75, 0.6, 0.15
_LEAST_CELLS = 12  # of a thing, joined: a seat was 43, chairs 21 and 185; clean captures had 2
_NEAR = 0.33  # of the median distance of two cameras: what the next of a walk is within
_HIDES = 0.5  # of a thing's cells; a region with more of them in it is one of the thing

Regions = list[NDArray[np.bool_]]


def is_walk(cameras: Sequence[Camera]) -> bool:
    """Returns whether cameras are in the order in which they were passed."""
    centers = np.array([camera.center for camera in cameras])
    if len(centers) < 4 * _LEAST:
        return False
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    apart = np.linalg.norm(centers[:, None] - centers, axis=2)[np.triu_indices(len(centers), 1)]
    return bool(np.median(steps) < _NEAR * np.median(apart))


@dataclass(frozen=True, eq=False)
class Space:
    """The space before the surfaces of a capture, in cells."""

    cells: NDArray[np.float64]  # [N, 3] their middles
    shape: tuple[int, int, int]
    side: float
    near: float  # depth from which cells are looked at

    @staticmethod
    def of_views(views: Sequence[ComparedView]) -> Space:
        """Returns the space that holds nearly all surfaces that the views see."""
        seen = [np.flatnonzero(view.depth.reshape(-1) > 0)[::37] for view in views]
        points = np.concatenate([places(view.camera, view.depth, pixels)
                                 for view, pixels in zip(views, seen, strict=True)])
        depth = float(np.median(np.concatenate([view.depth[view.depth > 0] for view in views])))
        low, high = np.percentile(points, [1, 99], axis=0)
        side = _CELL * depth
        while np.prod(np.maximum((high - low) / side, 1)) > _MOST_CELLS:
            side *= 1.1
        axes = [np.arange(a + side / 2, max(b, a + side), side)
                for a, b in zip(low, high, strict=True)]
        cells = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        return Space(cells, (len(axes[0]), len(axes[1]), len(axes[2])), side, _NEAREST * depth)

    def look(
        self, view: ComparedView, cells: NDArray[np.int64] | None = None
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Returns which cells a view looks at, of some or all, and in which pixels."""
        rows = np.arange(len(self.cells)) if cells is None else cells
        column, line, depth = project(view.camera, self.cells[rows])
        u, v = (np.rint(np.clip(item, -2, 1 << 20)).astype(np.int64) for item in (column, line))
        height, width = view.depth.shape
        inside = (depth > self.near) & (u >= 0) & (v >= 0) & (u < width) & (v < height)
        rows, pixels, depth = rows[inside], (v * width + u)[inside], depth[inside]
        surface = view.depth.reshape(-1)[pixels]
        free = (surface == 0) | (depth < (1 + _BEHIND) * surface)
        free &= view.counts.reshape(-1)[pixels]
        return rows[free], pixels[free]


@dataclass(frozen=True, eq=False)
class Parts:
    """A capture in two parts, before and after a time."""

    views: Sequence[ComparedView]
    late: NDArray[np.bool_]  # [V] which views belong to the second

    @staticmethod
    def halves(views: Sequence[ComparedView]) -> Parts:
        """Returns the first and the second half of a capture."""
        return Parts(views, np.arange(len(views)) >= len(views) // 2)

    def contradictions(self) -> Regions:
        """Returns where each view [H, W] contradicts what those of the other part agree on."""
        noise = noise_level(self.views)
        regions = []
        for own, late in zip(self.views, self.late, strict=True):
            regions.append(np.zeros(own.depth.shape, np.bool_))
            suspects = find_suspects(own, noise, _CLEAR)
            if not suspects.any():
                continue
            witnesses = [view for view, other in zip(self.views, self.late, strict=True)
                         if other != late]
            found = contradict(witnesses, own, find_others(own, witnesses), suspects)
            found.amount[found.seen < _LEAST] = 0
            regions[-1] = find_regions(found, noise, _LIKELY, _CLEAR)
        return regions

    def find_cells(
        self, space: Space, regions: Regions, share: float
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Returns which cells hold something in the first part only, and which in the second."""
        noise = noise_level(self.views)
        looked, shown, errs = np.zeros((3, 2, len(space.cells)), np.int64)
        for view, late, region in zip(self.views, self.late.astype(int), regions, strict=True):
            cells, pixels = space.look(view)
            looked[late, cells] += 1
            shown[late, cells] += region.reshape(-1)[pixels]
            errs[late, cells] += find_suspects(view, noise).reshape(-1)[pixels]
        told = looked.min(axis=0) >= _LEAST
        # beside what all views err at, cells that only some see against it look alike
        always = told & (errs >= _SHOWS * looked).all(axis=0)
        beside = binary_dilation(always.reshape(space.shape), np.ones((3, 3, 3))).reshape(-1)
        first, second = (
            told & ~beside & (shown[part] >= np.maximum(_LEAST, share * looked[part]))
            & (errs[1 - part] <= _ELSEWHERE * looked[1 - part]) for part in (0, 1))
        return first, second


def _joined(cells: NDArray[np.bool_], space: Space) -> list[NDArray[np.int64]]:
    """Returns the groups of cells that touch each other, as rows, without small ones."""
    if not cells.any():
        return []
    labels, count = label(cells.reshape(space.shape), np.ones((3, 3, 3)))
    groups = [np.flatnonzero(labels.reshape(-1) == index) for index in range(1, count + 1)]
    return [group for group in groups if len(group) >= _LEAST_CELLS]


def was_moved(views: Sequence[ComparedView]) -> bool:
    """Returns whether some views, in the order of the capture, show that something was moved.

    Only a move about half-way is looked for: of the views of a window, the first tenths and the
    last often agree with each other, too, and see it from different sides.
    """
    if noise_level(views) > TOO_NOISY or not is_walk([view.camera for view in views]):
        return False
    if not any((view.depth > 0).any() for view in views):
        return False
    parts, space = Parts.halves(views), Space.of_views(views)
    regions = parts.contradictions()
    if not any(region.any() for region in regions):
        return False
    return any(_joined(cells, space) for cells in parts.find_cells(space, regions, _SURE))


def hide_rarer(views: Sequence[ComparedView]) -> Regions:
    """Returns where each view [H, W] shows what was moved in the state that fewer views saw."""
    parts, space = Parts.halves(views), Space.of_views(views)
    regions = parts.contradictions()
    hidden = [np.zeros(region.shape, np.bool_) for region in regions]
    # what touches is one thing, whichever half errs against the model's mixture of both states
    for thing in _joined(np.logical_or(*parts.find_cells(space, regions, _SHOWS)), space):
        looks = [space.look(view, thing) for view in views]
        sights = np.array([len(seen) for seen, _ in looks])  # views, by the share they see
        rarer = bool(sights[parts.late].sum() < sights[~parts.late].sum())
        for row in np.flatnonzero(parts.late == rarer).tolist():
            there = _outline(space, views[row], looks[row])
            # a region there is the thing with its shadow
            hidden[row] |= there | _touched(regions[row], there)
    return hidden


def _outline(
    space: Space, view: ComparedView, look: tuple[NDArray[np.int64], NDArray[np.int64]]
) -> NDArray[np.bool_]:
    """Returns the pixels [H, W] of cells that a view looks at."""
    cells, pixels = look
    image = np.zeros(view.depth.shape, np.uint8)
    if not len(cells):
        return image > 0
    _, _, depth = project(view.camera, space.cells[cells])
    radius = max(1, round(0.75 * view.camera.fx * space.side / float(np.median(depth))))
    image.reshape(-1)[pixels] = 1
    size = 2 * radius + 1
    return np.asarray(cv2.dilate(image, cv2.getStructuringElement(
        cv2.MORPH_ELLIPSE, (size, size))) > 0)


def _touched(region: NDArray[np.bool_], there: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Returns the connected parts of a region that lie in a place for a good deal."""
    count, labels = cv2.connectedComponents(region.astype(np.uint8), connectivity=4)
    result = np.zeros_like(region)
    for index in range(1, count):
        part = labels == index
        if np.count_nonzero(part & there) >= _HIDES * np.count_nonzero(part):
            result |= part
    return result
