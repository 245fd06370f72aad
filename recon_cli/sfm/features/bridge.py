"""Pairs of photos that learned features match where SIFT has too few, checked so that none lies.

XFeat matches over large changes of view, and just as readily two lockers or two doors: with the
inliers that suffice for SIFT 204 of 228 such pairs were false. Here SIFT must agree: its matches,
found without the new geometry, have to lie on it. SIFT is then matched again along the geometry,
which brings its precision back (4.15 -> 1.33 cm in a room of 13 photos).

Keypoints of XFeat follow those of SIFT in a database of this fallback alone.
"""

from __future__ import annotations

import shutil
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from recon_cli.io.colmap_library import pycolmap
from recon_cli.io.images import read_png
from recon_cli.scene.matches import MAX_RATIO
from recon_cli.scene.statistics import at_least
from recon_cli.sfm import database
from recon_cli.sfm.features import matching, xfeat_weights
from recon_cli.sfm.features.features import DESCRIPTOR_SCALE
from recon_cli.sfm.features.xfeat import (
    DESCRIPTOR_STEPS,
    LONGER_SIDE,
    LearnedFeatures,
    Network,
    find_learned_features,
)
from recon_cli.sfm.job import MappingJob, Reporter
from recon_cli.sfm.limits import (
    EXACT_PX,
    FEW_PAIR_MATCHES,
    MAX_TRIALS,
    MIN_POSE_INLIERS,
    NEAR_FRAMES,
)
from recon_cli.sfm.mapping import mapper, skeleton
from recon_cli.sfm.model_arrays import Pair

ATTEMPT = "bridge"
# Of a bridge, besides MIN_POSE_INLIERS: the share of inliers in the mutual matches of XFeat, which
# may be EXACT_PX off in an image of LONGER_SIDE. By these alone 46 of 67 pairs of a wall of lockers
# were false.
MIN_INLIER_SHARE = 0.3
# SIFT's own matches that must lie on the geometry: at least, and of all. 0 of 13 pairs are false.
MIN_AGREEING = (6, 0.2)
MIN_COSINE = 0.82  # of two learned descriptors (paper)

Rows = NDArray[np.int64]  # [M, 2] rows of keypoints in two images


@dataclass(frozen=True, eq=False)
class PhotoFeatures:
    """What is known of one photo."""

    number: int  # in the database
    camera: pycolmap.Camera
    xy: NDArray[np.float64]  # [K, 2] of SIFT's keypoints, pixels
    sift: NDArray[np.float32]  # [K, 128] whole numbers
    learned: LearnedFeatures


def choose_pairs(
    job: MappingJob, parts: Sequence[Collection[str]], thin: Collection[str]
) -> set[Pair]:
    """Returns the pairs that SIFT matched too little and that a bridge would help.

    These lie across two of the `parts` that models hold, have an image without a place, or one of
    those whose place is `thin`. Each image is paired with those that look most like it, and with
    the nearest by name.
    """
    part_of = {name: index for index, names in enumerate(parts) for name in names}
    verified = matching.read_verified(job.database)

    def helps(first: str, second: str) -> bool:
        apart = first not in part_of or part_of[first] != part_of.get(second)
        return apart or first in thin or second in thin

    near = skeleton.near_pairs(job, NEAR_FRAMES)
    alike = matching.similar_pairs(job.database, job.names, seed=job.seed, besides=near)
    return {pair for pair in near | alike if helps(*pair) and (
        pair not in verified or len(verified[pair].inlier_matches) < FEW_PAIR_MATCHES)}


