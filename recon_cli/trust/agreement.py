"""How well expected errors agree with real ones: sparsification and reliability.

AUSE is the area between two sparsification curves (Ilg et al. 2018, "Uncertainty Estimates and
Multi-Hypotheses Networks for Optical Flow"): the mean error of what is left when pixels are removed
in the order of the expected error, and in that of the real error (the oracle); errors are over the
mean of the view. 0 is the oracle's order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

STEPS = 100  # of a curve
BINS = 10  # of a reliability plot, of equally many pixels

Array = NDArray[np.float64]


def sparsification(errors: Array, order: Array) -> Array:
    """Returns the curve [STEPS]: mean error over that of all once k / STEPS are removed.

    `errors` and `order` are [P]; those of the largest `order` go first.
    """
    ranked = errors[np.argsort(-order, kind="stable")]
    sums = np.concatenate([[0.0], np.cumsum(ranked)])
    removed = (np.arange(STEPS) / STEPS * len(errors)).astype(int)
    left = (sums[-1] - sums[removed]) / (len(errors) - removed)
    return np.asarray(left / max(float(errors.mean()), 1e-12))


def ause(errors: Array, *orders: Array) -> tuple[float, ...]:
    """Returns the areas between the curve of each of `orders` and the oracle's; all are [P]."""
    oracle = sparsification(errors, errors)
    return tuple(float((sparsification(errors, order) - oracle).mean()) for order in orders)


@dataclass(frozen=True)
class Reliability:
    """Expected against real errors in bins of equally many pixels, the most trusted first."""

    expected: tuple[float, ...]
    real: tuple[float, ...]

    @property
    def gap(self) -> float:
        """Mean of |expected - real| / real over the bins."""
        expected, real = np.array(self.expected), np.array(self.real)
        return float((np.abs(expected - real) / np.maximum(real, 1e-9)).mean())


def reliability(errors: Sequence[Array], expected: Sequence[Array]) -> Reliability:
    """Returns the reliability over all pixels of some views, [P] each."""
    actual_error, expected_error = np.concatenate(errors), np.concatenate(expected)
    bins = np.array_split(np.argsort(expected_error, kind="stable"), BINS)
    return Reliability(tuple(float(expected_error[rows].mean()) for rows in bins),
                       tuple(float(actual_error[rows].mean()) for rows in bins))
