"""Whether a model lays two places over each other: two groups of images that should look alike.

See `overlap` for why the matches cannot tell.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon_cli.mapping import graph
from recon_cli.mapping.evidence import Evidence
from recon_cli.mapping.graph import Cut
from recon_cli.mapping.overlap import MIN_CELLS, Overlap

# A group of less than this share of the cameras is not half of a doubled place; a few images that
# are blurred or show people match badly too.
MIN_SIDE = 0.1


@dataclass(frozen=True)
class Fold:
    """The two groups of images that show least of what they should show in common.

    Attributes:
        share: of the cells that should look alike, those that do; None where it cannot be told.
        reason: why it cannot be told; empty otherwise.
        sides: names of the images of both groups, the smaller one first.
        cells: that should look alike.
    """

    share: float | None
    reason: str
    sides: tuple[tuple[str, ...], tuple[str, ...]]
    cells: int


def find(evidence: Evidence, overlap: Overlap) -> Fold:
    """Returns the cut of the cameras across which the least share of the cells is found."""
    rows = np.flatnonzero(evidence.registered)
    inner = np.ix_(rows, rows)
    expected, found = overlap.expected[inner], overlap.found[inner]
    cut, share = None, np.inf
    for order in (
        *graph.disputed_orders(found, expected), *graph.loose_orders(expected),
        *graph.loose_orders(evidence.shared[inner].astype(np.float64)),
    ):
        cells = graph.sweep(expected, order)
        shares = np.where(
            (cells >= MIN_CELLS) & _even(len(rows)),
            graph.sweep(found, order) / np.maximum(cells, 1), np.inf)
        if shares.min() < share:
            cut, share = order[:int(shares.argmin()) + 1], float(shares.min())
    if cut is None:
        reason = f"no two groups of cameras should show the same in {MIN_CELLS} places"
        return Fold(None, reason, ((), ()), 0)
    side = np.zeros(len(rows), np.bool_)
    side[cut] = True
    first, second = sorted(
        (tuple(evidence.names[row] for row in rows[part]) for part in (side, ~side)), key=len)
    return Fold(share, "", (first, second), int(graph.across(expected, side)))


def _even(count: int) -> Cut:
    """Returns which cuts of a sweep leave enough images on both sides, [count - 1]."""
    head = np.arange(1, count)
    return np.asarray(np.minimum(head, count - head) > MIN_SIDE * count)
