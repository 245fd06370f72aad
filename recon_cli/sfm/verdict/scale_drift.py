"""How well the scale of one part of a model is known relative to another, in any graph of views.

A camera that turns in a narrow place ties what lies before it to what comes after by points that
show little of either scale; so do few points that photos far apart share. Matches agree then,
whatever the scale is: a walk of 30 m was trusted whose second half was a third too large. So the
information that all observations hold about the relative scale is computed, with every camera,
every point and the lenses free (the covariance of a bundle adjustment, Triggs et al. 2000, sections
6.1 and 9). Where that is little, the height of the cameras above the floor on both sides and the
matches across are the other witnesses.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_matrix, csc_matrix, csr_matrix, diags, hstack
from scipy.sparse.linalg import SuperLU, splu

from recon_cli.errors import format_count
from recon_cli.io.colmap_library import pycolmap
from recon_cli.scene.statistics import ROUNDING
from recon_cli.sfm.features.sphere import is_panorama, radian_px, ray_frames, unit_rays
from recon_cli.sfm.limits import LOSS_SCALE, MIN_FRAMES, MIN_STRETCH
from recon_cli.sfm.model_arrays import ModelArrays
from recon_cli.sfm.verdict import view_graph
from recon_cli.sfm.verdict.evidence import MatchEvidence
from recon_cli.sfm.verdict.floor_heights import (
    compare_heights,
    compare_sides,
    measure_heights,
    weigh_step,
)
from recon_cli.workspace.json_record import JsonRecord

# The scale of a stretch of a walk is that of its cameras' centres. It spans this share of the
# extent of all and of the usual depth, and MIN_STRETCH cameras: on a shorter one the camera stands
# still, or turns. Errors of a side of a graph that spans less count in proportion.
LEAST_EXTENT, LEAST_DEPTHS = 0.2, 0.5
# Errors of tracks and of the lens are shared by many observations and do not average out: scales
# were off by up to 20 times what independent errors would leave on a walk with a cheap lens, and by
# about as much as that in rendered rooms.
SHARED_ERRORS = 10.0
MAX_SCALE_ERROR = 0.05  # of a relative scale; see `tests/bench/bench_scale_breaks.py`
# Up to here a scale that nothing contradicts is an interval that is said, and no reason to cut.
MAX_SCALE_INTERVAL = 0.15
# It is contradicted where the cameras explain less than this share of the matches across it (wrong
# photos far apart .63 to .79, right ones .86 and more), and where the floor says that it is more
# likely off by 10% than by what is fine.
MIN_SURE_EXPLAINED = 0.85
MAX_FLOOR_STEP = (MAX_SCALE_ERROR + 0.1) / 2
# Cameras that lie nearer to each other than this share of a reach are at one place: centres have a
# precision of some 1e-12 of it, and what is known of a scale is divided by the distance.
DOUBTFUL = MAX_SCALE_ERROR / 3  # the floor is looked at from here on
_RIDGE = 1e-10  # times the diagonal: position, turn and scale of the model are free
POSE = 6  # unknowns of a camera: its turn, and its centre
_STEP = 1e-5  # of a number of the lens, as a share of it or, below 1, of 1

Rows = NDArray[np.int64]


@dataclass(frozen=True)
class ScaleCut(JsonRecord):
    """Where the relative scale of two parts of a model is known least."""

    error: float  # of the relative scale, as a share; one standard deviation
    before: str  # the last image before the cut, or the one beside it
    after: str  # the first one behind it
    sides: tuple[tuple[str, ...], tuple[str, ...]]  # names of the images, the smaller side first
    explained: float = 1.0  # share of the matches across it that the cameras explain
    # what the heights above the floor say the relative scale is off by, as a share
    off: float = 0.0
    # of the scales at both ends of the walk, likewise: the errors along it add up
    drift: float = 0.0

    @property
    def spread(self) -> float:
        """By how much lengths in two parts of the model may differ, as `error`."""
        return max(self.error, self.drift)

    @property
    def is_contradicted(self) -> bool:
        """Whether heights or matches speak against the relative scale that the model has."""
        return self.off > MAX_FLOOR_STEP or self.explained < MIN_SURE_EXPLAINED


def find_weakest_scale(
    model: pycolmap.Reconstruction, evidence: MatchEvidence, order: Rows | None = None, *,
    between: tuple[str, str] | None = None,
) -> ScaleCut | None:
    """Returns the cut of a model across which the relative scale is known least.

    Cuts are those of the tree of the images that share most points, and between images that follow
    each other where their `order`, rows of the evidence, is known; `between` limits them to those
    between two images. None where no side of a cut is long enough.
    """
    rows = np.flatnonzero(evidence.registered) if order is None else order
    rows = rows[evidence.points[rows] > 0]
    if len(rows) < MIN_FRAMES:
        return None
    names = [evidence.names[row] for row in rows]
    information = _Information(model, names)
    cuts = [] if between else list(
        _graph_cuts(information, evidence.shared[np.ix_(rows, rows)].astype(np.float64)))
    if order is not None:
        ends = between or (names[0], names[-1])
        first, last = sorted(map(names.index, ends))
        cuts += _walk_cuts(information, range(first + 1, last + 1))
    panoramas = all(is_panorama(camera) for camera in model.cameras.values())
    if (order is not None or panoramas) and max(
            (cut.error for cut in cuts), default=0.0) > DOUBTFUL:
        heights = measure_heights(model, names)
        cuts = [_ask_floor(cut, heights, panoramas) for cut in cuts]
    drift = 0.0 if order is None else _sum_drift(information)
    cuts.sort(key=lambda cut: -cut.error)
    return max((_describe(cut, evidence, rows, drift) for cut in cuts
                if cut is cuts[0] or cut.error > MAX_SCALE_ERROR),
               key=lambda cut: (not is_scale_known(cut), cut.error), default=None)


def is_scale_known(cut: ScaleCut | None) -> bool:
    """Returns whether no relative scale is too uncertain, or contradicted within its interval."""
    return cut is None or cut.error <= MAX_SCALE_ERROR or (
        cut.error <= MAX_SCALE_INTERVAL and not cut.is_contradicted)


def describe_scale(cut: ScaleCut) -> str:
    """Returns how well the scale is known across a cut, in a sentence."""
    if cut.error <= MAX_SCALE_ERROR:
        ends = f", both ends of the walk to {cut.drift:.1%}" if cut.drift else ""
        return ("Scale: the two sides of any cut are known to "
                f"{cut.error:.1%} or better relative to each other{ends}.")
    text = (f"The scale of {format_count(len(cut.sides[0]), 'camera')} on one side of the cut "
            f"between {cut.before} and {cut.after} relative to the "
            f"{format_count(len(cut.sides[1]), 'other')} is known to {cut.error:.0%} only")
    if is_scale_known(cut):
        return f"{text}, so that lengths on both sides may differ by as much."
    if cut.error > MAX_SCALE_INTERVAL:
        why = "the two sides share too few points that show depth"
    elif cut.off > MAX_FLOOR_STEP:
        why = f"by the heights above the floor it is off by {cut.off:.0%}"
    else:
        why = (f"the cameras explain {cut.explained:.0%} of the matches across it, and for less "
               f"certainty {MIN_SURE_EXPLAINED:.0%} are needed")
    return f"{text}, but {MAX_SCALE_ERROR:.0%} is needed: {why}."


@dataclass(frozen=True, eq=False)
class _Cut:
    """Two parts of the images, and how well their relative scale is known; rows as they are."""

    error: float  # as in ScaleCut
    side: NDArray[np.bool_]  # [F], the images before it
    parts: tuple[Rows, Rows]  # images of both sides that show their scales
    ends: tuple[int, int]  # the images next to each other across it
    off: float = 0.0  # what the floor says the relative scale is off by, as a share


def _graph_cuts(information: _Information, shared: view_graph.Weights) -> Iterator[_Cut]:
    """Yields the cuts of the tree that holds the images together by the points they share.

    To the smaller side belongs the image that ties it: one camera alone has no scale.
    """
    for cut in view_graph.tree_cuts(view_graph.spanning_forest(shared)):
        side = cut if 2 * np.count_nonzero(cut) <= len(cut) else ~cut
        ours, theirs = np.flatnonzero(side), np.flatnonzero(~side)
        end, other = np.unravel_index(np.argmax(shared[np.ix_(ours, theirs)]), (
            len(ours), len(theirs)))
        both = np.append(ours, theirs[other])
        share = information.reached(both, theirs)
        if share < ROUNDING:  # the same photo twice: no scale, and rounding errors in its place
            continue
        yield _Cut(min(1.0, share) * information.error(theirs, both), side, (ours, theirs),
                   (int(ours[end]), int(theirs[other])))


def _walk_cuts(information: _Information, places: Iterable[int]) -> Iterator[_Cut]:
    """Yields the cuts of a walk before its images at some places, which have stretches of it."""
    count = len(information.centers)
    for place in places:
        before = information.stretch(np.arange(place)[::-1], np.arange(place, count))
        behind = information.stretch(np.arange(place, count), np.arange(place))
        if before is not None and behind is not None:
            yield _Cut(information.error(before, behind), np.arange(count) < place,
                       (before, behind), (place - 1, place))


def _ask_floor(cut: _Cut, heights: NDArray[np.float64], panoramas: bool) -> _Cut:
    """Returns a cut once the heights [F, 2] of its cameras are known, too."""
    if panoramas:
        step = compare_sides(heights[cut.parts[0]], heights[cut.parts[1]])
    else:
        changes = np.flatnonzero(np.diff(cut.side)) + 1
        step = compare_heights(heights, int(changes[0])) if len(changes) == 1 else None
    if step is None:
        return cut
    error, off = weigh_step(cut.error, step)
    return replace(cut, error=error, off=off)


def _describe(cut: _Cut, evidence: MatchEvidence, rows: Rows, drift: float) -> ScaleCut:
    """Returns a cut by the names of its images, and how far the matches across it confirm it."""
    sides = [tuple(evidence.names[row] for row in rows[side]) for side in (cut.side, ~cut.side)]
    first, second = sorted(sides, key=len)
    before, after = (evidence.names[rows[end]] for end in cut.ends)
    return ScaleCut(
        cut.error, before, after, (first, second),
        _explained_across(evidence, *(rows[part] for part in cut.parts)), cut.off, drift)


def _explained_across(evidence: MatchEvidence, ours: Rows, theirs: Rows) -> float:
    """Returns the share of the matches between images of two parts that the cameras explain."""
    sides = np.zeros(len(evidence.names), np.int64)
    sides[ours], sides[theirs] = 1, 2
    across = sides[evidence.pairs].prod(axis=1) == 2
    matches = int(evidence.matches[across].sum())
    return float(evidence.explained[across].sum()) / matches if matches else 1.0


def _sum_drift(information: _Information) -> float:
    """Returns how well the relative scale of both ends of a walk is known.

    The errors from one stretch to the next add up by their squares. Loops that the walk closes are
    given no credit: what many observations share is off alike, wherever the walk comes back to.
    """
    stretches, rest = [], np.arange(len(information.centers))
    while len(rest) and (stretch := information.stretch(rest, rest)) is not None:
        stretches.append(stretch)
        rest = rest[len(stretch):]
    return float(np.linalg.norm([information.error(*both) for both in pairwise(stretches)]))


class _Information:
    """What the observations of a model say about its cameras, all points being free."""

    def __init__(self, model: pycolmap.Reconstruction, order: Sequence[str]) -> None:
        seen = Observations(model, order)
        self.centers, self._depths = seen.centers, seen.depths
        self._reach = max(  # of a stretch, the diagonal of the box around its cameras
            LEAST_EXTENT * float(np.linalg.norm(np.ptp(seen.centers, axis=0))),
            LEAST_DEPTHS * float(np.median(seen.depths)), 1e-300)
        self._factor, self._variance = factorise(seen)

    def error(self, before: Rows, behind: Rows) -> float:
        """Returns how well the relative scale of two stretches is known, as `ScaleCut.error`."""
        change = self._scale_of(behind) - self._scale_of(before)
        variance = self._variance * float(change @ self._factor.solve(change))
        return SHARED_ERRORS * float(np.sqrt(max(variance, 0.0)))

    def reached(self, rows: Rows, others: Rows) -> float:
        """Returns what some cameras span over what a stretch must, in units of what they see.

        Where one side shrank, so did its points: it is measured by itself.
        """
        return float(self._spans(rows)[-1]) / self._reach / self._shrinkage(rows, others)

    def stretch(self, rows: Rows, others: Rows) -> Rows | None:
        """Returns as many of the cameras, from the first on, as show the scale of a stretch.

        None where all of them span too little, or they are fewer than MIN_STRETCH.
        """
        spans = self._spans(rows)
        for reach in (self._reach, self._reach * self._shrinkage(rows, others)):
            if len(rows) >= MIN_STRETCH and spans[-1] >= reach:
                return rows[:max(int(np.argmax(spans >= reach)) + 1, MIN_STRETCH)]
        return None

    def _spans(self, rows: Rows) -> NDArray[np.float64]:
        """Returns the diagonal of the box around the first 1, 2, ... of some cameras."""
        centers = self.centers[rows]
        low, high = np.minimum.accumulate(centers), np.maximum.accumulate(centers)
        return np.asarray(np.linalg.norm(high - low, axis=1))

    def _shrinkage(self, rows: Rows, others: Rows) -> float:
        """Returns the depth that cameras see over that of others, where it is less."""
        own, other = (float(np.median(self._depths[side])) for side in (rows, others))
        return min(1.0, max(own, 1e-300) / max(other, 1e-300))

    def _scale_of(self, rows: Rows) -> NDArray[np.float64]:
        """Returns how the log of the scale of some cameras changes with each unknown, [U].

        The scale is that of the similarity that fits their centres best.
        """
        change = np.zeros((len(self.centers), POSE))
        arms = self.centers[rows] - self.centers[rows].mean(axis=0)
        change[rows, 3:] = arms / (arms**2).sum()
        return np.append(change.ravel(), np.zeros(self._factor.shape[0] - change.size))


class Observations:
    """O observations of P points by F images, in the images' order, with their derivatives."""

    def __init__(self, model: pycolmap.Reconstruction, order: Sequence[str]) -> None:
        arrays = ModelArrays.from_model(model, order)
        places, frames, by_lens = [], [], []
        most = max(len(image.camera.params) for image in arrays.images)
        for row, image in enumerate(arrays.images):
            pixels = arrays.xy[arrays.observed(row)]
            if is_panorama(image.camera):  # an error is looked at in the plane across its ray
                frames.append(ray_frames(unit_rays(image.camera, pixels)))
                places.append(np.zeros((len(pixels), 2)))
                by_lens.append(np.zeros((len(pixels), 2, most)))
                continue
            frames.append(np.tile(np.eye(3), (len(pixels), 1, 1)))
            places.append(_undistort(image.camera, pixels))
            by_lens.append(_derive_by_lens(image.camera, pixels, most))
        known, self.point = np.unique(arrays.point, return_inverse=True)
        self.centers, self.image, self.points = arrays.centers, arrays.image, len(known)
        lenses = np.array([image.camera_id for image in arrays.images])[self.image]
        cameras, self.lens = np.unique(lenses, return_inverse=True)
        self.lenses, self.by_lens = len(cameras), np.concatenate(by_lens)
        focals = np.array([radian_px(image.camera) for image in arrays.images])
        self._derive(arrays.viewmats[self.image, :3, :3],
                     arrays.points[arrays.point] - self.centers[self.image],
                     np.concatenate(places), focals[self.image, None], np.concatenate(frames))

    def _derive(
        self, rotations: NDArray[np.float64], rays: NDArray[np.float64],
        places: NDArray[np.float64], focal: NDArray[np.float64], frames: NDArray[np.float64],
    ) -> None:
        """Sets errors [O, 2] in pixels and their derivatives, weighted by the loss.

        By the camera's turn and centre [O, 2, 6], the point [O, 2, 3], the numbers of the lens.
        `frames` [O, 3, 3] turn the axes of the camera to those that an error is looked at in.
        """
        local = np.einsum("oij,oj->oi", rotations, rays)
        x, y, z = np.einsum("oij,oj->oi", frames, local).T
        self.depths = np.array([  # [F], usual depth of the points that an image shows
            np.median(z[self.image == row]) for row in range(len(self.centers))])
        z = np.where(np.abs(z) > 1e-9, z, 1e-9)
        found = np.stack([x / z, y / z], axis=1)
        by_local = np.zeros((len(rays), 2, 3))
        by_local[:, 0, 0] = by_local[:, 1, 1] = focal[:, 0] / z
        by_local[:, :, 2] = -focal * found / z[:, None]
        by_local = by_local @ frames
        turn = np.cross(local[:, None], np.eye(3)[None]).transpose(0, 2, 1)
        by_point = by_local @ rotations
        # a bent lens has no ray for some pixels
        has_ray = np.asarray(np.isfinite(places).all(axis=1))
        sizes = np.linalg.norm(np.where(has_ray[:, None], focal * (found - places), 0), axis=1)
        scale = LOSS_SCALE * max(float(sizes.sum() / max(has_ray.sum(), 1)), 1e-9)
        weights = has_ray / (1 + (sizes / scale) ** 2)
        root = np.sqrt(weights)[:, None, None]
        self.by_camera = root * np.concatenate([-by_local @ turn, -by_point], axis=2)
        self.by_point = root * by_point
        self.by_lens = -root * focal[:, :, None] * self.by_lens
        free = 2 * int(has_ray.sum()) - POSE * len(self.centers) - 3 * self.points
        self.variance = float(weights @ sizes**2) / max(free, 1)  # pixels squared


