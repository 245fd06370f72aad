"""What a database of matches and a finished model say about the same images, as plain arrays.

Matches are read here, once, and compared with the poses; the checks are arithmetic on the result.
The database is opened by pycolmap alone: Python's SQLite must not touch a file that pycolmap has
open in the same process (see `database`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from recon_cli.io.colmap_library import pycolmap
from recon_cli.sfm import database as database_file
from recon_cli.sfm.features.sphere import (
    epipolar_errors,
    is_panorama,
    radian_px,
    ray_frames,
    unit_rays,
)
from recon_cli.sfm.limits import MAX_ERROR_PX, MIN_PAIR_EXPLAINED
from recon_cli.sfm.model_arrays import ModelArrays

# It is explained by a point seen within this multiple of the model's mean error of it, within these
# pixels: sharp videos come to .2 and shaken ones to 1. See `tests/bench/bench_verdict.py`.
USUAL_OFFSET, OFFSETS = 6.0, (2.0, MAX_ERROR_PX)
# Of the depth that a twentieth of an image's points lie within: none are nearer.
NEAREST_DEPTH = 0.3


@dataclass(frozen=True)
class MatchEvidence:
    """Verified matches, and how many of them a model confirms; images are indices into names."""

    names: tuple[str, ...]  # of all N images that were given to the mapper
    registered: NDArray[np.bool_]  # [N], images that have a camera
    centers: NDArray[np.float64]  # [N, 3] of the cameras, in the model's units; NaN without one
    keypoints: NDArray[np.int64]  # [N], features found in each image
    visible: NDArray[np.bool_]  # [N, M], which points of the model each image sees
    tried: NDArray[np.bool_]  # [N, N], symmetric: pairs that were matched, successfully or not
    pairs: NDArray[np.int64]  # [P, 2], verified pairs of images, first < second, sorted
    matches: NDArray[np.int64]  # [P], verified matches of each pair
    # [P], those within MAX_ERROR_PX of the epipolar lines of the poses; zero where a camera is
    # missing
    agreeing: NDArray[np.int64]
    explained: NDArray[np.int64]  # [P], those that the poses explain; likewise
    traced: NDArray[np.int64]  # [P], matches of which both keypoints show a point of the model
    joined: NDArray[np.int64]  # [P], those of them that show one and the same point
    positions: NDArray[np.float64]  # [M, 3] of the points
    depths: NDArray[np.float64]  # [N], usual depth of the points in each image; NaN without any
    # for pairs, by row, whose matches the poses contradict: the points that both keypoints of a
    # match show, [K, 2], in the order of the pair's images
    doubled: Mapping[int, NDArray[np.int64]]

    @property
    def placed(self) -> NDArray[np.bool_]:
        """Which pairs have a camera for both of their images, [P] bool."""
        return np.asarray(self.registered[self.pairs].all(axis=1))

    @cached_property
    def points(self) -> NDArray[np.int64]:
        """Points of the model that each image sees, [N]."""
        return np.asarray(self.visible.sum(axis=1), np.int64)

    @cached_property
    def shared(self) -> NDArray[np.int64]:
        """Points that two images both see, [N, N], zero on the diagonal."""
        visible = csr_matrix(self.visible, dtype=np.int64)
        shared = np.asarray((visible @ visible.T).todense())
        np.fill_diagonal(shared, 0)
        return shared


def gather_evidence(
    model: pycolmap.Reconstruction, database: Path, names: Sequence[str]
) -> MatchEvidence:
    """Returns what database and model say about images; ValueError if their names disagree."""
    row = {name: index for index, name in enumerate(names)}
    arrays = ModelArrays.from_model(model)
    if unknown := sorted(set(arrays.names) - set(row)):
        raise ValueError(f"the model holds other images: {unknown}")
    rows = np.array([row[name] for name in arrays.names], np.int64)
    placed = dict(zip(rows.tolist(), arrays.images, strict=True))
    matched = database_file.matched_ids(database)  # before pycolmap opens it
    with pycolmap.Database.open(database) as opened:
        ids = {image.image_id: row[image.name] for image in opened.read_all_images()
               if image.name in row}
        if len(ids) != len(names):
            raise ValueError(f"{database} holds {len(ids)} of {len(names)} images")
        keypoints = {ids[i]: opened.read_keypoints(i)[:, :2].astype(np.float64) for i in ids}
        pairs, matches = _read_verified_pairs(opened, ids)
    tried = np.zeros((len(names), len(names)), np.bool_)
    for first, second in matched:
        if first in ids and second in ids:
            tried[ids[first], ids[second]] = tried[ids[second], ids[first]] = True
    centers = np.full((len(names), 3), np.nan)
    centers[rows] = arrays.centers
    visible = np.zeros((len(names), len(arrays.points)), np.bool_)
    visible[rows[arrays.image], arrays.point] = True
    shown = {index: np.full(len(keypoints[index]), -1) for index in placed}
    for at, index in enumerate(placed):
        own = arrays.observed(at)
        shown[index][arrays.keypoint[own]] = arrays.point[own]
    traced, joined = _count_joined(shown, pairs, matches)
    depths = {index: arrays.depths(at) for at, index in enumerate(placed)}
    offset = float(np.clip(USUAL_OFFSET * model.compute_mean_reprojection_error(), *OFFSETS))
    explained = _count_explained(placed, depths, offset, keypoints, pairs, matches)
    return MatchEvidence(
        names=tuple(names), centers=centers, visible=visible, tried=tried,
        registered=np.isin(np.arange(len(names)), list(placed)),
        keypoints=np.array([len(keypoints[index]) for index in range(len(names))], np.int64),
        pairs=np.array(pairs, np.int64).reshape(-1, 2),
        matches=np.array([len(rows) for rows in matches], np.int64),
        agreeing=_count_agreeing(placed, keypoints, pairs, matches),
        explained=explained, traced=traced, joined=joined, positions=arrays.points,
        depths=np.array([
            np.median(depths[index]) if len(depths.get(index, ())) else np.nan
            for index in range(len(names))]),
        doubled=_find_doubled(shown, pairs, matches, explained))


def _read_verified_pairs(
    opened: pycolmap.Database, ids: Mapping[int, int]
) -> tuple[list[tuple[int, int]], list[NDArray[np.uint32]]]:
    """Returns the verified pairs, sorted, and which keypoints of each match, [M, 2]."""
    inliers = {}
    for pair_id, geometry in zip(*opened.read_two_view_geometries(), strict=True):
        first, second = pycolmap.pair_id_to_image_pair(pair_id)
        rows = geometry.inlier_matches
        if not len(rows) or first not in ids or second not in ids:
            continue
        if ids[first] < ids[second]:
            inliers[ids[first], ids[second]] = rows
        else:
            inliers[ids[second], ids[first]] = rows[:, ::-1]
    order = sorted(inliers)
    return order, [inliers[pair] for pair in order]


def explained_matches(
    first: pycolmap.Image, ours: NDArray[np.float64],  # [M, 2] pixels
    second: pycolmap.Image, theirs: NDArray[np.float64],  # [M, 2] pixels
    least_depth: float,  # in the first camera; zero if any will do
    offset: float,  # pixels
) -> NDArray[np.bool_]:  # [M]
    """Returns which matches two cameras explain.

    A match is explained if a point at some depth, not nearer than `least_depth`, is seen within
    `offset` of it. An epipolar line alone does not tell a pattern that repeats along it.
    """
    motion = second.cam_from_world() * first.cam_from_world().inverse()
    if is_panorama(first.camera) or is_panorama(second.camera):
        return _explained_on_sphere(first, ours, second, theirs, least_depth, offset)
    at_infinity = lift_rays(first.camera, ours) @ motion.rotation.matrix().T
    target = np.asarray(second.camera.cam_from_img(theirs))
    inverse = inverse_depths(at_infinity, target, motion.translation)
    most = 1 / least_depth if least_depth > 0 else np.inf
    points = at_infinity + np.clip(inverse, 0, most)[:, None] * motion.translation
    places = points[:, :2] / np.where(points[:, 2:] > 0, points[:, 2:], np.nan)
    errors = np.linalg.norm(places - target, axis=1) * second.camera.mean_focal_length()
    return np.asarray(errors <= offset)  # NaN, behind the camera, does not agree


def _explained_on_sphere(
    first: pycolmap.Image, ours: NDArray[np.float64], second: pycolmap.Image,
    theirs: NDArray[np.float64], least_depth: float, offset: float,
) -> NDArray[np.bool_]:  # [M]
    """Does so where a camera is that of a panorama: each target is the middle of its own plane."""
    motion = second.cam_from_world() * first.cam_from_world().inverse()
    rays = unit_rays(first.camera, ours)
    if not is_panorama(first.camera):  # their depth is that along the axis of the camera
        rays = rays / rays[:, 2:]
    frames = ray_frames(unit_rays(second.camera, theirs))
    at_infinity = np.einsum("mij,mj->mi", frames, rays @ motion.rotation.matrix().T)
    shift = frames @ motion.translation
    inverse = -(at_infinity[:, :2] * shift[:, :2]).sum(axis=1) / np.maximum(
        (shift[:, :2]**2).sum(axis=1), 1e-12)
    most = 1 / least_depth if least_depth > 0 else np.inf
    points = at_infinity + np.clip(inverse, 0, most)[:, None] * shift
    places = points[:, :2] / np.where(points[:, 2:] > 0, points[:, 2:], np.nan)
    return np.asarray(np.linalg.norm(places, axis=1) * radian_px(second.camera) <= offset)


def lift_rays(camera: pycolmap.Camera, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the rays through pixels [M, 2] of a camera, [M, 3], of depth 1."""
    return np.column_stack([np.asarray(camera.cam_from_img(pixels)), np.ones(len(pixels))])


