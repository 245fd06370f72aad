"""Which optional parts of the model this scene needs, by short trials.

A part has a cheap sign that must speak for it first, then two short runs at a reduced size that
differ in this part alone are scored on views that neither trained on. A part is off unless the
trial shows a gain; far content in rooms, and the depth of a sensor, are on unless it shows a loss.
What was switched on is part of the trials that follow. A trial that would not end in time is left
out or cut, and the part is as it is without evidence; those that gain most come first.
`tests/bench/bench_trials.py` holds the choices against runs of full length.
"""

from __future__ import annotations

import dataclasses
import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.config.stages import RunConfig
from recon_cli.context import TrainCallback
from recon_cli.deadline import Deadline, OutOfTime
from recon_cli.evaluation.reference_views import mean_psnr
from recon_cli.io.images import reduce_view
from recon_cli.render.response import LensFalloffs
from recon_cli.scene.splats import Splats
from recon_cli.scene.train_view import TrainView, leaves_enough
from recon_cli.train.background import FarContent, faces, far_content, look_at_one_thing
from recon_cli.train.exposure import Estimate, estimate_gains
from recon_cli.train.fit import fit
from recon_cli.train.initialize import first_state
from recon_cli.train.moving import SIDE
from recon_cli.train.moving_search import (
    FINER,
    Judge,
    Regions,
    are_enough,
    find_signs,
    first_look,
    hide,
    is_plausible,
    search,
    share_of,
)
from recon_cli.train.schedule import Schedule
from recon_cli.train.state import TrainState
from recon_cli.train.task import Task
from recon_cli.train.trial_decisions import NO_TIME, THRESHOLD_DB, decide, skip_trial, split
from recon_cli.train.vignette_evidence import VignetteEvidence, find_vignettes
from recon_cli.workspace.summaries import TrialDecision

# Loss that speaks against depth, which was measured: with exact depth a wall lost -.04 to .13 dB by
# the seed alone, and with depth that is wrong by a third -.06 to .19.
DEPTH_DB = 0.2
LEVEL = 4  # images of a trial are reduced by this: a step takes a tenth, and parts still differ
# One to two seconds a run on two cores. Twice the steps found the same on the rooms and fox.
_STEPS = 400
_FURTHER = 10 / 7  # times the means' rate of a full run: they have to get there in fewer steps
_POINTS = 5000
_CAP = 10_000
_LEAST_SEARCHED = 1000  # steps of a run in which what moves is looked for
logger = logging.getLogger("recon")
PARTS = ("far", "stereo", "exposure", "vignette", "images", "depth")


def model_parts(config: RunConfig) -> dict[str, Any]:
    """Returns the parts of the model that trials decide on, by the names of their options."""
    return {name: getattr(config, name) for name in (*PARTS, "sh_degree")}


@dataclass(frozen=True)
class Needs:
    """The optional parts that a scene needs beyond plain Gaussians."""

    config: RunConfig  # with every optional part on or off
    decisions: tuple[TrialDecision, ...]  # why, one for each part that was left automatic
    # [h, w] where each training and each validation view shows what moves; None: nothing does
    moving: Regions | None = None

    @property
    def untried(self) -> tuple[TrialDecision, ...]:
        """The decisions for which there was no time."""
        return tuple(one for one in self.decisions if one.reason == NO_TIME)


@dataclass(frozen=True, eq=False)
class TrialScene:
    """A scene whose optional parts are chosen by trials."""

    task: Task  # views at the training size, and the plan
    points: NDArray[np.float64]  # [P, 3] sparse points in world units
    colors: NDArray[np.uint8]  # [P, 3] uint8
    # reads the denoised training and validation views; None where the task's views are the same
    twins: Callable[[], tuple[list[TrainView], list[TrainView]]] | None
    harmonics: bool = False  # the degree of the colours is left to a trial
    # of the training views, then of the validation views; they sort as they were taken
    names: tuple[str, ...] = ()
    deadline: Deadline = field(default_factory=Deadline)  # of all trials


