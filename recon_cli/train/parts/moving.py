"""Searches the regions of views that move, by short runs before the training.

First some views are compared with a model that a trial has trained anyway; in most captures nothing
moves, and that is all. Otherwise all are searched, and twice more: by a model trained without the
regions of the first search, and by one of finer images without those of the second.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from recon_cli.config.stages import RunConfig
from recon_cli.deadline import Deadline, OutOfTime
from recon_cli.io.images import reduce_to, reduce_view
from recon_cli.io.views import evenly_spread
from recon_cli.scene.splats import Splats
from recon_cli.scene.statistics import MIN_OBSERVATIONS
from recon_cli.scene.train_view import TrainView, leaves_enough
from recon_cli.train.masks import Regions, enlarge, hide
from recon_cli.train.parts.decisions import NO_TIME, Rule, decide, skip_trial
from recon_cli.train.parts.moving_regions import SURE, ComparedView, compare_view, find_moving
from recon_cli.train.parts.part import LEVEL, SEARCH_SIDE, SEARCHED_VIEWS, Part, Sign, TrialScene
from recon_cli.workspace.summaries import TrialDecision

if TYPE_CHECKING:
    from recon_cli.train.parts.trials import Trials

FINER = 2  # times as large are the images of the last round as those of the first
# Of them must show what moves. Where nothing moves it was up to 4%, from things near the border of
# few views that a short model lacks; of people in a third of the views 15% and more were found.
_DETECTED = 0.08
_MOST = 0.25  # of all pixels; more are not people who walk through, but a model that is wrong
# How far beyond the spread of the others a region is that is masked, once there is a sign that
# something moves. The spread is then larger, as the model has ghosts: with 12, as for the sign, two
# fifths to three quarters of people in office were found by the second model, with 5 four fifths
# and all; other pixels that were masked grew from .9 and 2.0 to 2.5 and 2.3%.
_LIKELY = 5.0

_LEAST_STEPS = 1000  # of a run that gets masks: in a shorter one few Gaussians follow what moves
# Trains on views, reduced to this side, and returns the model
Probe = Callable[[Sequence[TrainView], int], Splats]

logger = logging.getLogger("recon")


@dataclass(frozen=True, eq=False)
class ViewComparer:
    """How views are compared with a model."""

    sh_degree: int
    backend: str

    def regions(
        self, splats: Splats, views: Sequence[TrainView], side: int = SEARCH_SIDE, *,
        agreed: float = _LIKELY,
    ) -> Regions:
        """Returns where each view shows what moves, at its size reduced to `side` pixels."""
        return find_moving(self.compare(splats, views, side), agreed=agreed)

    def compare(
        self, splats: Splats, views: Sequence[TrainView], side: int = SEARCH_SIDE
    ) -> list[ComparedView]:
        """Returns views, reduced to `side` pixels, beside their renders."""
        return [compare_view(splats, view, self.sh_degree, self.backend, side=side)
                for view in views]


def preview_rows(count: int) -> NDArray[np.int64]:
    """Returns which of `count` views are compared first, evenly spread."""
    return np.unique(np.linspace(0, count - 1, SEARCHED_VIEWS).round().astype(np.int64))


def find_detections(compared: Sequence[ComparedView]) -> NDArray[np.bool_]:
    """Returns which of some views surely show something that moves."""
    return np.array([region.any() for region in find_moving(compared, agreed=SURE)])


def have_evidence(detections: NDArray[np.bool_]) -> bool:
    """Returns whether so many views show something that moves that masks are worth a search."""
    return int(detections.sum()) >= max(MIN_OBSERVATIONS, _DETECTED * len(detections))


def search(
    splats: Splats, views: Sequence[TrainView], training: Sequence[int], comparer: ViewComparer,
    probe: Probe,
) -> Regions:
    """Returns where each view shows what moves, by models that get better.

    Args:
        splats: the first model.
        views: all that are compared; those in the rows `training` are trained on.
        training: see there.
        comparer: how they are compared.
        probe: trains on views without their regions.
    """
    views = [reduce_to(view, FINER * SEARCH_SIDE) for view in views]
    regions = comparer.regions(splats, views)
    for side in (SEARCH_SIDE, FINER * SEARCH_SIDE):
        if not any(region.any() for region in regions):
            break
        masked = hide(views, regions)
        better = probe([masked[row] for row in training if leaves_enough(masked[row].mask)], side)
        # the views as they are: who is found no more is trained on again
        regions = comparer.regions(better, views, side)
        logger.info("moving: %.1f%% of the pixels of %d of %d views", 100 * share_of(regions),
                    sum(region.any() for region in regions), len(views))
    return regions


def find_in_held_out(
    splats: Splats, held_out: Sequence[TrainView], training: Sequence[TrainView],
    comparer: ViewComparer,
) -> Regions:
    """Returns where held-out views contradict those that a model was trained on, [H, W] each."""
    compared, witnesses = (comparer.compare(splats, views, FINER * SEARCH_SIDE)
                           for views in (held_out, evenly_spread(training, SEARCHED_VIEWS)))
    return [enlarge(region, view.camera.width, view.camera.height)
            for region, view in zip(find_moving(compared, witnesses), held_out, strict=True)]


def share_of(regions: Sequence[NDArray[np.bool_]]) -> float:
    """Returns the mean share of the pixels of a view."""
    return float(np.mean([region.mean() for region in regions])) if regions else 0.0


def is_plausible(regions: Sequence[NDArray[np.bool_]]) -> bool:
    """Returns whether the regions are few enough to be people and things that were moved."""
    return bool(share_of(regions) <= _MOST)


def _is_wanted(scene: TrialScene) -> bool:
    """Returns whether what moves is searched.

    What is compared with tables of the literature sees what they saw.
    """
    config = scene.config
    return config.moving == "on" or (
        config.moving == "auto" and config.densify != "reference"
        and config.iterations >= _LEAST_STEPS)


def _settle(trials: Trials, config: RunConfig) -> str:
    """Leaves the masks that pay in `trials`."""
    start = time.perf_counter()
    if config.moving == "on":  # asked for, whatever it takes
        trials.deadline = Deadline()
    try:
        # renders are compared as they are: corners are to be as dark in the model as in the photos
        decision, regions = _find_masks(trials, replace(config, vignette="off"))
        decision = replace(decision, seconds=time.perf_counter() - start)
    except OutOfTime:
        decision, regions = skip_trial("moving", NO_TIME), []
    trials.decisions.append(decision)
    trials.masks = regions if decision.on else None
    return config.moving


def _find_masks(trials: Trials, config: RunConfig) -> tuple[TrialDecision, Regions]:
    """Returns whether masks pay, and where each view shows what moves."""
    task, views = trials.task, trials.views
    if trials.split is None:
        return skip_trial("moving", "there are too few views to tell"), []
    comparer = ViewComparer(config.sh_degree, task.backend)
    # by which views are reduced, to no less than those that are compared
    level = max(1, min(LEVEL, round(_longest(views[0]) / SEARCH_SIDE)))
    model = trials.model(config, level)
    order = np.argsort(trials.scene.names) if trials.scene.names else np.arange(len(views))
    rows = order[preview_rows(len(views))]
    begun = trials.deadline.spent
    detections = find_detections(comparer.compare(model, [views[row] for row in rows]))
    each = (trials.deadline.spent - begun) / len(rows)  # seconds of a view
    if config.moving != "on" and not have_evidence(detections):
        return skip_trial("moving", f"{detections.sum()} of {len(detections)} views contradict the "
                          "others"), []
    # the search compares twice at the first size and once at a larger one, and makes two models
    trials.deadline.refuse_late(
        (2 + FINER**2) * each * len(views) + (1 + FINER) * trials.longest)
    regions = search(
        model, views, range(len(task.train)), comparer, partial(_train_finer, trials, config))
    if not any(region.any() for region in regions):
        decision = skip_trial("moving", "what contradicted other views was not found again")
    elif not is_plausible(regions):
        decision = skip_trial("moving", f"{share_of(regions):.0%} of the pixels contradict "
                              "other views, too many to be people or things")
    elif config.moving == "on":
        decision = skip_trial("moving", "asked for", on=True)
    else:
        decision = _try_masks(trials, config, level, hide(views, regions))
    return decision, regions


def _longest(view: TrainView) -> int:
    return max(view.camera.width, view.camera.height)


def _train_finer(
    trials: Trials, config: RunConfig, views: Sequence[TrainView], side: int
) -> Splats:
    """Returns a model of views reduced to `side` pixels, and of as many more Gaussians."""
    factor = max(1.0, max(map(_longest, views)) / side)
    return trials.fit(config, views, factor=factor, finer=side / SEARCH_SIDE).splats


def _try_masks(
    trials: Trials, config: RunConfig, level: int, masked: list[TrainView]
) -> TrialDecision:
    """Returns whether masks pay in what they leave of the views that are scored.

    They need not gain in these few steps, in which few Gaussians follow what moves.
    """
    held_out = [view for view in trials.held_out(masked)
                if leaves_enough(reduce_view(view, level).mask)]
    if len(held_out) < 2:
        return skip_trial("moving", "too little of the views to score is left")

    def score(splats: Splats) -> list[float]:
        return trials.score(splats, held_out, config.sh_degree, level)

    return decide("moving", (
        lambda: score(trials.model(config, level)),
        lambda: score(trials.fit(config, trials.trained_on(masked), factor=level).splats)),
        Rule(unless_worse=True))


PART = Part("moving", lambda _: Sign(), is_open=_is_wanted, settle=_settle)
