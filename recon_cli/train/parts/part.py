"""What an optional part of the model is: when it is tried, how that is decided, what it adds.

A row of `table.PARTS` names what differs from a part that is tried at its sign, is on if the trial
gains, and adds nothing by itself.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.config.stages import RunConfig, TrainConfig
from recon_cli.deadline import Deadline
from recon_cli.scene.splats import Splats
from recon_cli.scene.train_view import TrainView
from recon_cli.train.fit.schedule import Schedule
from recon_cli.train.fit.task import Evidence, Task
from recon_cli.train.parts.decisions import Rule
from recon_cli.train.parts.photometry import FittedPart

if TYPE_CHECKING:
    from recon_cli.train.parts.trials import Trials

# Views that a search looks at, evenly spread, and pixels of their longer side, whatever the size in
# training: in smaller ones the points around a window would close it.
SEARCHED_VIEWS, SEARCH_SIDE = 60, 150
LEVEL = 4  # images of a trial are reduced by this: a step takes a tenth, and parts still differ
AUTO = "auto"  # the value of an option that a sign or a trial decides


@dataclass(frozen=True, eq=False)
class TrialScene:
    """A scene whose optional parts are chosen by trials."""

    task: Task  # views at the training size, and the plan
    points: NDArray[np.float64]  # [P, 3] sparse points in world units
    colors: NDArray[np.uint8]  # [P, 3] uint8
    # reads the denoised training views; None where the task's views are the same
    twins: Callable[[], list[TrainView]] | None
    harmonics: bool = False  # the degree of the colours is left to a trial
    # of the training views, then of the validation views; they sort as they were taken
    names: tuple[str, ...] = ()
    deadline: Deadline = field(default_factory=Deadline)  # of all trials

    @property
    def config(self) -> RunConfig:
        """The options, of which some are automatic."""
        return self.task.schedule.config

    @property
    def evidence(self) -> Evidence:
        """The views and points."""
        return self.task.evidence_of(self.points)


@dataclass(frozen=True)
class Sign:
    """What the scene itself says of a part."""

    on: bool | None = None  # None: a trial decides
    reason: str = ""  # for the record; nothing is recorded without


@dataclass
class Start:
    """The Gaussians that a run begins with, to which parts of the model add some."""

    task: Task
    sparse: int  # points of structure from motion
    points: NDArray[np.float64]  # [P, 3] where Gaussians begin: those of sfm first
    colors: NDArray[np.uint8]  # [P, 3]
    splats: list[Splats] = field(default_factory=list)  # besides those at the points

    @property
    def evidence(self) -> Evidence:
        """The views and sparse points."""
        return self.task.evidence_of(self.points[: self.sparse])

    def add_points(self, points: NDArray[np.float64], colors: NDArray[np.uint8]) -> None:
        """Adds places where Gaussians begin."""
        self.points = np.concatenate([self.points, points])
        self.colors = np.concatenate([self.colors, colors])


@dataclass(frozen=True)
class Part:
    """An optional part of the model."""

    name: str  # of its option
    sign: Callable[[TrialScene], Sign]  # asked where the option is automatic
    rule: Callable[[TrialScene], Rule] = lambda _: Rule()  # by which a trial decides
    values: tuple[str, str] = ("off", "on")  # of the option
    # which of the views to score can tell whether it pays, where the others only add noise
    telling: Callable[[TrialScene, Sequence[TrainView]], Sequence[int]] | None = None
    # returns the option's value, in place of the sign and one trial
    settle: Callable[[Trials, RunConfig], Any] | None = None
    is_open: Callable[[TrialScene], bool] | None = None  # instead of: the option is automatic
    attach: Callable[[Start], None] | None = None  # adds to the Gaussians that a run begins with
    # searches what `attach` adds; OutOfTime where that would end late
    prepare: Callable[[Task, Evidence, Deadline], None] | None = None
    # makes what is fitted beside the Gaussians, from sparse points [P, 3]; without them for a
    # run that goes on
    fit: Callable[[Task, NDArray[np.float64] | None], FittedPart] | None = None
    # fields of `StepOptions` that it sets
    step_options: Callable[[Schedule, int], Mapping[str, float]] | None = None

    def is_on(self, config: TrainConfig) -> bool:
        """Returns whether options have it on."""
        return bool(getattr(config, self.name) == self.values[1])

    def merge(self, configs: Sequence[RunConfig], *, fits: bool) -> str:
        """Returns the option's value for blocks put together, whether or not they are fine-tuned.

        What it adds at the start they have; what is fitted is fitted for all, if for any.
        """
        on = [self.is_on(config) for config in configs]
        return self.values[not self.attach and (fits and any(on) if self.fit else all(on))]
