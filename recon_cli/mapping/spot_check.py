"""Poses and points that are kept as they were given, held against a few pairs of their images.

A data set that brings everything is taken without features, in a second or two. Poses whose axes
follow another convention, or that belong to other images, would then pass in silence: some pairs of
neighbours are matched, and their matches compared with the poses.
"""

from __future__ import annotations

import io
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from recon_cli.errors import SfmError
from recon_cli.mapping import evidence, features, merge, pairs
from recon_cli.mapping.job import Job
from recon_cli.mapping.ledger import fresh_folder
from recon_cli.mapping.protocol import Reporter

PLACES = 4  # spread over the images by name
# Of the cameras nearest to each place: the next one, and one with a baseline that tells more.
NEIGHBOURS = (0, 5)
FEATURES = 1000  # keypoints an image
MIN_MATCHES = 60  # fewer, in all pairs together, say nothing
# Share of the matches that must lie on the epipolar lines of the poses. A room and a desk gave
# .997 and more with their poses; with flipped axes, inverted matrices, poses of other images or of
# those four frames on .07 to .36 (tests/bench/bench_spot_check.py).
MIN_AGREEING = 0.5


@dataclass(frozen=True)
class Checked:
    """What the pairs say.

    Attributes:
        matches: verified matches of all pairs.
        share: of them that agree with the poses; None where there are too few to tell.
    """

    matches: int
    share: float | None

    @property
    def fits(self) -> bool:
        """Whether nothing speaks against the poses."""
        return self.share is None or self.share >= MIN_AGREEING

    def lines(self) -> list[str]:
        """Returns a sentence for the terminal."""
        if self.share is None:
            return [f"The given poses could not be checked: {self.matches} matches are too few."]
        return [f"{self.share:.0%} of {self.matches} matches between sampled images agree with "
                "the given poses."]


def check(
    job: Job, near: Mapping[str, list[str]], viewmats: Mapping[str, NDArray[np.float64]]
) -> Checked:
    """Returns how far sampled pairs of images bear out the poses.

    Args:
        job: whose groups all have a known lens.
        near: for each image the others that see much in common with it, nearest first.
        viewmats: [4, 4] world to camera by name.

    Raises:
        FormatError: a frame cannot be read.
    """
    names = sorted(viewmats)
    places = {names[int((i + 0.5) * len(names) / PLACES)] for i in range(PLACES)}
    wanted = {
        (min(one, two), max(one, two)) for one in places
        for two in (near[one][k] for k in NEIGHBOURS if k < len(near[one]))}
    sample = _part(job, sorted({name for pair in wanted for name in pair}))
    silent = Reporter(io.BytesIO())
    features.create_database(sample)
    try:
        features.extract(sample, silent)
        pairs.match(sample, wanted, silent)
        found = evidence.gather(_posed(sample, viewmats), sample.database, sample.names)
        matches, agreeing = int(found.matches.sum()), int(found.agreeing.sum())
    except SfmError:  # hardly any texture
        matches, agreeing = 0, 0
    shutil.rmtree(sample.out)
    return Checked(matches, agreeing / matches if matches >= MIN_MATCHES else None)


def _part(job: Job, names: list[str]) -> Job:
    """Returns a job over some of the images, in a folder of its own."""
    groups = tuple(
        replace(group, names=kept) for group in job.groups
        if (kept := tuple(name for name in group.names if name in names)))
    return replace(
        job, out=fresh_folder(job.rungs / "check"), groups=groups, max_features=FEATURES)


def _posed(
    job: Job, viewmats: Mapping[str, NDArray[np.float64]]
) -> pycolmap.Reconstruction:
    poses = {name: pycolmap.Rigid3d(viewmats[name][:3]) for name in job.names}
    return merge.posed(job.database, None, poses)
