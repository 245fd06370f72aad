"""Which images are matched with which, and the matching itself."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence

import pycolmap

from recon_cli.mapping import database, doctor
from recon_cli.mapping.job import Job
from recon_cli.mapping.ledger import Result
from recon_cli.mapping.protocol import Reporter

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
    doctor.check_motion(*deepest)


def _matching(job: Job) -> pycolmap.FeatureMatchingOptions:
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads = job.threads
    return options


def _verification(job: Job) -> pycolmap.TwoViewGeometryOptions:
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = job.seed
    options.ransac.max_num_trials = MAX_TRIALS
    return options
