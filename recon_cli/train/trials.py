"""Short paired runs that decide whether an optional part of training pays on this scene.

Both arms train on the same views from the same seed, and are scored on the same views that neither
trained on; only the part in question differs. A cheap sign comes first, so that most scenes pay
nothing (`skipped`). Test views are never touched.

Scores are taken after the best gain per channel (`corrected_psnr`), for both arms alike. The
exposure of a view that was not trained on is unknown, and no arm may win or lose by it. Without
that, gains for each image would lose wherever they are right: on a walk from a window into a room
(gains of a spread of .25) the plain PSNR of held-out views falls from 26.5 to 18.7 dB, and the
corrected one rises from 26.9 to 27.1 dB.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# A gain under this is not worth a part that can go wrong. Two runs that differed by their seed
# alone were .07 +- .06 dB apart (17 views, 500 steps at 200 pixels): the errors decide as well.
THRESHOLD_DB = 0.05
_ERRORS = 1.65  # standard errors, a chance of about one in twenty
LEAST_VIEWS = 8  # whose mean has a standard error that can be told; fewer, and the split is own
_SPLIT = 6  # each sixth training view is held out by an own split, or sooner each third or more
_DENSEST = 3  # of few views; what is left must still hang together
_MOST_DB = 100.0  # of equal images, as in metrics

Arm = Callable[[], Sequence[float]]


@dataclass(frozen=True)
class Decision:
    """What a trial found.

    Attributes:
        name: of the part.
        on: it pays.
        mean_db: mean gain over the views in dB; None where nothing was tried.
        standard_error_db: of that mean.
        reason: one sentence for the log.
        seconds: spent.
    """

    name: str
    on: bool
    mean_db: float | None
    standard_error_db: float | None
    reason: str
    seconds: float


def skipped(name: str, reason: str) -> Decision:
    """Returns the decision against a part that nothing speaks for, untried."""
    return Decision(name, False, None, None, reason, 0.0)


def decide(
    name: str, arms: tuple[Arm, Arm], *, threshold_db: float = THRESHOLD_DB,
    clock: Callable[[], float] = time.perf_counter,
) -> Decision:
    """Returns whether the second arm is better than the first.

    On, if the mean gain is above the threshold and above 1.65 standard errors of it. The standard
    error is that of paired differences: views differ by decibels, arms on one view by tenths.

    Args:
        name: of the part.
        arms: without and with it; each trains and returns the scores of the same views in the same
            order, in dB.
        threshold_db: smallest gain that counts.
        clock: tells seconds.

    Raises:
        ValueError: the arms score different numbers of views, or fewer than two.
    """
    start = clock()
    without, with_it = (np.asarray(arm(), np.float64) for arm in arms)
    if without.shape != with_it.shape or len(without) < 2:
        raise ValueError(f"arms with {without.shape} and {with_it.shape} scores")
    gains = with_it - without
    mean = float(gains.mean())
    error = float(gains.std(ddof=1)) / math.sqrt(len(gains))
    needed = max(threshold_db, _ERRORS * error)
    on = mean > needed  # False for what is not a number
    reason = (f"{mean:+.2f} dB +- {error:.2f} over {len(gains)} views, "
              f"{'more' if on else 'not more'} than the {needed:.2f} dB that count")
    return Decision(name, on, mean, error, reason, clock() - start)


@dataclass(frozen=True)
class Split:
    """Which views a trial trains on and which it scores, as indices.

    Attributes:
        train: into the training views.
        held_out: into the validation views, or into the training views where `own`.
        own: the validation views were too few; the final run trains on the held-out ones again.
    """

    train: tuple[int, ...]
    held_out: tuple[int, ...]
    own: bool


def split(training: int, validation: int) -> Split | None:
    """Returns the views of a trial; None where there are too few for any.

    The validation views, where they are LEAST_VIEWS or more. Otherwise each sixth training view
    (down to each third, where they would be fewer than LEAST_VIEWS), from the middle of the first
    interval on; the final run then trains on all of them.

    Args:
        training: number of training views, in the order of the capture.
        validation: number of validation views.
    """
    if validation >= LEAST_VIEWS:
        return Split(tuple(range(training)), tuple(range(validation)), own=False)
    step = max(_DENSEST, min(_SPLIT, training // LEAST_VIEWS))
    held_out = tuple(range(step // 2, training, step))
    if len(held_out) < LEAST_VIEWS:
        return None
    train = tuple(i for i in range(training) if i not in held_out)
    return Split(train, held_out, own=True)


def corrected_psnr(
    image: NDArray[np.float32], truth: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None
) -> float:
    """Returns the PSNR in dB of an image after the gain per channel that fits it best.

    The gain is that of least squares; the result is clamped to [0, 1] as in the plain score.

    Args:
        image: [H, W, 3] rendered.
        truth: [H, W, 3].
        mask: [H, W], True where a pixel counts; None where all do.
    """
    shown, true = image.astype(np.float64).reshape(-1, 3), truth.reshape(-1, 3) / 255.0
    if mask is not None:
        shown, true = shown[mask.reshape(-1)], true[mask.reshape(-1)]
    energy = (shown * shown).sum(axis=0)
    gain = np.where(energy > 0, (shown * true).sum(axis=0) / np.maximum(energy, 1e-30), 1.0)
    error = float(np.mean((np.clip(shown * gain, 0, 1) - true) ** 2))
    return float(-10 * np.log10(max(error, 10 ** (-_MOST_DB / 10))))
