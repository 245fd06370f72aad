"""Which images are matched with which, and the matching itself."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from recon_cli.sfm import checks, database
from recon_cli.sfm.database import scales
from recon_cli.sfm.job import Job, Reporter
from recon_cli.sfm.step_log import Result

# Look-alikes of an image beside its neighbours. Of all pairs that are no neighbours and have 50 or
# more verified matches they hold 41% in a slow walk of 160 frames (10 hold 25%, and 20 that may be
# neighbours 9%), 67% of 76 frames of a room, 80% of 50 photos.
NEAREST = 20
WORDS = 64  # 32, or all keypoints in place of the coarsest 1000, chose no better pairs
COARSEST = 1000  # keypoints of an image, largest scale first: they are seen from more places
SAMPLE = 20_000  # descriptors that the words are found from
ROUNDS = 10  # of k-means
CHUNK = 4096  # descriptors compared with the words at a time, to bound the memory


def similar(
    database: Path,
    names: Sequence[str],
    *,
    seed: int,
    nearest: int = NEAREST,
    besides: Collection[Pair] = (),
) -> set[Pair]:
    """Returns each image paired with those that look most like it.

    Args:
        database: with the features of all images.
        names: of the images to pair.
        seed: of the choice of descriptors that the visual words are found from.
        nearest: images that each one is paired with.
        besides: pairs that are known already; others take their place.
    """
    ordered = sorted(names)
    row = {name: index for index, name in enumerate(ordered)}
    features = _features(database, ordered)
    described = _described(features, _words(features, np.random.default_rng(seed)))
    likeness = described @ described.T
    known = np.array([(row[one], row[two]) for one, two in besides], int).reshape(-1, 2)
    known = np.concatenate([known, known[:, ::-1], np.repeat(np.arange(len(row))[:, None], 2, 1)])
    likeness[known[:, 0], known[:, 1]] = -np.inf
    order = np.argsort(-likeness, axis=1, kind="stable")[:, :nearest]
    return {
        (ordered[min(one, two)], ordered[max(one, two)])
        for one, columns in enumerate(order.tolist()) for two in columns
        if likeness[one, two] > -np.inf}


def _features(database: Path, names: Sequence[str]) -> list[NDArray[np.float32]]:
    """Returns unit descriptors of the coarsest keypoints of each image, [K, 128]."""
    features = []
    with pycolmap.Database.open(database) as opened:
        ids = {image.name: image.image_id for image in opened.read_all_images()}
        for name in names:
            rows = np.asarray(opened.read_descriptors(ids[name]).data, np.float32)
            largest = np.argsort(-scales(opened.read_keypoints(ids[name])), kind="stable")
            rows = rows.reshape(-1, 128)[largest[:COARSEST]]
            features.append(rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-9))
    return features


def _words(
    features: Sequence[NDArray[np.float32]], generator: np.random.Generator
) -> NDArray[np.float32]:
    """Returns the centres that k-means finds, [W, 128]."""
    every = np.concatenate(features)
    sample = every[generator.permutation(len(every))[:SAMPLE]]
    words = sample[:WORDS].copy()
    for _ in range(ROUNDS):
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


def _described(
    features: Sequence[NDArray[np.float32]], words: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Returns one unit vector an image, [N, W * 128]; zero where it has no features.

    The residuals of each word are scaled to one length, so that a repeated texture does not
    outweigh the rest ("intra-normalisation", Arandjelovic and Zisserman, CVPR 2013). The mean of
    all images, what they have in common, is taken off.
    """
    described = np.zeros((len(features), *words.shape), np.float32)
    for row, found in zip(described, features, strict=True):
        nearest = _nearest(found, words)
        np.add.at(row, nearest, found - words[nearest])
    described = _unit(_unit(described).reshape(len(features), -1))
    return _unit(described - described.mean(axis=0))


def _unit(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    lengths = np.linalg.norm(rows, axis=-1, keepdims=True)
    return np.asarray(rows / np.where(lengths > 0, lengths, 1), np.float32)


# COLMAP's default. With the powers of two an image also meets those 16, 32, ... 512 further on.
SEQUENTIAL_OVERLAP = 10
# COLMAP tries 10000 samples before it gives up on a pair, and most of its time goes to pairs that
# show nothing in common. 2000 took a third off the verification of five captures; of their 5700
# verified pairs 8 got lost, all with few matches, and every model kept its images.
MAX_TRIALS = 2000
# Share of the verified matches from which pairs at some distance can tell whether there is depth.
MIN_SHARE = 0.01

Pair = tuple[str, str]  # file names in order


def exhaustive(names: Sequence[str]) -> set[Pair]:
    """Returns every pair of the images `names`."""
    return set(itertools.combinations(sorted(names), 2))


def sequential(names: Sequence[str]) -> set[Pair]:
    """Returns the pairs of near images in the order of their names, and of those 2, 4, ... apart.

    The powers of two reach from one round through a room to the next without growing with the
    square of the number of images.
    """
    ordered = sorted(names)
    near = range(1, SEQUENTIAL_OVERLAP + 1)
    far = (2**power for power in range(SEQUENTIAL_OVERLAP))
    return {
        pair for step in {*near, *far} for pair in zip(ordered, ordered[step:], strict=False)}


def match(job: Job, pairs: Iterable[Pair], report: Reporter) -> None:
    """Matches and verifies image pairs in the database; those that are there are not done again."""
    wanted, there = set(pairs), database.pair_names(job.database)
    report.phase("matches", len(wanted | there), done=len(there))
    listed = job.rungs / "pairs.txt"
    job.rungs.mkdir(exist_ok=True)
    listed.write_text("".join(
        f"{one} {two}\n" for one, two in sorted(wanted - there)), encoding="utf-8")
    options = pycolmap.ImportedPairingOptions()
    options.match_list_path = listed
    if wanted - there:
        pycolmap.match_image_pairs(
            job.database, _matching(job), options, _verification(job), pycolmap.Device.cpu)
    listed.unlink()


def counted(job: Job) -> Result:
    """Returns how much is matched: rows of the database, verified pairs and their matches."""
    pairs, matches, _ = database.inlier_counts(job.database)
    rows = database.progress(job.database, "matches")
    return {"rows": rows, "verified_pairs": pairs, "matches": matches}


def check_motion(job: Job) -> None:
    """Raises SfmError when no pair matches, or none of them shows depth.

    Frames that lie near each other in a slow video always look flat, and the more of them there
    are, the more they outweigh the others. So pairs are judged by how far apart they are in the
    order of their names, and the ones that show most depth decide: in a walk with small steps 0.91
    of all matches were flat, 0.22 of those 64 frames apart; in a turn on the spot all are.
    """
    found = database.inlier_counts_by_distance(job.database)
    every = sum(matches for _, matches, _ in found)
    telling = [counts for counts in found if counts[1] >= MIN_SHARE * every]
    deepest = min(telling, key=lambda counts: counts[2] / counts[1], default=(0, 0, 0))
    checks.check_motion(*deepest)


def _matching(job: Job) -> pycolmap.FeatureMatchingOptions:
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads = job.threads
    return options


def _verification(job: Job) -> pycolmap.TwoViewGeometryOptions:
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = job.seed
    options.ransac.max_num_trials = MAX_TRIALS
    return options
