"""How well the scale of one stretch of a walk is known relative to the next.

A camera that turns in a narrow place ties what lies before it to what comes after by points that
show little of either scale. Matches agree then, whatever the scale is: a walk of 30 m was trusted
whose second half was a third too large. So the information that all observations hold about the
relative scale is computed, with every camera, every point and the focal length free (the covariance
of a bundle adjustment, Triggs et al. 2000, sections 6.1 and 9). Where that is little, the height of
the cameras above the floor on both sides is the other witness.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_matrix, csc_matrix, csr_matrix, eye, hstack
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import SuperLU, splu

from recon_cli.io.colmap_library import pycolmap
from recon_cli.sfm.floor_heights import SPREAD, compare_heights, measure_heights
from recon_cli.sfm.limits import LOSS_SCALE, MIN_PAIR_INLIERS
from recon_cli.sfm.sphere import is_panorama, radian_px, ray_frames, unit_rays
from recon_cli.workspace.json_record import JsonRecord

# The scale of a stretch is that of its cameras' centres. It spans this share of the extent of all
# and of the usual depth, and so many cameras: on a shorter one the camera stands still, or turns.
LEAST_EXTENT, LEAST_DEPTHS, LEAST_CAMERAS = 0.2, 0.5, 10
# Errors of tracks and of the lens are shared by many observations and do not average out: scales
# were off by up to 20 times what independent errors would leave on a walk with a cheap lens, and by
# about as much as that in rendered rooms.
SHARED_ERRORS = 10.0
MAX_SCALE_ERROR = 0.05  # of a relative scale; see `tests/bench/bench_scale_breaks.py`
DOUBTFUL = MAX_SCALE_ERROR / 3  # the floor is looked at from here on
_RIDGE = 1e-10  # times the diagonal: position, turn and scale of the model are free
_POSE = 6  # unknowns of a camera: its turn, and its centre


@dataclass(frozen=True)
class ScaleCut(JsonRecord):
    """Where the relative scale of the two parts of a walk is known least."""

    error: float  # of the relative scale, as a share; one standard deviation
    before: str  # the last image before the cut
    after: str  # the first one behind it
    sides: tuple[tuple[str, ...], tuple[str, ...]]  # names of the images, the smaller side first


def find_weakest_scale(
    model: pycolmap.Reconstruction, order: Sequence[str], *,
    between: tuple[str, str] | None = None,
) -> ScaleCut | None:
    """Returns the cut of a walk across which the relative scale is known least.

    `order` are names of images with a camera as they were taken; `between` limits the cuts to those
    between two of them. None where no stretch before a cut and none behind it is long enough.
    """
    if len(order) < 2 * LEAST_CAMERAS:
        return None
    information = _Information(model, order)
    first, last = (0, len(order)) if between is None else sorted(map(list(order).index, between))
    errors = {place: information.error(*stretches) for place in range(first + 1, last + 1)
              if (stretches := _stretches(information, place)) is not None}
    if not errors:
        return None
    if max(errors.values()) > DOUBTFUL:
        heights = measure_heights(model, order)
        errors = {place: _ask_floor(error, compare_heights(heights, place))
                  for place, error in errors.items()}
    place = max(errors, key=lambda each: errors[each])
    parts = tuple(order[:place]), tuple(order[place:])
    first_side, second_side = sorted(parts, key=len)
    return ScaleCut(errors[place], order[place - 1], order[place],
                    (first_side, second_side))


def find_hinge(
    model: pycolmap.Reconstruction, names: Sequence[str],
    shared: NDArray[np.int64],  # [F, F], points that two of the images both see
) -> ScaleCut | None:
    """Returns the image that alone joins two groups, where their relative scale is known least.

    Panoramas that stand in neighbouring rooms may meet in one of them. Then each group has a scale
    of its own, unless points of both are the same. None where no image is a hinge.
    """
    information, worst = _Information(model, names), None
    for hinge in range(len(names)):
        rest = np.delete(np.arange(len(names)), hinge)
        links = csr_matrix(shared[np.ix_(rest, rest)] >= MIN_PAIR_INLIERS)
        count, groups = connected_components(links, directed=False)
        for group in range(count if count > 1 else 0):
            side, others = rest[groups == group], rest[groups != group]
            error = information.error(np.append(side, hinge), np.append(others, hinge))
            if worst is None or error > worst.error:
                parts = [tuple(names[row] for row in rows)
                         for rows in (side, np.append(others, hinge))]
                first, second = sorted(parts, key=len)
                worst = ScaleCut(error, names[int(side[0])], names[hinge], (first, second))
    return worst


def is_scale_known(cut: ScaleCut | None) -> bool:
    """Returns whether no relative scale is less certain than MAX_SCALE_ERROR."""
    return cut is None or cut.error <= MAX_SCALE_ERROR


def _ask_floor(error: float, step: float | None) -> float:
    """Returns the error of a relative scale once the heights above the floor are known, too.

    Both are taken for normal: what is most likely wrong then, or its deviation if that is more.
    """
    if step is None:
        return error
    share = error**2 / (error**2 + SPREAD**2)
    return max(share * abs(step), float(np.sqrt(1 - share)) * error)


def _stretches(
    information: _Information, place: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]] | None:
    """Returns the cameras of the stretch before a place in the walk and of that behind it."""
    centers = information.centers
    before = _count_until(centers[:place][::-1], information.reach)
    behind = _count_until(centers[place:], information.reach)
    if before is None or behind is None:
        return None
    return np.arange(place - before, place), np.arange(place, place + behind)


def _count_until(centers: NDArray[np.float64], need: float) -> int | None:
    """Returns how many of the cameras [F, 3], from the first on, span a box of a diagonal `need`.

    None where all of them span less, or they are fewer than LEAST_CAMERAS.
    """
    low, high = np.minimum.accumulate(centers), np.maximum.accumulate(centers)
    wide = np.flatnonzero(np.linalg.norm(high - low, axis=1) >= need)
    if not len(wide) or len(centers) < LEAST_CAMERAS:
        return None
    return max(int(wide[0]) + 1, LEAST_CAMERAS)


class _Information:
    """What the observations of a model say about its cameras, all points being free."""

    def __init__(self, model: pycolmap.Reconstruction, order: Sequence[str]) -> None:
        seen = _Observations(model, order)
        self.centers = seen.centers
        self.reach = max(  # of a stretch, the diagonal of the box around its cameras
            LEAST_EXTENT * float(np.linalg.norm(np.ptp(seen.centers, axis=0))),
            LEAST_DEPTHS * seen.depth)
        self._factor, self._variance = _factorise(seen)

    def error(self, before: NDArray[np.int64], behind: NDArray[np.int64]) -> float:
        """Returns how well the relative scale of two stretches is known, as `ScaleCut.error`."""
        change = _scale_of(self.centers, behind) - _scale_of(self.centers, before)
        variance = self._variance * float(change @ self._factor.solve(change))
        return SHARED_ERRORS * float(np.sqrt(max(variance, 0.0)))


def _scale_of(centers: NDArray[np.float64], rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """Returns how the log of the scale of some cameras changes with each unknown, [U].

    The scale is that of the similarity that fits their centres best.
    """
    change = np.zeros((len(centers), _POSE))
    arms = centers[rows] - centers[rows].mean(axis=0)
    change[rows, 3:] = arms / (arms**2).sum()
    return np.append(change.ravel(), 0.0)


class _Observations:
    """O observations of P points by F images, in the images' order, with their derivatives."""

    def __init__(self, model: pycolmap.Reconstruction, order: Sequence[str]) -> None:
        images = [model.find_image_with_name(name) for name in order]
        self.centers = np.array([image.projection_center() for image in images])  # [F, 3]
        rotations = np.array([image.cam_from_world().rotation.matrix() for image in images])
        rows, numbers, places, focals, frames = [], [], [], [], []
        for row, image in enumerate(images):
            spots = [spot for spot in image.points2D if spot.has_point3D()]
            rows.append(np.full(len(spots), row))
            numbers += [spot.point3D_id for spot in spots]
            pixels = np.array([spot.xy for spot in spots]).reshape(-1, 2)
            focals.append(np.full(len(spots), radian_px(image.camera)))
            if is_panorama(image.camera):  # an error is looked at in the plane across its ray
                frames.append(ray_frames(unit_rays(image.camera, pixels)))
                places.append(np.zeros((len(spots), 2)))
                continue
            frames.append(np.tile(np.eye(3), (len(spots), 1, 1)))
            places.append(np.asarray(image.camera.cam_from_img(pixels)).reshape(-1, 2))
        known, point = np.unique(np.array(numbers, np.int64), return_inverse=True)
        points = np.array([model.point3D(int(number)).xyz for number in known]).reshape(-1, 3)
        self.image, self.point, self.points = np.concatenate(rows), point, len(known)
        self._derive(rotations[self.image], points[point] - self.centers[self.image],
                     np.concatenate(places), np.concatenate(focals)[:, None],
                     np.concatenate(frames))

    def _derive(
        self, rotations: NDArray[np.float64], rays: NDArray[np.float64],
        places: NDArray[np.float64], focal: NDArray[np.float64], frames: NDArray[np.float64],
    ) -> None:
        """Sets errors [O, 2] in pixels and their derivatives, weighted by the loss.

        By the camera's turn and centre [O, 2, 6], the point [O, 2, 3], the log of the focal length.
        `frames` [O, 3, 3] turn the axes of the camera to those that an error is looked at in.
        """
        local = np.einsum("oij,oj->oi", rotations, rays)
        x, y, z = np.einsum("oij,oj->oi", frames, local).T
        self.depth = float(np.median(z)) if len(z) else 0.0  # usual depth of the points
        z = np.where(np.abs(z) > 1e-9, z, 1e-9)
        found = np.stack([x / z, y / z], axis=1)
        by_local = np.zeros((len(rays), 2, 3))
        by_local[:, 0, 0] = by_local[:, 1, 1] = focal[:, 0] / z
        by_local[:, :, 2] = -focal * found / z[:, None]
        by_local = by_local @ frames
        turn = np.cross(local[:, None], np.eye(3)[None]).transpose(0, 2, 1)
        by_point = by_local @ rotations
        errors = focal * (found - places)
        sizes = np.linalg.norm(errors, axis=1)
        scale = LOSS_SCALE * max(float(sizes.mean()), 1e-9)
        weights = 1 / (1 + (sizes / scale) ** 2)
        root = np.sqrt(weights)[:, None, None]
        self.by_camera = root * np.concatenate([-by_local @ turn, -by_point], axis=2)
        self.by_point, self.by_focal = root * by_point, root * (focal * found)[:, :, None]
        free = 2 * len(rays) - _POSE * len(self.centers) - 3 * self.points
        self.variance = float(weights @ sizes**2) / max(free, 1)  # pixels squared


def _factorise(seen: _Observations) -> tuple[SuperLU, float]:
    """Returns the factors of the normal equations of the cameras, and the variance of an error."""
    count, points = len(seen.centers), seen.points
    cameras = hstack([
        _blocks(seen.by_camera, seen.image, count),
        csr_matrix(seen.by_focal.reshape(-1, 1))], format="csr")
    places = _blocks(seen.by_point, seen.point, points)
    own = np.zeros((points, 3, 3))
    np.add.at(own, seen.point, np.einsum("oki,okj->oij", seen.by_point, seen.by_point))
    own += 1e-12 * np.trace(own, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-300 * np.eye(3)
    inverse = bsr_matrix((np.linalg.inv(own), np.arange(points), np.arange(points + 1)),
                         shape=(3 * points, 3 * points)).tocsr()
    both = (cameras.T @ places).tocsr()
    reduced = csc_matrix(cameras.T @ cameras - both @ inverse @ both.T)
    ridge = _RIDGE * eye(reduced.shape[0], format="csc").multiply(
        np.maximum(reduced.diagonal(), 1e-300))
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
