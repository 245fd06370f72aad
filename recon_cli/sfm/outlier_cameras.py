"""Why an image has no camera, as far as its features and matches tell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import PurePath

import numpy as np
from numpy.typing import NDArray

from recon_cli.sfm.evidence import Evidence

# A step is a jump from this many of the usual steps on, which is the median of those around it: a
# camera goes slower along a shelf than across the room. Longest steps measured: 1.1 to 2.8 in good
# models, 9 to 20 where cameras are displaced.
MAX_STEP = 6.0
WINDOW = 15  # steps; a median over fewer follows the jump itself
MIN_STEPS = 5  # fewer say nothing about what is usual


@dataclass(frozen=True)
class Jump:
    """A step between two images that follow each other.

    Attributes:
        before: name of the image before the step.
        after: name of the image after it.
        ratio: its length over that of the usual step around it; a step across a gap in time is
            shared out over the gap.
    """

    before: str
    after: str
    ratio: float


def jumps(evidence: Evidence, times: Mapping[str, float | None]) -> tuple[Jump, ...]:
    """Returns the steps that are far too long; none where nothing says that this is a video.

    A video is known by the times of all its cameras, or by names that are all numbers.

    Args:
        evidence: of the model.
        times: seconds in the video by name; None or absent where it is not known.
    """
    rows = np.flatnonzero(evidence.registered)
    moments = _moments([evidence.names[row] for row in rows], times)
    if moments is None or len(rows) <= MIN_STEPS:
        return ()
    order = np.argsort(moments, kind="stable")
    rows, gaps = rows[order], np.diff(moments[order])
    steps = np.linalg.norm(np.diff(evidence.centers[rows], axis=0), axis=1)
    # A gap of ten frames is allowed ten steps; frames closer than usual are not held to less.
    lengths = steps / np.maximum(gaps / max(float(np.median(gaps)), 1e-9), 1.0)
    found = []
    for index, (before, after) in enumerate(pairwise(rows)):
        near = lengths[max(0, min(index - WINDOW // 2, len(lengths) - WINDOW)):][:WINDOW]
        ratio = lengths[index] / max(float(np.median(near)), 1e-12)
        if ratio > MAX_STEP:
            found.append(Jump(evidence.names[before], evidence.names[after], float(ratio)))
    return tuple(found)


def _moments(
    names: Sequence[str], times: Mapping[str, float | None]
) -> NDArray[np.float64] | None:
    """Returns when each image was taken, in any unit, [F]; None where that is not known."""
    seconds = [times.get(name) for name in names]
    if all(second is not None for second in seconds):
        return np.array(seconds, np.float64)
    stems = [PurePath(name).stem for name in names]
    if all(stem.isdecimal() for stem in stems):
        return np.array([float(stem) for stem in stems])
    return None


# COLMAP gives an image a camera from 30 inliers on, and in six of eight captures 19 of 20 images
# had a fifth of their keypoints or more in the model. The fewest of any image with a camera: 450.
MIN_KEYPOINTS = 150
# Share of the median sharpness below which an image is called blurred: the bound that `recon
# ingest` sets itself (IngestConfig.sharpness).
BLURRED = 0.5


def reasons(evidence: Evidence, sharpness: Mapping[str, float | None]) -> dict[str, str]:
    """Returns a reason for every image without a camera, the most telling one of each.

    Args:
        evidence: of the model.
        sharpness: variance of the Laplacian by name; None or absent where it is not known.
    """
    known = [value for value in sharpness.values() if value is not None]
    usual = float(np.median(known)) if known else None
    return {
        evidence.names[index]: _reason(evidence, int(index), sharpness, usual)
        for index in np.flatnonzero(~evidence.registered)
    }


def _reason(
    evidence: Evidence, index: int, sharpness: Mapping[str, float | None], usual: float | None
) -> str:
    of = (evidence.pairs == index).any(axis=1)
    others = evidence.pairs[of].sum(axis=1) - index
    placed, matches = evidence.registered[others], evidence.matches[of]
    blur = _blur(sharpness.get(evidence.names[index]), usual)
    # A blurred image matches little. One that matches others well may show another room.
    if blur and matches[~placed].sum() <= matches[placed].sum():
        return f"blurred: {blur}"
    if evidence.keypoints[index] < MIN_KEYPOINTS:
        return f"too few features: {evidence.keypoints[index]} keypoints"
    if not placed.any():
        where = f", only with {len(others)} that have none" if len(others) else ""
        also = f"; {blur}" if blur else ""
        return f"no overlap: no verified match with an image that has a camera{where}{also}"
    return (f"matched but not placed: {matches[placed].sum()} matches to "
            f"{np.count_nonzero(placed)} images that have a camera")


def _blur(own: float | None, usual: float | None) -> str:
    """Returns how sharp an image is that is far less sharp than usual; empty for others."""
    if own is None or usual is None or own >= BLURRED * usual:
        return ""
    return f"sharpness {own:.0f}, {usual:.0f} is usual"
