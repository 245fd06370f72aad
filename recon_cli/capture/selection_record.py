"""The record of the selection: every candidate frame, and why it was chosen or not."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.workspace import atomic

CHOICE = "choice.json"


class Reason(StrEnum):
    """What became of a frame."""

    KEPT = "kept"
    DAMAGED = "damaged"
    CLIPPED = "clipped"
    BLURRED = "blurred"
    DUPLICATE = "duplicate"
    CLOSE = "close"


MEANINGS = {
    Reason.KEPT: "kept",
    Reason.DAMAGED: "damaged or unreadable",
    Reason.CLIPPED: "mostly black, blown out or flat",
    Reason.BLURRED: "less sharp than those around it",
    Reason.DUPLICATE: "same view as a kept one",
    Reason.CLOSE: "too close to a kept one",
}


@dataclass(frozen=True)
class FrameCandidate:
    """One frame of a capture."""

    source: str  # file name
    index: int  # in that video, or among the photos of that folder
    reason: Reason
    sharpness: float | None  # None where it could not be read
    name: str | None = None  # of the stored frame, None where it was not kept
    like: int | None = None  # the kept frame that a duplicate equals, or nearest to one too close


def video_candidates(
    source: str,
    sharpness: NDArray[np.float64],  # [F]
    refused: Sequence[Reason | None],  # [F]
    lengths: NDArray[np.float64],  # [F]
    names: dict[int, str],
    *,
    same: float,
) -> tuple[FrameCandidate, ...]:
    """Returns the record of a selection among the frames of a video.

    Args:
        source: name of the video.
        sharpness: of each frame.
        refused: why a frame could not be chosen, None where it could.
        lengths: of the path up to each frame, in widths of the image.
        names: of the stored frames by index; at least one.
        same: path lengths that differ by no more than this are the same view.
    """
    chosen = np.array(sorted(names))
    candidates = []
    for index, reason in enumerate(refused):
        nearest, like = int(chosen[np.argmin(np.abs(lengths[chosen] - lengths[index]))]), None
        if index in names:
            became = Reason.KEPT
        elif reason is not None:
            became = reason
        else:
            like = nearest
            still = abs(lengths[nearest] - lengths[index]) <= same
            became = Reason.DUPLICATE if still else Reason.CLOSE
        candidates.append(FrameCandidate(
            source, index, became, round(float(sharpness[index]), 2), names.get(index), like))
    return tuple(candidates)


def count_reasons(candidates: Sequence[FrameCandidate]) -> dict[str, int]:
    """Returns how many candidates each reason has, in the order of `Reason`, without zeros."""
    numbers = Counter(candidate.reason for candidate in candidates)
    return {reason.value: numbers[reason] for reason in Reason if numbers[reason]}


def write_choice(path: Path, candidates: Sequence[FrameCandidate]) -> None:
    """Writes the record of a selection as JSON."""
    atomic.write_json(path, {
        "counts": count_reasons(candidates),
        "meanings": {reason.value: text for reason, text in MEANINGS.items()},
        "candidates": [dataclasses.asdict(candidate) for candidate in candidates],
    })
