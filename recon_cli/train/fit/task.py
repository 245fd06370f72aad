"""The task of a fit: the views, at every size that a run asks for, the plan, and the evidence."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon_cli.io.images import reduce_view
from recon_cli.progress import NullProgress, Progress
from recon_cli.scene.cells import Cell
from recon_cli.scene.image_file import ImageFile
from recon_cli.scene.train_view import TrainView
from recon_cli.train.fit.schedule import Schedule

Found = TypeVar("Found")
Tracks = Sequence[NDArray[np.int64]]  # rows of the points that each view sees; empty: not known


@dataclass(frozen=True, eq=False)
class Evidence:
    """What is known of a scene before any training; tasks of reduced views share it."""

    views: Sequence[TrainView]  # to train on, in full size
    points: NDArray[np.float64]  # [P, 3] sparse points, world units
    extent: float  # of the cameras, world units
    # reads which points each view sees; None where nothing is known of how they were found
    tracks: Callable[[], Tracks] | None = None
    progress: Progress = field(default_factory=NullProgress)
    _found: dict[object, Any] = field(default_factory=dict)

    def once(self, search: Callable[..., Found], *options: object) -> Found:
        """Returns what a search finds here; it runs once, and again only where it had no time."""
        if search not in self._found:
            self._found[search] = search(self, *options)
        found: Found = self._found[search]
        return found


@dataclass(frozen=True, eq=False)
class Task:
    """The views to fit and the plan."""

    train: list[TrainView]  # views that gradients come from
    validation: list[TrainView]  # views that are only looked at
    schedule: Schedule  # when things happen
    extent: float  # of the cameras, world units
    backend: str  # name of the rasterizer
    device: torch.device  # where the tensors live
    nearness: float | None = None  # `Scene.nearness`; None where there are no points
    cell: Cell | None = None  # where Gaussians may be added; None: everywhere
    evidence: Evidence | None = None  # None where no more is known than these views
    depth_refused: str = ""  # why no view has sensor depth although the capture has some

    def inside(self, means: Tensor) -> Tensor | float:  # [N, 3] -> [N]
        """Returns 1 for each position where Gaussians may be added, else 0."""
        if self.cell is None:
            return 1.0
        owned = self.cell.owns(means.detach().cpu().numpy())
        return torch.from_numpy(owned).to(means)

    @property
    def means_unit(self) -> float:
        """World units in which the rate of the means is given.

        A walk through a house has a large extent, but what it shows is as near as in one room.
        """
        if self.schedule.recipe.means_unit == "extent" or self.nearness is None:
            return self.extent
        return self.nearness

    def evidence_of(self, points: NDArray[np.float64]) -> Evidence:
        """Returns what is known of the scene, of which these are the sparse points [P, 3]."""
        return self.evidence or Evidence(self.train, points, self.extent)

    @property
    def has_depth(self) -> bool:
        """Whether a sensor measured the depth of any training view."""
        return any(view.depth is not None for view in self.train)

    @cached_property
    def pyramid(self) -> Pyramid:
        """The training views at every size."""
        return Pyramid(self.train, page_locked=self.device.type == "cuda")


def _in_file(view: TrainView, file: ImageFile | None) -> TrainView:
    return view if file is None else replace(view, stored=file.put(view.stored), file=file)


class Pyramid:
    """The training views at every size that a run asks for, made when it does."""

    def __init__(self, views: Sequence[TrainView], *, page_locked: bool = False) -> None:
        self._views, self._page_locked = views, page_locked
        self._at = cache(self._reduced)

    def _reduced(self, index: int, factor: int) -> TrainView:
        full = self._views[index]
        view = _in_file(reduce_view(full, factor), full.file)
        return view.page_locked() if self._page_locked else view

    def view(self, index: int, factor: int) -> TrainView:
        """Returns a view reduced by a factor."""
        return self._views[index] if factor == 1 else self._at(index, factor)
