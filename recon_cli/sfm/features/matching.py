"""SIFT features, the choice of image pairs, and their matching, in COLMAP's database.

Pairs are all, the neighbours in a sequence, or those that look alike by a bag of visual words
(VLAD). The frames of a group share one camera.

Matches are exact, so they are the same for any number of threads. An approximate index, as
COLMAP's, takes as long and loses 2.5% of them.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import FormatError, Hint, list_names
from recon_cli.io.colmap_library import pycolmap
from recon_cli.scene.matches import MAX_RATIO, MIN_PAIR_INLIERS
from recon_cli.scene.statistics import FINE_SAMPLE
from recon_cli.sfm import database
from recon_cli.sfm.database import scales
from recon_cli.sfm.features.features import DESCRIPTOR_SCALE
from recon_cli.sfm.job import CameraGroup, MappingJob, Reporter
from recon_cli.sfm.limits import COARSEST_KEYPOINTS, MAX_TRIALS, MIN_DEEP_SHARE, MIN_PANORAMA_SHARE
from recon_cli.sfm.mapping import checks
from recon_cli.sfm.model_arrays import Pair
from recon_cli.sfm.results import MatchesResult

CAMERA_MODEL = "OPENCV"  # two focal lengths, two radial and two tangential terms
# COLMAP's default. With the powers of two an image also meets those 16, 32, ... 512 further on.
SEQUENTIAL_OVERLAP = 10
# Similar images per image beside its neighbours. They hold 41% (10 hold 25%) of the other pairs
# with 50 or more verified matches in a slow walk, 67% in a room, 80% in 50 photos.
NEAREST = 20
WORDS = 64  # 32, or all keypoints in place of the coarsest 1000, chose no better pairs
WORD_ROUNDS = 10  # of k-means
# Descriptors compared with others, and pairs of images whose descriptors are read, at a time: they
# bound the memory.
CHUNK = 1024
MAX_ANGLE = 0.7  # radians, of two descriptors that match. COLMAP's (SiftMatchingOptions)

Matches = NDArray[np.uint32]  # [M, 2] rows of the keypoints in either image


def create_database(job: MappingJob) -> None:
    """Writes a database with one camera per group and every image, whole or not at all.

    The images get their ids here, in the order of their names, which extraction in several threads
    would not keep. FormatError if frames cannot be read or differ in size.
    """
    temporary = job.database.with_suffix(".partial")
    database.remove(job.database)
    database.remove(temporary)
    pycolmap.Database.open(temporary).close()
    for group in job.groups:
        pycolmap.import_images(
            temporary, job.frames, pycolmap.CameraMode.SINGLE, list(group.names),
            _reader_options(group, first_model(job, group)))
    with pycolmap.Database.open(temporary) as opened:
        names = {image.name for image in opened.read_all_images()}
    _check_readable(job, names)
    temporary.replace(job.database)


def _check_readable(job: MappingJob, readable: Collection[str]) -> None:
    missing = [name for name in job.names if name not in readable]
    if missing:
        raise FormatError(
            f"{len(missing)} of {len(job.names)} frames cannot be read or differ from the first in "
            f"size: {list_names(missing)}.",
            hint=Hint("ingest", again=True))


def first_model(job: MappingJob, group: CameraGroup) -> str:
    """Returns the camera model with which matches are verified at first.

    A fisheye's matches are as those of an ordinary lens without a focal length until its own is
    found: with a wrong one no motion explains them. Segments have one model from the start.
    """
    later = "FISHEYE" in group.model and not job.is_segment and not job.segments
    return CAMERA_MODEL if later or group.model == "auto" else group.model


def _reader_options(
    group: CameraGroup, model: str, masks: Path | None = None
) -> pycolmap.ImageReaderOptions:
    options = pycolmap.ImageReaderOptions()
    options.camera_model = model
    if masks is not None:
        options.mask_path = masks
    if group.lens is not None:
        options.camera_model = group.lens.model
        options.camera_params = ",".join(map(repr, group.lens.params))
    elif group.focal_px is not None:
        camera = pycolmap.Camera.create_from_model_name(
            1, options.camera_model, group.focal_px, group.width, group.height)
        options.camera_params = ",".join(map(repr, map(float, camera.params)))
    return options


def exhaustive_pairs(names: Sequence[str]) -> set[Pair]:
    """Returns every pair of the images `names`."""
    return set(itertools.combinations(sorted(names), 2))


def sequential_pairs(names: Sequence[str]) -> set[Pair]:
    """Returns the pairs of near images by name, and of those 2, 4, ... apart, to close rounds."""
    ordered = sorted(names)
    near = range(1, SEQUENTIAL_OVERLAP + 1)
    far = (2**power for power in range(SEQUENTIAL_OVERLAP))
    return {pair for step in {*near, *far} for pair in zip(ordered, ordered[step:], strict=False)}


def similar_pairs(
    database: Path, names: Sequence[str], *, seed: int, nearest: int = NEAREST,
    besides: Collection[Pair] = (),
) -> set[Pair]:
    """Returns each image paired with the `nearest` ones most like it, the known `besides` apart."""
    ordered = sorted(names)
    row = {name: index for index, name in enumerate(ordered)}
    features = _features(database, ordered)
    vectors = _describe(features, _visual_words(features, np.random.default_rng(seed)))
    similarity = vectors @ vectors.T
    known = np.array([(row[name], row[other]) for name, other in besides], int).reshape(-1, 2)
    known = np.concatenate([known, known[:, ::-1], np.repeat(np.arange(len(row))[:, None], 2, 1)])
    similarity[known[:, 0], known[:, 1]] = -np.inf
    order = np.argsort(-similarity, axis=1, kind="stable")[:, :nearest]
    return {
        (ordered[min(image, other)], ordered[max(image, other)])
        for image, columns in enumerate(order.tolist()) for other in columns
        if similarity[image, other] > -np.inf}


def _features(database: Path, names: Sequence[str]) -> list[NDArray[np.float32]]:
    """Returns unit descriptors of the coarsest keypoints of each image, [K, 128]."""
    features = []
    with pycolmap.Database.open(database) as opened:
        ids = {image.name: image.image_id for image in opened.read_all_images()}
        for name in names:
            rows = np.asarray(opened.read_descriptors(ids[name]).data, np.float32)
            largest = np.argsort(-scales(opened.read_keypoints(ids[name])), kind="stable")
            rows = rows.reshape(-1, 128)[largest[:COARSEST_KEYPOINTS]]
            features.append(rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-9))
    return features


def _visual_words(
    features: Sequence[NDArray[np.float32]], generator: np.random.Generator
) -> NDArray[np.float32]:
    """Returns the centres that k-means finds, [W, 128]."""
    descriptors = np.concatenate(features)
    sample = descriptors[generator.permutation(len(descriptors))[:FINE_SAMPLE]]
    words = sample[:WORDS].copy()
    for _ in range(WORD_ROUNDS):
        nearest = _nearest(sample, words)
        for word in np.unique(nearest):
            words[word] = sample[nearest == word].mean(axis=0)
    return words


def _nearest(rows: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.int64]:
    """Returns the index of the nearest word to each row."""
    half = (words**2).sum(axis=1) / 2
    return np.concatenate([np.zeros(0, np.int64)] + [
        (rows[start:start + CHUNK] @ words.T - half).argmax(axis=1)
        for start in range(0, len(rows), CHUNK)])


def _describe(
    features: Sequence[NDArray[np.float32]], words: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Returns one unit vector an image, [N, W * 128]; zero where it has no features.

    The residuals of each word are scaled to one length, so that a repeated texture does not
    outweigh the rest (Arandjelovic and Zisserman, CVPR 2013). The mean of all is subtracted.
    """
    vectors = np.zeros((len(features), *words.shape), np.float32)
    for row, descriptors in zip(vectors, features, strict=True):
        nearest = _nearest(descriptors, words)
        np.add.at(row, nearest, descriptors - words[nearest])
    vectors = _unit(_unit(vectors).reshape(len(features), -1))
    return _unit(vectors - vectors.mean(axis=0))


