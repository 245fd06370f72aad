"""Whether an optional part pays: two short runs, scored on views that neither trained on."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from recon_cli.workspace.summaries import TrialDecision

# A gain under this is not worth a part that can go wrong. Two runs that differed by their seed
# alone were .07 +- .06 dB apart (17 views, 500 steps at 200 pixels): the errors decide as well.
THRESHOLD_DB = 0.05
_ERRORS = 1.65  # standard errors, a chance of about one in twenty
_ERRORS_AGAINST = 1.0  # of a loss; what is on without a trial needs less to go off
LEAST_SCORED = 8  # whose mean has a standard error that can be told; fewer, and the split is own
# Each third to sixth training view is held out by an own split; the rest must still hang together.
_SPLIT = (3, 6)

Arm = Callable[[], Sequence[float]]
NO_TIME = "there was no time to try it"  # the reason of what is decided without


@dataclass(frozen=True)
class Rule:
    """When the gain of a part counts."""

    threshold_db: float = THRESHOLD_DB
    errors: float = _ERRORS  # standard errors that it must exceed as well
    # on as long as the mean is not below zero by the threshold and one standard error, and where
    # there is no time to try it
    unless_worse: bool = False
    as_filmed: bool = False  # brightness as filmed counts as much as after the best gains

    def needed_db(self, error: float) -> float:
        """Returns the mean gain that is needed at its standard error, both in dB."""
        if self.unless_worse:
            return -max(self.threshold_db, _ERRORS_AGAINST * error)
        return max(self.threshold_db, self.errors * error)


def skip_trial(name: str, reason: str, *, on: bool = False) -> TrialDecision:
    """Returns the decision on a part that is not tried; against it where nothing speaks for it."""
    return TrialDecision(
        name=name, on=on, mean_db=None, standard_error_db=None, reason=reason, seconds=0.0)


def decide(
    name: str, arms: tuple[Arm, Arm], rule: Rule | None = None, *,
    clock: Callable[[], float] = time.perf_counter,
) -> TrialDecision:
    """Returns whether the second arm is better than the first by the rule.

    Each arm, without and with the part, trains and returns the scores of the same views in dB,
    whose paired differences count.

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
    needed = (rule or Rule()).needed_db(error)
    on = mean > needed  # False for what is not a number
    reason = (f"{mean:+.2f} dB +- {error:.2f} over {len(gains)} views, "
              f"{'more' if on else 'not more'} than the {needed:.2f} dB that count")
    return TrialDecision(
        name=name, on=on, mean_db=mean, standard_error_db=error, reason=reason,
        seconds=clock() - start)


@dataclass(frozen=True)
class Split:
    """Which views a trial trains on and which it scores, as indices."""

    train: tuple[int, ...]  # into the training views
    held_out: tuple[int, ...]  # into the validation views, or into the training views where `own`
    own: bool  # the validation views were too few; the final run trains on the held-out ones again


def split(training: int, validation: int) -> Split | None:
    """Returns the views of a trial; None where there are too few for any.

    The validation views are scored if there are LEAST_SCORED. Otherwise each sixth training view in
    the order of the capture is, down to each third; the final run then trains on all of them.
    """
    if validation >= LEAST_SCORED:
        return Split(tuple(range(training)), tuple(range(validation)), own=False)
    step = max(_SPLIT[0], min(_SPLIT[1], training // LEAST_SCORED))
    held_out = tuple(range(step // 2, training, step))
    if len(held_out) < LEAST_SCORED:
        return None
    train = tuple(i for i in range(training) if i not in held_out)
    return Split(train, held_out, own=True)