def map_bridged(
    job: MappingJob, report: Reporter, parts: Sequence[Collection[str]], thin: Collection[str]
) -> list[pycolmap.Reconstruction]:
    """Returns the models of all matches and of what bridges add; none where no pair gets one.

    `job.matches_db` names the database that is written and mapped from; see `choose_pairs`.
    """
    weights = xfeat_weights.load_weights()
    if weights is None:
        report.tell("The learned features are damaged and not used: "
                    f"`{xfeat_weights.COMMAND}` gets them anew.")
        return []
    source = replace(job, matches_db=None)
    pairs = choose_pairs(source, parts, thin)
    database.remove(job.database)
    shutil.copyfile(source.database, job.database)
    verified = matching.read_verified(source.database)
    report.phase("bridge", len(pairs))
    photos = _read_photos(job, Network(weights), sorted({name for pair in pairs for name in pair}))
    bridges = 0
    with pycolmap.Database.open(job.database) as opened:
        for photo in photos.values():
            learned = np.zeros((len(photo.learned.xy), database.KEYPOINT_COLUMNS), np.float32)
            learned[:, :2], learned[:, [2, 5]] = photo.learned.xy, 1  # a shape of one pixel
            opened.update_keypoints(photo.number, np.concatenate(
                [opened.read_keypoints(photo.number), learned]))
        for done, (pair, geometry) in enumerate(_find_bridges(job, photos, pairs, verified), 1):
            report.done(done)
            if geometry is None:
                continue
            bridges += 1
            first, second = (photos[name].number for name in pair)
            if opened.exists_matches(first, second):
                opened.delete_matches(first, second)
            if opened.exists_two_view_geometry(first, second):
                opened.delete_two_view_geometry(first, second)
            opened.write_matches(first, second, geometry.inlier_matches)
            opened.write_two_view_geometry(first, second, geometry)
    return mapper.map_incrementally(job, report) if bridges else []


def _read_photos(
    job: MappingJob, network: Network, names: Sequence[str]
) -> dict[str, PhotoFeatures]:
    """Returns photos by name, with the learned features found in them."""

    def find(name: str) -> LearnedFeatures:
        mask = None
        if job.masks is not None and (job.masks / name).exists():
            mask = read_png(job.masks / name)[:, :, 0]
        return find_learned_features(network, read_png(job.frames / name), mask)

    with ThreadPoolExecutor(job.threads) as pool, pycolmap.Database.open(job.database) as opened:
        images = {image.name: image for image in opened.read_all_images()}
        return {name: PhotoFeatures(
            images[name].image_id, opened.read_camera(images[name].camera_id),
            opened.read_keypoints(images[name].image_id)[:, :2].astype(np.float64),
            np.asarray(opened.read_descriptors(images[name].image_id).data, np.float32).reshape(
                -1, 128), learned)
            for name, learned in zip(names, pool.map(find, names), strict=True)}


def _find_bridges(
    job: MappingJob, photos: Mapping[str, PhotoFeatures], pairs: Iterable[Pair],
    verified: Mapping[Pair, pycolmap.TwoViewGeometry],
) -> Iterator[tuple[Pair, pycolmap.TwoViewGeometry | None]]:
    """Yields pairs in order, each with its bridge if there is one."""
    def find(pair: Pair) -> pycolmap.TwoViewGeometry | None:
        known = verified[pair].inlier_matches if pair in verified else np.zeros((0, 2))
        first, second = (photos[name] for name in pair)
        return find_bridge(first, second, known.astype(np.int64), seed=job.seed)

    ordered = sorted(pairs)
    with ThreadPoolExecutor(job.threads) as pool:
        yield from zip(ordered, pool.map(find, ordered), strict=True)


