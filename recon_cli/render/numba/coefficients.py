"""Rows of higher SH coefficients in memory, and planes of them in scratch.

Rows are `stride` numbers long, 9, 24 or 45, and only the first Gaussians have one; none of these is
a multiple of LANES. Nothing is read or written behind the last row.
"""

from __future__ import annotations

import numpy as np

from recon_cli.render.numba.kernel import inlined
from recon_cli.render.numba.lane_functions import fill
from recon_cli.render.numba.lane_memory import copy, store, transpose
from recon_cli.render.numba.lanes import LANES


@inlined
def terms_of_group(ids, first, sh_rest, stride, terms):
    """Returns how many higher SH terms a group uses: none where no Gaussian of it has any.

    ids ascend, and the Gaussians that have coefficients come first.
    """
    return terms if stride * np.int64(ids[first]) < len(sh_rest) else 0


@inlined
def rows_to_planes(sh_rest, stride, ids, first, count, terms, scratch, plane, spare):
    """Fills planes from `plane` on with coefficients, zeros where a Gaussian has none.

    LANES planes from `spare` on are overwritten.
    """
    if stride < LANES:  # a vector would reach beyond the row, and behind the last one there is none
        for k in range(LANES):
            row = stride * np.int64(ids[first + min(k, count - 1)])
            for c in range(3 * terms):
                scratch[(plane + c) * LANES + k] = (
                    sh_rest[row + c] if row < len(sh_rest) else np.float32(0))
        return
    for block in range(0, 3 * terms, LANES):
        at = min(block, stride - LANES)
        for k in range(LANES):
            row = stride * np.int64(ids[first + min(k, count - 1)])
            if row < len(sh_rest):
                copy(sh_rest, row + at, scratch, (spare + k) * LANES)
            else:
                store(scratch, (spare + k) * LANES, fill(0.0))
        transpose(scratch, spare * LANES, scratch, (plane + at) * LANES)


@inlined
def planes_to_rows(scratch, plane, spare, terms, ids, first, count, slot_start, sh_rest, stride):
    """Writes planes from `plane` on to the rows of those that were seen and have coefficients."""
    if stride < LANES:
        for k in range(count):
            row = stride * np.int64(ids[first + k])
            if row < len(sh_rest) and slot_start[first + k + 1] > slot_start[first + k]:
                for c in range(3 * terms):
                    sh_rest[row + c] = scratch[(plane + c) * LANES + k]
        return
    for block in range(0, 3 * terms, LANES):
        at = min(block, stride - LANES)
        transpose(scratch, (plane + at) * LANES, scratch, spare * LANES)
        for k in range(count):
            row = stride * np.int64(ids[first + k])
            if row < len(sh_rest) and slot_start[first + k + 1] > slot_start[first + k]:
                copy(scratch, (spare + k) * LANES, sh_rest, row + at)
