"""Which optional parts of the model this scene needs: each is off unless a short trial shows it.

A part has a cheap sign that must speak for it first (most scenes try nothing), then two short runs
at a reduced size that differ in this part alone are scored on views that neither trained on
(`trials`). What was switched on is part of the trials that follow.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from recon_cli.config import RunConfig
from recon_cli.render import render
from recon_cli.scene.splats import Splats
from recon_cli.train.exposure_start import Estimate, estimated
from recon_cli.train.far import FarContent, faces, far_content
from recon_cli.train.fit import Task, fit
from recon_cli.train.poses import worth_a_trial
from recon_cli.train.pyramid import reduced
from recon_cli.train.schedule import Schedule
from recon_cli.train.start import first_state
from recon_cli.train.step import TrainView
from recon_cli.train.trials import Decision, corrected_psnr, decide, skipped, split

LEVEL = 4  # images of a trial are reduced by this: a step takes a tenth, and parts still differ
# One to two seconds a run on two cores. Twice the steps found the same on the rooms and fox.
_STEPS = 400
_POINTS = 5000
_CAP = 10_000
_FAR_SHARE = 0.003  # of the directions; the window of one room is .012, that of another .045
PARTS = ("far", "exposure", "poses", "images")
# Gain from which higher harmonics are worth 45 of 59 parameters. Trials gave .24 dB on photos of a
# glossy thing (.59 dB in the whole run) and .08 to .12 dB in two rooms (.07 dB in the whole run),
# where a tenth more Gaussians give as much for less.
_HARMONICS_DB = 0.15


@dataclass(frozen=True)
class Needs:
    """What a scene needs beyond plain Gaussians.

    Attributes:
        config: with every optional part on or off.
        decisions: why, one for each part that was left automatic.
    """

    config: RunConfig
    decisions: tuple[Decision, ...]

    @property
    def seconds(self) -> float:
        """Spent on trials."""
        return sum(decision.seconds for decision in self.decisions)


@dataclass(frozen=True, eq=False)
class Candidate:
    """A scene as gates look at it.

    Attributes:
        task: views at the training size, and the plan.
        points: [P, 3] sparse points in world units.
        colors: [P, 3] uint8.
        harmonics: the degree of the colours is left to a trial.
        twins: reads the training and validation views from the denoised images, where the task
            holds the originals; None where both are the same.
    """

    task: Task
    points: NDArray[np.float64]
    colors: NDArray[np.uint8]
    twins: Callable[[], tuple[list[TrainView], list[TrainView]]] | None
    harmonics: bool = False


def examine(scene: Candidate) -> Needs:
    """Returns what a scene needs; parts that the options switch on or off are not tried."""
    config = scene.task.schedule.config
    bench = _Bench(scene)
    decisions: list[Decision] = []

    def settled(part: str, sign: str | None, against: str) -> None:
        """Puts a part into `config`, by the options, a missing sign, or a trial."""
        nonlocal config
        if getattr(config, part) != "auto":
            return
        decision = (skipped(part, against) if sign is None
                    else bench.tried(part, config, sign))
        decisions.append(decision)
        config = _with(config, part, _word(part, on=decision.on))

    if config.images == "auto" and scene.twins is None:
        config = replace(config, images="original")
    elif config.images == "auto":
        settled("images", "denoised", "")
    settled("far", "on" if bench.far.share >= _FAR_SHARE else None,
            f"points cover {100 * (1 - bench.far.share):.1f}% of what the views see")
    settled("exposure", "on" if bench.drift.drifts else None,
            f"brightness of the same points differs by {100 * bench.drift.spread:.1f}% only")
    task = scene.task
    error = None if task.camera_error is None else task.camera_error * task.train[0].camera.fx
    settled("poses", "on" if worth_a_trial(error) else None,
            "the reprojection error is not known" if error is None
            else f"the reprojection error is {error:.2f} px of a training image")
    if scene.harmonics:
        config = replace(config, sh_degree=bench.degree(config, decisions))
    return Needs(config, tuple(decisions))


def _word(part: str, *, on: bool) -> str:
    if part == "images":
        return "denoised" if on else "original"
    return "on" if on else "off"


def _with(config: RunConfig, part: str, value: str) -> RunConfig:
    changes: dict[str, Any] = {part: value}
    return replace(config, **changes)


class _Bench:
    """Short runs on the views of a scene."""

    def __init__(self, scene: Candidate) -> None:
        self._scene, task = scene, scene.task
        needs_far = task.schedule.config.far != "off"
        self.far = (far_content(task.train, scene.points, task.extent) if needs_far
                    else FarContent(np.zeros((0, 3)), np.zeros((0, 3)), 1.0, 0.0))
        drifting = task.schedule.config.exposure != "off"
        self.drift = (estimated(task.train, scene.points) if drifting
                      else Estimate(np.zeros((len(task.train), 3)), 0.0, 0))
        self._scores: dict[tuple[object, ...], list[float]] = {}

    def tried(self, part: str, config: RunConfig, value: str) -> Decision:
        """Returns whether a part pays on top of what is on already."""
        if split(len(self._scene.task.train), len(self._scene.task.validation)) is None:
            return skipped(part, "there are too few views to try it on")
        arms = (_with(config, part, one) for one in (_word(part, on=False), value))
        without, with_it = arms
        telling = self._telling(part)
        if len(telling) < 2:
            return skipped(part, "too few of the views to score see any of it")

        def told(config: RunConfig) -> list[float]:
            scores = self._run(config)
            return [scores[i] for i in telling]

        return decide(part, (lambda: told(without), lambda: told(with_it)))

    def degree(self, config: RunConfig, decisions: list[Decision]) -> int:
        """Returns the lowest degree of the colours that the highest does not beat by enough."""
        if split(len(self._scene.task.train), len(self._scene.task.validation)) is None:
            return config.sh_degree
        for low in (0, 1):
            if not self._gains(config, low, decisions):
                return low
        return config.sh_degree

    def _gains(self, config: RunConfig, low: int, decisions: list[Decision]) -> bool:
        """Tells whether all degrees are better than some, and adds the decision."""
        few = replace(config, sh_degree=low)
        decisions.append(decide(
            f"harmonics above degree {low}", (lambda: self._run(few), lambda: self._run(config)),
            threshold_db=_HARMONICS_DB))
        return decisions[-1].on

    def _telling(self, part: str) -> list[int]:
        """Returns which held-out views can tell whether a part pays; the others only add noise."""
        _, views = self._views()
        if part != "far":
            return list(range(len(views)))
        return [i for i, view in enumerate(views) if faces(view, self.far, self._scene.points)]

    def _views(self) -> tuple[tuple[int, ...], list[TrainView]]:
        """Returns the rows of the views to train on, and the views to score, as they are."""
        task = self._scene.task
        chosen = split(len(task.train), len(task.validation))
        assert chosen is not None
        held_out = task.train if chosen.own else task.validation
        return chosen.train, [held_out[i] for i in chosen.held_out]

    def _run(self, config: RunConfig) -> list[float]:
        """Returns the corrected PSNR in dB of each held-out view after a short run."""
        for part in PARTS:
            if getattr(config, part) == "auto":
                config = _with(config, part, _word(part, on=False))
        key = (config.sh_degree, *(getattr(config, part) for part in PARTS))
        if key not in self._scores:
            self._scores[key] = self._trained(replace(
                config, iterations=_STEPS, max_gaussians=min(config.max_gaussians, _CAP),
                early_stop=False, batch_views=1))
        return self._scores[key]

    def _trained(self, config: RunConfig) -> list[float]:
        scene, task = self._scene, self._scene.task
        train = task.train
        if scene.twins is not None and config.images == "denoised":
            train, _ = scene.twins()
        rows, held_out = self._views()  # scored against the task's own, whatever was trained on
        schedule = Schedule(config, dataclasses.replace(Schedule(config).recipe, levels=()))
        small = Task([reduced(train[i], LEVEL) for i in rows], [], schedule, task.extent,
                     task.backend, task.device, camera_error=task.camera_error)
        # reduced views would be reduced once more in the search for what lies far outside
        state = first_state(small, scene.points, scene.colors, most=_POINTS, far=self.far)
        fit(state, small, _STEPS, on_step=lambda _: None, on_report=lambda _: None,
            looks=lambda _: False)
        return [_score(state.splats, reduced(view, LEVEL), config, task) for view in held_out]


def _score(splats: Splats, view: TrainView, config: RunConfig, task: Task) -> float:
    with torch.no_grad():
        image = render(splats, view.camera, torch.zeros(3, device=task.device), config.sh_degree,
                       backend=task.backend).rgb
    return corrected_psnr(image.cpu().numpy(), view.image, view.mask)


def described(decisions: Sequence[Decision]) -> list[dict[str, object]]:
    """Returns the decisions as JSON values."""
    return [dataclasses.asdict(decision) for decision in decisions]
