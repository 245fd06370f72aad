"""Codebooks for numbers and palettes for vectors, by seeded k-means."""

from __future__ import annotations

import math
import warnings
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from recon_cli.splats.values import Floats

BOOK = 256  # values of a byte
_SAMPLE = 1 << 16  # numbers that a codebook is fitted to; more change nothing
# Rows that a group is fitted to, on the mean: their mean errs by a 64th of the group's own spread.
_ROWS_A_GROUP = 64
_PAIRS = 1 << 26  # of rows and centres that are compared at a time: 256 MB
_BOOK_ROUNDS = 20
_ROUNDS = 4  # 10 leave 1% less squared error, and take twice as long
_Float = TypeVar("_Float", np.float32, np.float64)


def fit_codebook(values: Floats, rng: np.random.Generator) -> Floats:
    """Returns 256 ascending numbers that represent at least one value.

    Lloyd's algorithm from 128 quantiles and 128 even steps; `rng` draws a sample of many values.
    """
    flat = values.ravel().astype(np.float64)  # whose squares neither underflow nor overflow
    ends = (float(flat.min()), float(flat.max()))
    if flat.size > _SAMPLE:
        flat = np.append(rng.choice(flat, _SAMPLE, replace=False), ends)
    start = np.unique(np.concatenate([
        np.quantile(flat, np.linspace(0, 1, BOOK // 2)), np.linspace(*ends, BOOK // 2)]))
    centres = fit_centres_on_line(np.sort(flat), start, _BOOK_ROUNDS)
    return np.pad(centres, (0, BOOK - len(centres)), mode="edge").astype(np.float32)


def nearest_entries(values: Floats, book: Floats) -> NDArray[np.uint8]:
    """Returns the index of the nearest number of an ascending codebook for each value."""
    wide = book.astype(np.float64)
    return np.searchsorted((wide[1:] + wide[:-1]) / 2, values).astype(np.uint8)


def fit_palette(
    rows: Floats, size: int, rng: np.random.Generator
) -> tuple[Floats, NDArray[np.int64]]:
    """Returns at most `size` representative rows [P, D] and the index of that of each row [M].

    Two levels of k-means: about sqrt(size) groups first, then each by itself, with a share of the
    palette in proportion to its squared error. Duplicate rows count once; `rng` draws the starts.
    """
    # as texts of bytes: six times as fast as by axis=0
    texts = np.ascontiguousarray(rows + np.float32(0)).view(f"S{rows.shape[1] * rows.itemsize}")
    _, first, copies = np.unique(texts, return_index=True, return_inverse=True)
    rows = rows[first]
    peak = max(float(np.abs(rows).max()), float(np.finfo(np.float32).tiny))
    rows = rows / np.float32(peak)  # so that no square overflows
    from scipy.cluster.vq import vq  # half a second, which reading does not need

    groups, errors = _group_rows(rows, max(1, round(math.sqrt(size))), rng)
    shares = errors / max(errors.sum(), np.finfo(np.float64).tiny)
    spare = size - len(shares)
    entries: list[Floats] = []
    labels = np.zeros(len(rows), np.int64)
    total = 0
    for group, share in enumerate(shares):
        members = np.flatnonzero(groups == group)
        if not len(members):
            continue
        wanted = min(1 + int(share * spare), max(1, _PAIRS // len(members)))
        centres = _lloyd(rows[members], _choose_starts(rows[members], wanted, rng), _ROUNDS)
        nearest, _ = vq(rows[members], centres, check_finite=False)
        used, own = np.unique(nearest, return_inverse=True)
        entries.append(centres[used])
        labels[members] = total + own
        total += len(used)
    return np.concatenate(entries) * np.float32(peak), labels[copies.ravel()]


def _group_rows(
    rows: Floats, count: int, rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Returns the group of each row [M] and the squared error of each group."""
    from scipy.cluster.vq import vq

    sample = rows[np.sort(
        rng.choice(len(rows), min(len(rows), count * _ROWS_A_GROUP), replace=False))]
    centres = _lloyd(sample, _choose_starts(sample, count, rng), _ROUNDS)
    parts = [vq(rows[at:at + _SAMPLE], centres, check_finite=False)
             for at in range(0, len(rows), _SAMPLE)]
    groups = np.concatenate([part[0] for part in parts]).astype(np.int64)
    squares = np.concatenate([part[1] for part in parts]).astype(np.float64) ** 2
    return groups, np.bincount(groups, squares, len(centres)).astype(np.float64)


def _choose_starts(rows: Floats, count: int, rng: np.random.Generator) -> Floats:
    """Returns initial centres: drawn half uniformly, half by squared distance from the mean."""
    far = ((rows - rows.mean(axis=0)) ** 2).sum(axis=1, dtype=np.float64)
    weights = far.mean() + far if far.any() else np.ones(len(far))
    count = min(count, len(rows))
    return rows[np.sort(rng.choice(len(rows), count, replace=False, p=weights / weights.sum()))]


def fit_centres_on_line(
    values: NDArray[np.float64], centres: NDArray[np.float64], rounds: int
) -> NDArray[np.float64]:
    """Returns ascending centres of ascending numbers, each of which belongs to one run of them."""
    for _ in range(rounds):
        ends = np.searchsorted(values, (centres[1:] + centres[:-1]) / 2)
        starts, counts = np.append(0, ends), np.diff(np.append(0, ends), append=len(values))
        used = counts > 0  # a centre without numbers keeps its value
        moved = centres.copy()
        moved[used] = np.add.reduceat(values, starts[used]) / counts[used]
        if np.array_equal(moved, centres):
            break
        centres = moved
    return centres


def _lloyd(rows: NDArray[_Float], start: NDArray[_Float], rounds: int) -> NDArray[_Float]:
    from scipy.cluster.vq import kmeans2

    with warnings.catch_warnings():  # a centre without rows keeps its value
        warnings.simplefilter("ignore", UserWarning)
        centres, _ = kmeans2(
            rows, start, iter=rounds, minit="matrix", missing="warn", check_finite=False)
    return np.asarray(centres, rows.dtype)