def inverse_depths(
    rays: NDArray[np.float64],  # [M, 3] of the first camera, turned into the second
    target: NDArray[np.float64],  # [M, 2] in the second, at depth 1
    translation: NDArray[np.float64],  # [3]
) -> NDArray[np.float64]:  # [M]
    """Returns 1 / depth in the first camera at which ray + translation / depth meets the target."""
    offset = rays[:, :2] - target * rays[:, 2:]
    slope = translation[:2] - target * translation[2]
    return np.asarray(-(offset * slope).sum(axis=1) / np.maximum((slope**2).sum(axis=1), 1e-12))


def nearest_depth(depths: NDArray[np.float64]) -> float:
    """Returns a depth that no point is nearer than, from those of many points; 0 without any."""
    return NEAREST_DEPTH * float(np.percentile(depths, 5)) if len(depths) else 0.0


def _count_agreeing(
    placed: Mapping[int, pycolmap.Image],
    keypoints: Mapping[int, NDArray[np.float64]],
    pairs: Sequence[tuple[int, int]],
    matches: Sequence[NDArray[np.uint32]],
) -> NDArray[np.int64]:
    """Returns how many matches of each pair agree with the poses, [P]."""
    spherical = any(is_panorama(image.camera) for image in placed.values())
    lift = unit_rays if spherical else pycolmap.Camera.cam_from_img
    rays = {index: np.asarray(lift(image.camera, keypoints[index]))
            for index, image in placed.items()}
    agreeing = np.zeros(len(pairs), np.int64)
    for pair, ((first, second), rows) in enumerate(zip(pairs, matches, strict=True)):
        if first not in placed or second not in placed:
            continue
        image, other = placed[first], placed[second]
        motion = other.cam_from_world() * image.cam_from_world().inverse()
        focal = (radian_px(image.camera) + radian_px(other.camera)) / 2
        if spherical:
            errors = epipolar_errors(
                rays[first][rows[:, 0]], rays[second][rows[:, 1]], motion)
            agreeing[pair] = len(rows) - np.count_nonzero(errors > MAX_ERROR_PX / focal)
            continue
        essential = pycolmap.essential_matrix_from_pose(motion)
        squares = np.array(pycolmap.compute_squared_sampson_error(
            rays[first][rows[:, 0]], rays[second][rows[:, 1]], essential))
        # Not "<": two cameras in one place have no epipolar lines (NaN) and contradict nothing.
        agreeing[pair] = len(rows) - np.count_nonzero(squares > (MAX_ERROR_PX / focal) ** 2)
    return agreeing


