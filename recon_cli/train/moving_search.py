"""Searches the regions of views that move, by short runs before the training.

The first look is at some views and a model that a trial has trained anyway; in most captures
nothing moves, and that is all. Otherwise the masks are found anew twice: by a model trained
without the regions of the first look, and by one of finer images without those of the second.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.io.images import fill_masked, reduce_view
from recon_cli.io.views import evenly_spread
from recon_cli.scene.splats import Splats
from recon_cli.scene.train_view import TrainView, leaves_enough
from recon_cli.train.moving import SIDE, SURE, ComparedView, compare_view, find_moving

FINER = 2  # times as large are the images of the last round as those of the first
_FIRST_LOOK = 60  # views, evenly spread
# Of them must show what moves. Where nothing moves it was up to 4%, from things near the border of
# few views that a short model lacks; of people in a third of the views 15% and more were found.
_SIGN, _LEAST_SIGN = 0.08, 3
_MOST = 0.25  # of all pixels; more are not people who walk through, but a model that is wrong
# How far beyond the spread of the others a region is that is masked, once there is a sign that
# something moves. The spread is then larger, as the model has ghosts: with 12, as for the sign, two
# fifths to three quarters of people in office were found by the second model, with 5 four fifths
# and all; other pixels that were masked grew from .9 and 2.0 to 2.5 and 2.3%.
_LIKELY = 5.0

Regions = list[NDArray[np.bool_]]
# Trains on views, reduced to this side, and returns the model
Probe = Callable[[Sequence[TrainView], int], Splats]

logger = logging.getLogger("recon")


@dataclass(frozen=True, eq=False)
class Judge:
    """How views are compared with a model."""

    sh_degree: int
    backend: str

    def regions(
        self, splats: Splats, views: Sequence[TrainView], side: int = SIDE, *,
        agreed: float = _LIKELY,
    ) -> Regions:
        """Returns where each view shows what moves, at its size reduced to `side` pixels."""
        return find_moving(self.compare(splats, views, side), agreed=agreed)

    def compare(
        self, splats: Splats, views: Sequence[TrainView], side: int = SIDE
    ) -> list[ComparedView]:
        """Returns views, reduced to `side` pixels, beside their renders."""
        return [compare_view(splats, view, self.sh_degree, self.backend, side=side)
                for view in views]


def first_look(count: int) -> NDArray[np.int64]:
    """Returns which of `count` views are looked at first, evenly spread."""
    return np.unique(np.linspace(0, count - 1, _FIRST_LOOK).round().astype(np.int64))


def find_signs(compared: Sequence[ComparedView]) -> NDArray[np.bool_]:
    """Returns which of some views surely show something that moves."""
    return np.array([region.any() for region in find_moving(compared, agreed=SURE)])


def are_enough(signs: NDArray[np.bool_]) -> bool:
    """Returns whether so many views show something that moves that masks are worth a search."""
    return int(signs.sum()) >= max(_LEAST_SIGN, _SIGN * len(signs))


def search(
    splats: Splats, views: Sequence[TrainView], training: Sequence[int], judge: Judge, probe: Probe
) -> Regions:
    """Returns where each view shows what moves, by models that get better.

    Args:
        splats: the first model.
        views: all that are compared; those in the rows `training` are trained on.
        training: see there.
        judge: how they are compared.
        probe: trains on views without their regions.
    """
    views = [reduce_view(view, max(1.0, max(view.camera.width, view.camera.height)
                                   / (FINER * SIDE))) for view in views]
    regions = judge.regions(splats, views)
    for side in (SIDE, FINER * SIDE):
        if not any(region.any() for region in regions):
            break
        masked = hide(views, regions)
        better = probe([masked[row] for row in training if leaves_enough(masked[row].mask)], side)
        # the views as they are: who is found no more is trained on again
        regions = judge.regions(better, views, side)
        logger.info("moving: %.1f%% of the pixels of %d of %d views", 100 * share_of(regions),
                    sum(region.any() for region in regions), len(views))
    return regions


def find_in_held_out(
    splats: Splats, held_out: Sequence[TrainView], training: Sequence[TrainView], judge: Judge
) -> Regions:
    """Returns where held-out views contradict those that a model was trained on, [H, W] each."""
    compared, witnesses = (judge.compare(splats, views, FINER * SIDE)
                           for views in (held_out, evenly_spread(training, _FIRST_LOOK)))
    return [enlarge(region, view.camera.width, view.camera.height)
            for region, view in zip(find_moving(compared, witnesses), held_out, strict=True)]


def share_of(regions: Sequence[NDArray[np.bool_]]) -> float:
    """Returns the mean share of the pixels of a view."""
    return float(np.mean([region.mean() for region in regions])) if regions else 0.0


def is_plausible(regions: Sequence[NDArray[np.bool_]]) -> bool:
    """Returns whether the regions are few enough to be people and things that were moved."""
    return bool(share_of(regions) <= _MOST)


def hide(views: Sequence[TrainView], regions: Sequence[NDArray[np.bool_]]) -> list[TrainView]:
    """Returns the views without their regions [h, w], which may be of another size."""
    hidden = []
    for view, region in zip(views, regions, strict=True):
        if region.any():
            counts = ~enlarge(region, view.camera.width, view.camera.height)
            if view.mask is not None:
                counts &= view.mask
            image = fill_masked(view.image, counts)
            hidden.append(replace(view, stored=image, mask=counts, file=None))
        else:
            hidden.append(view)
    return hidden


def enlarge(region: NDArray[np.bool_], width: int, height: int) -> NDArray[np.bool_]:
    """Returns a region in another size, with a smooth border."""
    large = cv2.resize(region.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(large > 0.5)
