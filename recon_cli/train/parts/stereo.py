"""Points on surfaces where structure from motion finds few, by dense stereo.

A bare wall has no sparse points. A training that begins without Gaussians there puts them anywhere
in front of it or behind: the views of the path look right, others do not.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import compress, count

import numpy as np
from numpy.typing import NDArray

from recon_cli.deadline import Deadline
from recon_cli.io.images import reduce_to
from recon_cli.scene.covisibility import observe_points
from recon_cli.scene.statistics import COARSE_SAMPLE, LEAST_WITNESSES
from recon_cli.scene.train_view import TrainView
from recon_cli.scene.voxels import SURFACE_CELL, number_cells
from recon_cli.stereo.depths import (
    LEAST_SEEN,
    NEAREST,
    StereoView,
    find_depths,
    find_partners,
    spanned,
    unproject,
)
from recon_cli.train.fit.task import Evidence, Task
from recon_cli.train.parts.part import SEARCHED_VIEWS, Part, Sign, Start
from recon_cli.train.parts.sparse_points import estimate_gains

_SIDE = 300  # pixels of their longer side
_NEIGHBOURS = 10  # views that each is compared with

logger = logging.getLogger("recon")


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points on surfaces."""

    points: NDArray[np.float64]  # [K, 3] world units
    colors: NDArray[np.uint8]  # [K, 3]

    @staticmethod
    def nothing() -> SurfacePoints:
        """Returns no points."""
        return SurfacePoints(np.empty((0, 3)), np.empty((0, 3), np.uint8))

    def at_most(self, count: int, seed: int) -> SurfacePoints:
        """Returns these points, or a seeded draw where there are more than `count`."""
        if len(self.points) <= count:
            return self
        drawn = np.sort(np.random.default_rng(seed).permutation(len(self.points))[:max(count, 0)])
        return SurfacePoints(self.points[drawn], self.colors[drawn])


def find_surfaces(evidence: Evidence, deadline: Deadline | None = None) -> SurfacePoints:
    """Returns points on surfaces that two views find, in cells without a sparse point.

    Brightness is compared after the gains that the sparse points show, of up to 60 views.

    Raises:
        OutOfTime: the search would not end in time.
    """
    if evidence.tracks is None:
        return SurfacePoints.nothing()
    deadline, views, points = deadline or Deadline(), evidence.views, evidence.points
    tracks = evidence.tracks()
    rows = np.unique(np.linspace(
        0, len(views) - 1, min(len(views), SEARCHED_VIEWS)).round().astype(int))
    chosen = [reduce_to(views[row], _SIDE) for row in rows]
    seen = _visibility(chosen, [tracks[row] for row in rows], points)
    depths = [view.camera.viewmat[2, :3] @ points[mine].T + view.camera.viewmat[2, 3]
              for view, mine in zip(chosen, seen, strict=True)]
    depths = [depth[depth > 0] for depth in depths]
    usable = [len(depth) >= LEAST_SEEN for depth in depths]
    if sum(usable) < LEAST_WITNESSES:
        return SurfacePoints.nothing()
    chosen, depths = (list(compress(every, usable)) for every in (chosen, depths))
    seen = seen[usable]
    gains = np.exp(estimate_gains(chosen, points).log_gains.mean(axis=1))
    photos = [
        StereoView(view, *spanned(depth), float(gain))
        for view, depth, gain in zip(chosen, depths, gains, strict=True)]
    median = float(np.median(np.concatenate(depths)))
    some = np.random.default_rng(0).permutation(len(points))[:COARSE_SAMPLE]
    partners = find_partners(
        [view.camera for view in chosen], points[some], seen[:, some], _NEIGHBOURS)
    total = 2 * len(photos)
    with evidence.progress.bar("stereo", total, unit="view") as bar:
        done, pace = count(1), deadline.keep_pace(total)

        def advance() -> None:
            bar.advance()
            pace(next(done))

        found = find_depths(photos, partners, NEAREST * median, advance)
    return _merge(chosen, found, points, SURFACE_CELL * median)


def _visibility(
    views: Sequence[TrainView], seen: Sequence[NDArray[np.int64]], points: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Returns which view sees which point [V, P]; where no tracks say so, those in its image."""
    if not any(map(len, seen)):
        return np.asarray(
            observe_points(points, [view.camera for view in views]).matrix.toarray() > 0)
    visible = np.zeros((len(views), len(points)), bool)
    for row, mine in zip(visible, seen, strict=True):
        row[mine] = True
    return visible


def _merge(
    views: Sequence[TrainView], depths: Sequence[NDArray[np.float32]],
    sparse: NDArray[np.float64], side: float,
) -> SurfacePoints:
    """Returns the mean place and colour in each cell of this side that two views find."""
    taken = np.unique(number_cells(sparse, side))
    parts = []
    for view, depth in zip(views, depths, strict=True):
        pixels = np.flatnonzero(depth > 0)
        where = unproject(view.camera, depth, pixels)
        cells, inverse = np.unique(number_cells(where, side), return_inverse=True)
        values = np.column_stack([where, view.image.reshape(-1, 3)[pixels], np.ones(len(pixels))])
        sums = np.stack([np.bincount(inverse, column, len(cells)) for column in values.T], axis=1)
        free = ~np.isin(cells, taken)
        parts.append((cells[free], sums[free]))
    every, of = np.unique(np.concatenate([cells for cells, _ in parts]), return_inverse=True)
    sums = np.concatenate([sums for _, sums in parts])
    total = np.stack([np.bincount(of, column, len(every)) for column in sums.T], axis=1)
    total = total[np.bincount(of, minlength=len(every)) >= LEAST_WITNESSES]
    means = total[:, :-1] / total[:, -1:]
    return SurfacePoints(means[:, :3], means[:, 3:].round().astype(np.uint8))


def surfaces_of(task: Task, evidence: Evidence, deadline: Deadline | None = None) -> SurfacePoints:
    """Returns the points that a run begins with besides the sparse ones.

    They fill what the sparse points leave of half of the cap: the rest goes where the error is.
    OutOfTime where a search for them would not end by the deadline.
    """
    config = task.schedule.config
    room = config.max_gaussians // 2 - len(evidence.points)
    if room <= 0:
        return SurfacePoints.nothing()
    return evidence.once(find_surfaces, deadline).at_most(room, config.seed)


def _attach(start: Start) -> None:
    found = surfaces_of(start.task, start.evidence)
    start.add_points(found.points, found.colors)


def _prepare(task: Task, evidence: Evidence, deadline: Deadline) -> None:
    found = surfaces_of(task, evidence, deadline)
    logger.info("%s points on surfaces besides %s of sfm", f"{len(found.points):,}",
                f"{len(evidence.points):,}")


# They gain in every room: no trial.
PART = Part("stereo", lambda _: Sign(on=True), attach=_attach, prepare=_prepare)