def _count_explained(
    placed: Mapping[int, pycolmap.Image],
    depths: Mapping[int, NDArray[np.float64]],  # of the points that an image shows
    offset: float,  # pixels
    keypoints: Mapping[int, NDArray[np.float64]],
    pairs: Sequence[tuple[int, int]],
    matches: Sequence[NDArray[np.uint32]],
) -> NDArray[np.int64]:
    """Returns how many matches of each pair the poses explain, [P]."""
    near = {index: nearest_depth(own) for index, own in depths.items()}
    explained = np.zeros(len(pairs), np.int64)
    for pair, ((first, second), rows) in enumerate(zip(pairs, matches, strict=True)):
        if first in placed and second in placed:
            explained[pair] = np.count_nonzero(explained_matches(
                placed[first], keypoints[first][rows[:, 0]],
                placed[second], keypoints[second][rows[:, 1]], near[first], offset))
    return explained


def _count_joined(
    shown: Mapping[int, NDArray[np.int64]],  # which point each keypoint of an image shows, or -1
    pairs: Sequence[tuple[int, int]],
    matches: Sequence[NDArray[np.uint32]],
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:  # [P], [P]
    """Returns how many matches of each pair join two points of the model, and how many one."""
    traced, joined = np.zeros((2, len(pairs)), np.int64)
    for pair, ((first, second), rows) in enumerate(zip(pairs, matches, strict=True)):
        if first not in shown or second not in shown:
            continue
        ours, theirs = shown[first][rows[:, 0]], shown[second][rows[:, 1]]
        both = (ours >= 0) & (theirs >= 0)
        traced[pair] = np.count_nonzero(both)
        joined[pair] = np.count_nonzero(both & (ours == theirs))
    return traced, joined


def _find_doubled(
    shown: Mapping[int, NDArray[np.int64]],  # which point each keypoint of an image shows, or -1
    pairs: Sequence[tuple[int, int]],
    matches: Sequence[NDArray[np.uint32]],
    explained: NDArray[np.int64],  # [P]
) -> dict[int, NDArray[np.int64]]:
    """Returns the points that the matches of contradicted pairs show, [K, 2], by row of a pair."""
    doubled = {}
    for pair, ((first, second), rows) in enumerate(zip(pairs, matches, strict=True)):
        if first in shown and second in shown and explained[pair] < MIN_PAIR_EXPLAINED * len(rows):
            both = np.column_stack([shown[first][rows[:, 0]], shown[second][rows[:, 1]]])
            doubled[pair] = both[(both >= 0).all(axis=1)]
    return doubled