def _unit(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    lengths = np.linalg.norm(rows, axis=-1, keepdims=True)
    return np.asarray(rows / np.where(lengths > 0, lengths, 1), np.float32)


def near_or_similar_pairs(job: MappingJob, names: Collection[str]) -> set[Pair]:
    """Returns the neighbours among images of each camera, and images that look alike."""
    near = set().union(*(
        sequential_pairs(sorted(set(names).intersection(group.names))) for group in job.groups))
    return near | similar_pairs(job.database, sorted(names), seed=job.seed, besides=near)


def match_pairs(
    job: MappingJob, pairs: Iterable[Pair], report: Reporter, *, phase: str = "matches"
) -> None:
    """Matches and verifies image pairs in the database, except those that are there already."""
    wanted, there = set(pairs), database.pair_names(job.database)
    report.phase(phase, len(wanted | there), done=len(there))
    with pycolmap.Database.open(job.database) as opened:
        _write_geometries(job, opened, sorted(wanted - there), None, lambda count: report.done(
            len(there) + count))


def match_descriptors(ours: NDArray[np.uint8], theirs: NDArray[np.uint8]) -> Matches:
    """Returns which rows of SIFT descriptors [K, 128] are each other's nearest, by COLMAP's rules.

    A product of two descriptors is a whole number below 2**24, which float32 holds: sums are exact
    in any order.
    """
    if not len(theirs):
        return np.zeros((0, 2), np.uint32)
    first, second = ours.astype(np.float32), theirs.astype(np.float32)
    nearest, best = np.zeros(len(first), np.int64), np.zeros(len(first), np.float32)
    runner_up, most = best.copy(), np.zeros(len(second), np.float32)
    for start in range(0, len(first), CHUNK):
        products = first[start:start + CHUNK] @ second.T
        columns = products.argmax(axis=1)
        largest = np.take_along_axis(products, columns[:, None], 1)[:, 0]
        most = np.maximum(most, products.max(axis=0))
        near = np.flatnonzero(largest == most[columns])  # only these may be mutual
        block = slice(start, start + len(products))
        nearest[block], best[block] = columns, largest
        runner_up[start + near] = _second_largest(products[near], columns[near])
    rows = np.flatnonzero(
        (best == most[nearest]) & (best >= np.cos(MAX_ANGLE) * DESCRIPTOR_SCALE**2))
    rows = rows[_is_clear(best[rows], runner_up[rows])]
    columns = nearest[rows]
    back = _second_largest(second[columns] @ first.T, rows)
    return np.stack([rows, columns], axis=1)[_is_clear(best[rows], back)].astype(np.uint32)


def _second_largest(
    products: NDArray[np.float32], largest: NDArray[np.int64]  # [M, K], [M] columns
) -> NDArray[np.float32]:
    np.put_along_axis(products, largest[:, None], -1, 1)
    return np.asarray(products.max(axis=1, initial=0))


def _is_clear(best: NDArray[np.float32], second: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Returns whether products of descriptors pass Lowe's ratio test."""
    angles = np.arccos(np.minimum(np.stack([best, second]) / DESCRIPTOR_SCALE**2, 1))
    return np.asarray(angles[0] < MAX_RATIO * angles[1])


def verify_pairs(job: MappingJob, pairs: Iterable[Pair]) -> None:
    """Verifies the matches of pairs that are in the database already."""
    listed = sorted(pairs)
    with pycolmap.Database.open(job.database) as opened:
        ids = {image.name: image.image_id for image in opened.read_all_images()}
        matches = {pair: opened.read_matches(*(ids[name] for name in pair)) for pair in listed}
        _write_geometries(job, opened, listed, matches, lambda _: None)


def read_matched_pixels(
    path: Path, geometries: Mapping[Pair, pycolmap.TwoViewGeometry]
) -> Iterator[tuple[Pair, NDArray[np.float64], NDArray[np.float64]]]:
    """Yields pairs with where their verified matches lie in either image, [M, 2] pixels each."""
    with pycolmap.Database.open(path) as opened:
        pixels = {image.name: opened.read_keypoints(image.image_id)[:, :2].astype(np.float64)
                  for image in opened.read_all_images()}
    for (first, second), geometry in geometries.items():
        ours, theirs = geometry.inlier_matches.T
        yield (first, second), pixels[first][ours], pixels[second][theirs]


def _write_geometries(
    job: MappingJob, opened: pycolmap.Database, pairs: Sequence[Pair],
    known: Mapping[Pair, Matches] | None, done: Callable[[int], None],
) -> None:
    """Writes the verified matches of pairs, and where they are not `known` all matches.

    `done` is called with the number of finished pairs.
    """
    options = _verification_options(job)
    images = {image.name: image for image in opened.read_all_images()}
    cameras = {camera.camera_id: camera for camera in opened.read_all_cameras()}
    with ThreadPoolExecutor(job.threads) as pool:
        for start in range(0, len(pairs), CHUNK):
            some = pairs[start:start + CHUNK]
            numbers = {name: images[name].image_id for name in itertools.chain(*some)}
            places = {name: opened.read_keypoints(number)[:, :2].astype(np.float64)
                      for name, number in numbers.items()}
            rows = {} if known is not None else {
                name: np.asarray(opened.read_descriptors(number).data).reshape(-1, 128)
                for name, number in numbers.items()}

            def find(
                pair: Pair, places: Mapping[str, NDArray[np.float64]] = places,
                rows: Mapping[str, NDArray[np.uint8]] = rows,
            ) -> tuple[Matches, pycolmap.TwoViewGeometry]:
                first, second = pair
                matches = (match_descriptors(rows[first], rows[second]) if known is None
                           else known[pair])
                return matches, pycolmap.estimate_two_view_geometry(
                    cameras[images[first].camera_id], places[first],
                    cameras[images[second].camera_id], places[second], matches, options)

            found = pool.map(find, some)
            for count, (pair, (matches, geometry)) in enumerate(
                    zip(some, found, strict=True), start + 1):
                ids = [numbers[name] for name in pair]
                with pycolmap.DatabaseTransaction(opened):  # a pair is there whole or not at all
                    if known is None:
                        opened.write_matches(*ids, matches)
                    opened.write_two_view_geometry(*ids, geometry)
                done(count)


def _verification_options(job: MappingJob) -> pycolmap.TwoViewGeometryOptions:
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = job.seed
    options.ransac.max_num_trials = MAX_TRIALS
    if job.panoramas and len(job.panoramas) == len(job.names):
        options.min_inlier_ratio = MIN_PANORAMA_SHARE
    return options


def read_verified(path: Path) -> dict[Pair, pycolmap.TwoViewGeometry]:
    """Returns the verified matches of all pairs in a database; the names of a pair in order."""
    verified = {}
    with pycolmap.Database.open(path) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        for number, geometry in zip(*opened.read_two_view_geometries(), strict=True):
            first, second = (names[i] for i in pycolmap.pair_id_to_image_pair(number))
            if first > second:
                first, second = second, first
                geometry.invert()
            if len(geometry.inlier_matches) >= MIN_PAIR_INLIERS:
                verified[first, second] = geometry
    return verified


def count_matches(job: MappingJob) -> MatchesResult:
    """Returns the numbers of matched pairs, verified pairs and verified matches."""
    groups = database.count_inliers(job.database)
    return MatchesResult(
        rows=database.progress(job.database, "matches"),
        verified_pairs=sum(pairs for pairs, _, _ in groups),
        matches=sum(matches for _, matches, _ in groups))


def check_motion(job: MappingJob) -> None:
    """Raises SfmError when no pair matches, or none of them shows depth.

    Pairs of near frames in a slow video always look flat, so pairs are grouped by their distance in
    the order of names, and the group with most depth decides. In a walk with small steps 0.91 of
    all matches were flat, 0.22 of those 64 frames apart; in a turn on the spot all are.
    """
    groups = database.count_inliers(job.database)
    everything = tuple(map(sum, zip(*groups, strict=True))) or (0, 0, 0)
    deep = [counts for counts in groups if counts[1] - counts[2] >= MIN_DEEP_SHARE * everything[1]]
    deepest = min(deep, key=lambda counts: counts[2] / counts[1], default=everything)
    checks.check_motion(*deepest)