def find_bridge(
    first: PhotoFeatures, second: PhotoFeatures, known: Rows, *, seed: int
) -> pycolmap.TwoViewGeometry | None:
    """Returns the geometry of two photos that both kinds of features agree on; None without one.

    `known` are SIFT's verified matches. Inliers are rows of keypoints, XFeat's behind SIFT's.
    """
    start = [len(first.xy), len(second.xy)]
    learned = match_rows(first.learned.descriptors @ second.learned.descriptors.T,
                         least=MIN_COSINE * DESCRIPTOR_STEPS**2)
    if len(learned) < MIN_POSE_INLIERS:
        return None
    options, camera = pycolmap.TwoViewGeometryOptions(), first.camera
    options.ransac.random_seed, options.ransac.max_num_trials = seed, MAX_TRIALS
    options.ransac.max_error = EXACT_PX * max(
        1.0, max(camera.width, camera.height) / LONGER_SIDE)
    geometry = pycolmap.estimate_two_view_geometry(
        camera, np.concatenate([first.xy, first.learned.xy]),
        second.camera, np.concatenate([second.xy, second.learned.xy]),
        np.concatenate([known, learned + start]).astype(np.uint32), options)
    inliers = geometry.inlier_matches.astype(np.int64).reshape(-1, 2)
    new = inliers[inliers[:, 0] >= start[0]]
    if geometry.F is None or len(new) < max(MIN_POSE_INLIERS, MIN_INLIER_SHARE * len(learned)):
        return None
    similarity = first.sift @ second.sift.T
    own = match_sift(similarity)
    off = epipolar_distances(geometry.F, first.xy[own[:, 0]], second.xy[own[:, 1]])
    agreeing = np.count_nonzero(off < options.ransac.max_error)
    if agreeing < at_least(MIN_AGREEING, len(own)):
        return None
    similarity[~near_epipolar_lines(
        geometry.F, first.xy, second.xy, options.ransac.max_error)] = -1
    guided = match_sift(similarity)
    kept = inliers[inliers[:, 0] < start[0]]
    kept = kept[~np.isin(kept[:, 0], guided[:, 0]) & ~np.isin(kept[:, 1], guided[:, 1])]
    geometry.inlier_matches = np.concatenate([guided, kept, new]).astype(np.uint32)
    return geometry


def match_sift(similarity: NDArray[np.float32]) -> Rows:
    """Returns the mutual nearest neighbours by products [N, M] of SIFT descriptors (COLMAP)."""
    return match_rows(similarity, least=float(np.cos(matching.MAX_ANGLE)) * DESCRIPTOR_SCALE**2,
                      ratio=MAX_RATIO)


def match_rows(
    similarity: NDArray[np.float32], *, least: float, ratio: float = 1.0
) -> Rows:
    """Returns rows and columns [K, 2] that are each other's most similar, of `least` or more.

    With a `ratio` below 1 the angle between two of SIFT's descriptors must be smaller than so many
    times that to any other one.
    """
    if not similarity.size:
        return np.zeros((0, 2), np.int64)
    column = similarity.argmax(axis=1)
    best = similarity[np.arange(len(column)), column]
    row = np.flatnonzero((best == similarity.max(axis=0)[column]) & (best > least))
    column, best = column[row], best[row]
    if ratio < 1.0:
        in_row, in_column = similarity[row], similarity[:, column]
        each = np.arange(len(row))
        in_row[each, column] = in_column[row, each] = -1
        second = np.maximum(in_row.max(axis=1, initial=-1), in_column.max(axis=0, initial=-1))
        angle, other = (np.arccos(np.clip(value.astype(np.float64) / DESCRIPTOR_SCALE**2, -1, 1))
                        for value in (best, second))
        row, column = row[angle < ratio * other], column[angle < ratio * other]
    return np.stack([row, column], axis=1)


def epipolar_distances(
    fundamental: NDArray[np.float64], first: NDArray[np.float64], second: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns by how many pixels matches [M, 2] miss their epipolar lines (Sampson)."""
    ours, theirs = (np.column_stack([xy, np.ones(len(xy))]) for xy in (first, second))
    lines, back = ours @ fundamental.T, theirs @ fundamental
    slope = (lines[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1)
    return np.asarray(np.abs((theirs * lines).sum(axis=1)) / np.sqrt(np.maximum(slope, 1e-12)))


def near_epipolar_lines(
    fundamental: NDArray[np.float64], first: NDArray[np.float64], second: NDArray[np.float64],
    max_px: float,
) -> NDArray[np.bool_]:
    """Returns which of any two keypoints [N, 2] and [M, 2] could match, [N, M]; as above."""
    ours, theirs = (np.column_stack([xy, np.ones(len(xy))]) for xy in (first, second))
    lines, back = ours @ fundamental.T, theirs @ fundamental
    slope = (lines[:, :2] ** 2).sum(axis=1)[:, None] + (back[:, :2] ** 2).sum(axis=1)
    return np.asarray((lines @ theirs.T) ** 2 < max_px**2 * slope)