def examine(scene: TrialScene) -> Needs:
    """Returns the parts that a scene needs; those that options switch on or off are not tried."""
    config = scene.task.schedule.config
    if config.densify == "reference" and config.vignette == "auto":
        config = replace(config, vignette="off")  # sees what tables of the literature saw
    if config.stereo == "auto":
        config = replace(config, stereo="on")
    bench = _Bench(scene)
    decisions: list[TrialDecision] = []

    def settle(part: str, sign: str | None, against: str) -> None:
        """Puts a part into `config`, by the options, a missing sign, or a trial."""
        nonlocal config
        if getattr(config, part) != "auto":
            return
        decision = (
            skip_trial(part, against) if sign is None else bench.try_part(part, config, sign))
        decisions.append(decision)
        config = _with(config, part, _word(part, on=decision.on))

    if config.images == "auto" and scene.twins is None:
        config = replace(config, images="original")
    elif config.images == "auto":
        settle("images", "denoised", "")
    settle("far", "on" if bench.far.share > 0 else None, "points cover all that the views see")
    drift = bench.drift
    if config.look == "even" and config.exposure == "auto":
        decisions.append(TrialDecision(
            name="exposure", on=drift.drifts, mean_db=None, standard_error_db=None, seconds=0.0,
            reason="one exposure for all is asked for, and brightness of the same points differs "
            f"by {100 * drift.spread:.1f}%"))
        config = replace(config, exposure=_word("exposure", on=drift.drifts))
    settle("exposure", "on" if drift.drifts and not drift.follows_place else None,
           f"brightness of the same points differs by {100 * drift.spread:.1f}%" + (
               ", but little between views of the same place" if drift.drifts else " only"))
    vignettes = bench.vignettes(config)
    settle("vignette", "on" if vignettes.shades else None,
           f"the corners of the views lack {100 * vignettes.corner_loss:.1f}% of the light only")
    if config.depth == "auto" and not (scene.task.has_depth or scene.task.depth_refused):
        config = replace(config, depth="off")
    settle("depth", "on" if scene.task.has_depth else None, scene.task.depth_refused)
    if scene.harmonics:
        config = replace(config, sh_degree=bench.degree(config, decisions))
    moving = bench.find_moving(config, decisions) if _may_mask(config) else None
    return Needs(config, tuple(decisions), moving)


def _may_mask(config: RunConfig) -> bool:
    """Returns whether what moves is looked for.

    What is compared with tables of the literature sees what they saw, and in a short run few
    Gaussians follow what moves.
    """
    return config.moving == "on" or (
        config.moving == "auto" and config.densify != "reference"
        and config.iterations >= _LEAST_SEARCHED)


def _word(part: str, *, on: bool) -> str:
    if part == "images":
        return "denoised" if on else "original"
    return "on" if on else "off"


def _with(config: RunConfig, part: str, value: str) -> RunConfig:
    changes: dict[str, Any] = {part: value}
    return replace(config, **changes)


class _Pace(TrainCallback):
    """Cuts a short run that would not end in time."""

    def __init__(self, check: Callable[[int], None]) -> None:
        self._check = check

    def on_step(self, iteration: int, splats: Splats) -> None:  # noqa: ARG002
        """Raises OutOfTime where the rest would take too long."""
        self._check(iteration)


