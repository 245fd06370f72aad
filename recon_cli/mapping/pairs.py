"""Which images are matched with which, and the matching itself."""

from __future__ import annotations

import pycolmap

from recon_cli.mapping import database, doctor
from recon_cli.mapping.job import SEQUENTIAL_OVERLAP, Job
from recon_cli.mapping.ledger import Result
from recon_cli.mapping.protocol import Reporter

# COLMAP tries 10000 samples before it gives up on a pair, and most of its time goes to pairs that
# show nothing in common. 2000 took a third off the verification of five captures; of their 5700
# verified pairs 8 got lost, all with few matches, and every model kept its images.
MAX_TRIALS = 2000


def match(job: Job, report: Reporter) -> Result:
    """Matches and verifies image pairs in the database; returns how many were verified.

    Pairs that an interrupted run has finished are kept.

    Raises:
        SfmError: no pair matches, or none of them shows depth.
    """
    done = database.progress(job.database, "matches")
    report.phase("matches", job.pair_count, done=done)
    if job.exhaustive:
        pycolmap.match_exhaustive(
            job.database, _matching(job), pycolmap.ExhaustivePairingOptions(), _verification(job),
            pycolmap.Device.cpu)
    else:
        _match_sequential(job)
    pairs, matches, flat = database.inlier_counts(job.database)
    doctor.check_motion(pairs, matches, flat)
    rows = database.progress(job.database, "matches")
    return {"rows": rows, "verified_pairs": pairs, "matches": matches}


def _match_sequential(job: Job) -> None:
    """Matches neighbours, then images at powers of two.

    Two passes, because COLMAP's quadratic overlap leaves out the neighbours 3, 5, 6, 7, 9 and 10
    that its linear one has. There is no loop detection: it needs a vocabulary tree, a download.
    """
    for quadratic in (False, True):
        options = pycolmap.SequentialPairingOptions()
        options.overlap = SEQUENTIAL_OVERLAP
        options.quadratic_overlap = quadratic
        pycolmap.match_sequential(
            job.database, _matching(job), options, _verification(job), pycolmap.Device.cpu)


def _matching(job: Job) -> pycolmap.FeatureMatchingOptions:
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads = job.threads
    return options


def _verification(job: Job) -> pycolmap.TwoViewGeometryOptions:
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = job.seed
    options.ransac.max_num_trials = MAX_TRIALS
    return options
