"""A histogram of counts: whole numbers, few bins, readable as JSON."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

BINS = 10


@dataclass(frozen=True)
class Histogram:
    """How often counts fall between edges.

    Attributes:
        edges: bin k holds the counts from edges[k] up to, but without, edges[k + 1].
        counts: one less than there are edges.
        median: of all counts; zero where there are none.
    """

    edges: tuple[int, ...]
    counts: tuple[int, ...]
    median: float

    @classmethod
    def of(cls, values: NDArray[np.int64]) -> Histogram:
        """Returns the histogram of whole numbers, [N], from zero up, in ten bins of one width."""
        top = int(values.max()) if len(values) else 0
        width = top // BINS + 1
        counts = np.bincount(values // width, minlength=BINS)
        return cls(
            tuple(range(0, (BINS + 1) * width, width)),
            tuple(int(count) for count in counts),
            float(np.median(values)) if len(values) else 0.0)

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> Histogram:
        """Returns a histogram whose fields came as lists."""
        return cls(tuple(value["edges"]), tuple(value["counts"]), value["median"])