class _Bench:
    """Short runs on the views of a scene."""

    def __init__(self, scene: TrialScene) -> None:
        self._scene, task = scene, scene.task
        self._deadline = scene.deadline
        self._longest = 0.0  # seconds of a run so far
        self._runs = 1  # that must end in time, from the one that is next
        needs_far = task.schedule.config.far != "off"
        self.far = (far_content(task.train, scene.points, task.extent) if needs_far
                    else FarContent.nothing())
        drifting = task.schedule.config.exposure != "off"
        self.drift = (estimate_gains(task.train, scene.points) if drifting
                      else Estimate(np.zeros((len(task.train), 3)), 0.0, 0.0, 0))
        self._scores: dict[tuple[object, ...], list[float]] = {}
        self._states: dict[tuple[object, ...], TrainState] = {}

    def vignettes(self, config: RunConfig) -> VignetteEvidence:
        """Returns what the points show of vignettes, where options ask for it."""
        task = self._scene.task
        if config.vignette != "auto":
            return VignetteEvidence.nothing(task.train)
        return find_vignettes(task.train, self._scene.points)

    def try_part(self, part: str, config: RunConfig, value: str) -> TrialDecision:
        """Returns whether a part pays on top of those that are on already."""
        if split(len(self._scene.task.train), len(self._scene.task.validation)) is None:
            return skip_trial(part, "there are too few views to try it on")
        without, with_it = _with(config, part, _word(part, on=False)), _with(config, part, value)
        telling = self._telling(part)
        if len(telling) < 2:
            return skip_trial(part, "too few of the views to score see any of it")

        def scores(config: RunConfig) -> list[float]:
            values = self._run(config)
            if part == "vignette":  # brightness as filmed counts as much as all else
                values = np.mean([values, self._run(config, as_is=True)], axis=0).tolist()
            return [values[i] for i in telling]

        # Far content gains 1 to 3 dB on four of eight captures of rooms, where few views gain much
        # and the errors are large, but loses up to .5 dB on all five of things.
        # Depth puts surfaces where they are, which the views of the path need not show.
        lenient = part == "depth" or (
            part == "far" and not look_at_one_thing(self._scene.task.train))
        threshold = DEPTH_DB if part == "depth" else THRESHOLD_DB
        try:
            self._expect_runs(_key(without), _key(with_it))
            return decide(part, (lambda: scores(without), lambda: scores(with_it)),
                          threshold_db=threshold, unless_worse=lenient)
        except OutOfTime:
            return skip_trial(part, NO_TIME, on=lenient)

    def _expect_runs(self, *keys: tuple[object, ...]) -> None:
        """Raises OutOfTime where the runs of these keys that are not made yet would end too late.
        """
        self._runs = len(set(keys) - self._states.keys())
        self._deadline.refuse_late(self._runs * self._longest)

    def degree(self, config: RunConfig, decisions: list[TrialDecision]) -> int:
        """Returns the lowest degree of the colours that the highest does not beat by enough."""
        if split(len(self._scene.task.train), len(self._scene.task.validation)) is None:
            return config.sh_degree
        for low in (0, 1):
            few = replace(config, sh_degree=low)
            # A gain need not be sure: after 3,000 steps all of twelve captures gained by harmonics,
            # and two left out for want of certainty lost .6 and 1.2 dB in longer runs.
            name = f"harmonics above degree {low}"
            try:
                self._expect_runs(_key(few), _key(config))
                decisions.append(decide(
                    name, (partial(self._run, few), partial(self._run, config)), errors=0))
            except OutOfTime:
                decisions.append(skip_trial(name, NO_TIME, on=True))
                return config.sh_degree
            if not decisions[-1].on:
                return low
        return config.sh_degree

    def find_moving(self, config: RunConfig, decisions: list[TrialDecision]) -> Regions | None:
        """Returns where each training and validation view shows what moves; None: no masks pay."""
        if config.moving == "on":  # asked for, whatever it takes
            self._deadline = Deadline()
        try:
            return self._find_moving(config, decisions)
        except OutOfTime:
            decisions.append(skip_trial("moving", NO_TIME))
            return None

    def _find_moving(self, config: RunConfig, decisions: list[TrialDecision]) -> Regions | None:
        start, task = time.perf_counter(), self._scene.task
        # renders are compared as they are: corners are to be as dark in the model as in the photos
        config = replace(config, vignette="off")
        if split(len(task.train), len(task.validation)) is None:
            decisions.append(skip_trial("moving", "there are too few views to tell"))
            return None
        views, judge = [*task.train, *task.validation], Judge(config.sh_degree, task.backend)
        self._expect_runs(_key(config, self._moving_level))
        model = self.model(config, self._moving_level)
        order = np.argsort(self._scene.names) if self._scene.names else np.arange(len(views))
        rows = order[first_look(len(views))]
        begun = self._deadline.spent
        signs = find_signs(judge.compare(model, [views[row] for row in rows]))
        each = (self._deadline.spent - begun) / len(rows)  # seconds of a view
        if config.moving != "on" and not are_enough(signs):
            decisions.append(replace(skip_trial(
                "moving", f"{signs.sum()} of {len(signs)} views contradict the others"),
                seconds=time.perf_counter() - start))
            return None
        # the looks of the search are two like the first and a larger one, and it makes two models
        self._deadline.refuse_late(
            (2 + FINER**2) * each * len(views) + (1 + FINER) * self._longest)
        regions = search(model, views, range(len(task.train)), judge, partial(self._probe, config))
        if not any(region.any() for region in regions):
            decision = skip_trial("moving", "what contradicted other views was not found again")
        elif not is_plausible(regions):
            decision = skip_trial("moving", f"{share_of(regions):.0%} of the pixels contradict "
                                  "other views, too many to be people or things")
        elif config.moving == "on":
            decision = replace(skip_trial("moving", "asked for"), on=True)
        else:
            decision = self._try_masks(
                config, self.model(config, self._moving_level), hide(views, regions))
        decisions.append(replace(decision, seconds=time.perf_counter() - start))
        return regions if decision.on else None

    @property
    def _moving_level(self) -> int:
        """What views are reduced by, to no less than those that are compared."""
        camera = self._scene.task.train[0].camera
        return max(1, min(LEVEL, round(max(camera.width, camera.height) / SIDE)))

    def _try_masks(
        self, config: RunConfig, model: Splats, masked: list[TrainView]
    ) -> TrialDecision:
        """Returns whether masks pay in what they leave of the views that are scored.

        They need not gain in these few steps, in which few Gaussians follow what moves.
        """
        rows, _ = self._views()
        task, level = self._scene.task, self._moving_level
        chosen = split(len(task.train), len(task.validation))
        assert chosen is not None
        offset = 0 if chosen.own else len(task.train)
        held_out = [view for view in (masked[offset + row] for row in chosen.held_out)
                    if leaves_enough(reduce_view(view, level).mask)]
        if len(held_out) < 2:
            return skip_trial("moving", "too little of the views to score is left")
        config = self._short(config)

        def score(splats: Splats) -> list[float]:
            return self._score(splats, held_out, config, level)

        return decide("moving", (
            lambda: score(model),
            lambda: score(self._fit(
                config, [masked[row] for row in rows], factor=level).splats)),
            unless_worse=True)

    def _probe(self, config: RunConfig, views: Sequence[TrainView], side: int) -> Splats:
        """Returns a model of views reduced to `side` pixels, and of as many more Gaussians."""
        finer = side / SIDE
        largest = max(max(view.camera.width, view.camera.height) for view in views)
        return self._fit(
            self._short(config, finer), views, factor=max(1.0, largest / side)).splats

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

    def _run(
        self, config: RunConfig, level: int = LEVEL, *, as_is: bool = False
    ) -> list[float]:
        """Returns the PSNR in dB of each held-out view after a short run, corrected or as it is.
        """
        key, short = _key(config, level), self._short(config)
        if key not in self._states:
            self._states[key] = self._train(short, level)
        if (scored := (as_is, *key)) not in self._scores:
            state = self._states[key]
            self._scores[scored] = self._score(
                state.splats, self._views()[1], short, level,
                None if state.photometry is None else state.photometry.falloffs, as_is=as_is)
        return self._scores[scored]

    def model(self, config: RunConfig, level: int = LEVEL) -> Splats:
        """Returns the Gaussians of a short run, which another trial may have made."""
        self._run(config, level)
        return self._states[_key(config, level)].splats

    def _short(self, config: RunConfig, finer: float = 1.0) -> RunConfig:
        """Returns the options of a short run, of more steps and Gaussians by a factor."""
        return replace(
            _settled(config), iterations=round(finer * _STEPS),
            max_gaussians=min(config.max_gaussians, round(finer * _CAP)), early_stop=False,
            batch_views=1)

    def _train(self, config: RunConfig, level: int) -> TrainState:
        scene, train = self._scene, self._scene.task.train
        if scene.twins is not None and config.images == "denoised":
            train = [replace(twin, depth=view.depth)
                     for twin, view in zip(scene.twins()[0], train, strict=True)]
        rows, _ = self._views()
        return self._fit(config, [train[i] for i in rows], factor=level)

    def _score(
        self, splats: Splats, views: Sequence[TrainView], config: RunConfig, level: int = LEVEL,
        falloffs: LensFalloffs | None = None, *, as_is: bool = False,
    ) -> list[float]:
        """Returns the PSNR in dB of each view, after the best gain of each channel or as it is."""
        return [
            mean_psnr(splats, [reduce_view(view, level)], config.sh_degree,
                      self._scene.task.backend, corrected=not as_is, falloffs=falloffs)
            for view in views]

    def _fit(
        self, config: RunConfig, views: Sequence[TrainView], *, factor: float = LEVEL
    ) -> TrainState:
        """Returns the end of a short run on views reduced by a factor."""
        scene, task = self._scene, self._scene.task
        # Far content seemed worth up to 1 dB less where a run so short replaced Gaussians, too; in
        # runs of full length it is worth as much as without (tests/bench/notes/training.md).
        recipe = Schedule(config).recipe
        recipe = dataclasses.replace(recipe, levels=(), replaced_at_once=0.0,
                                     means_rate=_FURTHER * recipe.means_rate)
        schedule = Schedule(config, recipe)
        limited, begun = self._deadline.limited, self._deadline.spent
        # the search for surfaces has a time of its own
        stereo = None if limited else task.stereo
        small = Task([reduce_view(view, factor) for view in views], [], schedule, task.extent,
                     task.backend, task.device, nearness=task.nearness, stereo=stereo)
        # reduced views would be reduced once more in the search for places far outside
        state = first_state(small, scene.points, scene.colors, most=_POINTS, far=self.far)
        pace = self._deadline.keep_pace(config.iterations * max(1, self._runs))
        fit(state, small, config.iterations, (_Pace(pace),) if limited else ())
        self._longest = max(self._longest, self._deadline.spent - begun)
        self._runs -= 1
        return state


def short_model(scene: TrialScene, level: int = LEVEL) -> Splats:
    """Returns the Gaussians of a trial with the parts that are on, at a size reduced by `level`."""
    return _Bench(scene).model(scene.task.schedule.config, level)


def _settled(config: RunConfig) -> RunConfig:
    """Returns the options with every part off that is not decided yet."""
    for part in PARTS:
        if getattr(config, part) == "auto":
            config = _with(config, part, _word(part, on=False))
    return config


def _key(config: RunConfig, level: int = LEVEL) -> tuple[object, ...]:
    """Returns what tells the short runs of a scene apart."""
    return level, *model_parts(_settled(config)).values()
