"""Steps of the camera that are far longer than its others: where a walk is torn apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import PurePath

import numpy as np
from numpy.typing import NDArray

from recon_cli.mapping.evidence import Evidence

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