def _undistort(
    camera: pycolmap.Camera, pixels: NDArray[np.float64]
) -> NDArray[np.float64]:  # [K, 2]
    return np.asarray(camera.cam_from_img(pixels), np.float64).reshape(-1, 2)


def _derive_by_lens(
    camera: pycolmap.Camera, pixels: NDArray[np.float64], count: int
) -> NDArray[np.float64]:
    """Returns how undistorted pixels change with each number of the lens, [K, 2, count]."""
    changes = np.zeros((len(pixels), 2, count))
    places = _undistort(camera, pixels)
    for number, value in enumerate(camera.params):
        step = _STEP * max(1.0, abs(value))
        other = pycolmap.Camera(model=camera.model_name, width=camera.width, height=camera.height,
                                params=camera.params)
        other.params[number] += step
        changes[:, :, number] = (_undistort(other, pixels) - places) / step
    return np.nan_to_num(changes)  # a bent lens has no direction for some pixels


def factorise(seen: Observations) -> tuple[SuperLU, float]:
    """Returns the factors of the normal equations of the cameras, and the variance of an error."""
    count, points = len(seen.centers), seen.points
    cameras = hstack([
        _blocks(seen.by_camera, seen.image, count),
        _blocks(seen.by_lens, seen.lens, seen.lenses)], format="csr")
    places = _blocks(seen.by_point, seen.point, points)
    own = np.zeros((points, 3, 3))
    np.add.at(own, seen.point, np.einsum("oki,okj->oij", seen.by_point, seen.by_point))
    own += 1e-12 * np.trace(own, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-300 * np.eye(3)
    inverse = bsr_matrix((np.linalg.inv(own), np.arange(points), np.arange(points + 1)),
                         shape=(3 * points, 3 * points)).tocsr()
    both = (cameras.T @ places).tocsr()
    reduced = csc_matrix(cameras.T @ cameras - both @ inverse @ both.T)
    diagonal = reduced.diagonal()  # zero where a lens has fewer numbers than others
    ridge = diags(np.where(diagonal > 0, _RIDGE * diagonal, 1.0), format="csc")
    return splu(csc_matrix(reduced + ridge), permc_spec="MMD_AT_PLUS_A",
                options={"SymmetricMode": True}), seen.variance


def _blocks(
    derivatives: NDArray[np.float64],  # [O, 2, K]
    owner: NDArray[np.int64],  # [O], whose unknowns they are
    count: int,
) -> csr_matrix:  # [2 O, K count]
    size = derivatives.shape[2]
    rows = np.repeat(np.arange(2 * len(owner)), size)
    columns = np.repeat(size * owner, 2 * size) + np.tile(np.arange(size), 2 * len(owner))
    return csr_matrix((derivatives.ravel(), (rows, columns)),
                      shape=(2 * len(owner), size * count))
