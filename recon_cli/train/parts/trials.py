"""Which optional parts of the model this scene needs, by short trials.

A part has a cheap sign that must speak for it first, then two short runs at a reduced size that
differ in this part alone are scored on views that neither trained on. A part is off unless the
trial shows a gain; by the rules of some it is on unless the trial shows a loss. A trial that would
not end in time is left out or cut, and the part is as it is without evidence.
`tests/bench/bench_trials.py` holds the choices against runs of full length.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from recon_cli.config.stages import RunConfig
from recon_cli.context import TrainCallback
from recon_cli.deadline import OutOfTime
from recon_cli.evaluation.reference_views import mean_psnr
from recon_cli.io.images import reduce_view
from recon_cli.render.response import LensFalloffs
from recon_cli.scene.splats import Splats
from recon_cli.scene.train_view import TrainView
from recon_cli.train.fit.initialize import first_state
from recon_cli.train.fit.loop import fit
from recon_cli.train.fit.schedule import Schedule
from recon_cli.train.fit.state import TrainState
from recon_cli.train.masks import Regions
from recon_cli.train.parts import moving
from recon_cli.train.parts.decisions import NO_TIME, Rule, Split, decide, skip_trial, split
from recon_cli.train.parts.part import AUTO, LEVEL, Part, TrialScene
from recon_cli.train.parts.table import PARTS, model_parts, with_part, without_open_parts
from recon_cli.workspace.summaries import TrialDecision

# One to two seconds a run on two cores. Twice the steps found the same on the rooms and fox.
_STEPS = 400
_FURTHER = 10 / 7  # times the means' rate of a full run: they have to get there in fewer steps
_CAP = 10_000  # Gaussians; half of them at the start


@dataclass(frozen=True)
class Needs:
    """The optional parts that a scene needs beyond plain Gaussians."""

    config: RunConfig  # with every optional part on or off
    decisions: tuple[TrialDecision, ...]  # why, one for each part that was left automatic
    # [h, w] what is to be masked in each training and each validation view; None: nothing is
    masks: Regions | None = None

    @property
    def untried(self) -> tuple[TrialDecision, ...]:
        """The decisions for which there was no time."""
        return tuple(one for one in self.decisions if one.reason == NO_TIME)


def examine(scene: TrialScene) -> Needs:
    """Returns the parts that a scene needs; those that options switch on or off are not tried."""
    trials, config = Trials(scene), scene.config
    # masks are not a part of the model, but are searched with all of it
    for part in (*PARTS, moving.PART):
        if part.is_open(scene) if part.is_open else getattr(config, part.name) == AUTO:
            value = part.settle(trials, config) if part.settle else trials.settle(part, config)
            config = with_part(config, part, value)
    return Needs(config, tuple(trials.decisions), trials.masks)


class _PaceCallback(TrainCallback):
    """Cuts a short run that would not end in time."""

    def __init__(self, check: Callable[[int], None]) -> None:
        self._check = check

    def on_step(self, iteration: int, splats: Splats) -> None:  # noqa: ARG002
        """Raises OutOfTime where the rest would take too long."""
        self._check(iteration)


class Trials:
    """Short runs on the views of a scene, and what they decide."""

    def __init__(self, scene: TrialScene) -> None:
        # reduced views would be reduced once more in searches: those are of the views in full size
        task = replace(scene.task, evidence=scene.evidence)
        self.scene, self.task = replace(scene, task=task), task
        self.deadline = scene.deadline
        self.decisions: list[TrialDecision] = []
        self.masks: Regions | None = None
        self.longest = 0.0  # seconds of a run so far
        self._runs = 1  # that must end in time, from the one that is next
        self._scores: dict[tuple[object, ...], list[float]] = {}
        self._states: dict[tuple[object, ...], TrainState] = {}

    @property
    def split(self) -> Split | None:
        """The views to train on and to score; None where there are too few."""
        return split(len(self.task.train), len(self.task.validation))

    def settle(self, part: Part, config: RunConfig) -> Any:
        """Returns the value of a part's option, by its sign or by a trial."""
        sign = part.sign(self.scene)
        if sign.on is None:
            decision = self._try(part, config)
        else:
            decision = skip_trial(part.name, sign.reason, on=sign.on)
        if decision.reason:
            self.decisions.append(decision)
        return part.values[decision.on]

    def _try(self, part: Part, config: RunConfig) -> TrialDecision:
        """Returns whether a part pays on top of those that are on already."""
        if self.split is None:
            return skip_trial(part.name, "there are too few views to try it on")
        scored, rule = self.held_out(self.views), part.rule(self.scene)
        rows = part.telling(self.scene, scored) if part.telling else range(len(scored))
        if len(rows) < 2:
            return skip_trial(part.name, "too few of the views to score see any of it")
        off, on = (with_part(config, part, value) for value in part.values)
        try:
            return self.compare(part.name, off, on, rule, rows=rows)
        except OutOfTime:
            return skip_trial(part.name, NO_TIME, on=rule.unless_worse)

    def compare(
        self, name: str, without: RunConfig, with_it: RunConfig, rule: Rule, *,
        rows: Sequence[int] | None = None,
    ) -> TrialDecision:
        """Returns whether a short run with a part is better than one without it.

        Raises:
            OutOfTime: they would not end in time.
        """
        def arm(config: RunConfig) -> Callable[[], list[float]]:
            def scores() -> list[float]:
                values = self._run(config)
                if rule.as_filmed:
                    values = np.mean([values, self._run(config, as_filmed=True)], axis=0).tolist()
                return values if rows is None else [values[row] for row in rows]

            return scores

        self._expect_runs(_key(without), _key(with_it))
        return decide(name, (arm(without), arm(with_it)), rule)

    def _expect_runs(self, *keys: tuple[object, ...]) -> None:
        """Raises OutOfTime where the runs of these keys that are not made yet would end too late.
        """
        self._runs = len(set(keys) - self._states.keys())
        self.deadline.refuse_late(self._runs * self.longest)

    @property
    def views(self) -> list[TrainView]:
        """The training views and the validation views."""
        return [*self.task.train, *self.task.validation]

    def held_out(self, views: Sequence[TrainView]) -> list[TrainView]:
        """Returns those to score of the training and validation views."""
        chosen = self.split
        assert chosen is not None
        first = 0 if chosen.own else len(self.task.train)
        return [views[first + row] for row in chosen.held_out]

    def trained_on(self, views: Sequence[TrainView]) -> list[TrainView]:
        """Returns those of the training views that are not scored."""
        chosen = self.split
        assert chosen is not None
        return [views[row] for row in chosen.train]

    def _run(
        self, config: RunConfig, level: int = LEVEL, *, as_filmed: bool = False
    ) -> list[float]:
        """Returns the PSNR in dB of each held-out view after a short run."""
        key = _key(config, level)
        if key not in self._states:
            self._states[key] = self.fit(
                config, self.trained_on(self._read_views(config)), factor=level)
        if (scored := (as_filmed, *key)) not in self._scores:
            state = self._states[key]
            self._scores[scored] = self.score(
                state.splats, self.held_out(self.views), config.sh_degree, level,
                None if state.photometry is None else state.photometry.falloffs,
                as_filmed=as_filmed)
        return self._scores[scored]

    def model(self, config: RunConfig, level: int = LEVEL) -> Splats:
        """Returns the Gaussians of a short run, which another trial may have made."""
        if _key(config, level) not in self._states:
            self._expect_runs(_key(config, level))
        self._run(config, level)
        return self._states[_key(config, level)].splats

    def _read_views(self, config: RunConfig) -> Sequence[TrainView]:
        """Returns the training views in the pixels that options ask for."""
        if self.scene.twins is None or config.images != "denoised":
            return self.task.train
        return [replace(twin, depth=view.depth)
                for twin, view in zip(self.scene.twins(), self.task.train, strict=True)]

    def score(
        self, splats: Splats, views: Sequence[TrainView], sh_degree: int, level: int = LEVEL,
        falloffs: LensFalloffs | None = None, *, as_filmed: bool = False,
    ) -> list[float]:
        """Returns the PSNR in dB of each view, after the best gain of each channel or as filmed."""
        return [
            mean_psnr(splats, [reduce_view(view, level)], sh_degree, self.task.backend,
                      corrected=not as_filmed, falloffs=falloffs)
            for view in views]

    def fit(
        self, config: RunConfig, views: Sequence[TrainView], *, factor: float = LEVEL,
        finer: float = 1.0,
    ) -> TrainState:
        """Returns the end of a short run on views reduced by a factor.

        It takes more steps and Gaussians by the factor `finer`.
        """
        limited, begun = self.deadline.limited, self.deadline.spent
        config = replace(
            self._without_searches(config), iterations=round(finer * _STEPS),
            max_gaussians=min(config.max_gaussians, round(finer * _CAP)), early_stop=False,
            batch_views=1)
        # Far content seemed worth up to 1 dB less where a run so short replaced Gaussians, too; in
        # runs of full length it is worth as much as without (tests/bench/notes/training.md).
        recipe = Schedule(config).recipe
        recipe = dataclasses.replace(recipe, levels=(), replaced_at_once=0.0,
                                     means_rate=_FURTHER * recipe.means_rate)
        small = replace(self.task, train=[reduce_view(view, factor) for view in views],
                        validation=[], schedule=Schedule(config, recipe), cell=None)
        state = first_state(small, self.scene.points, self.scene.colors, most=_CAP // 2)
        pace = self.deadline.keep_pace(config.iterations * max(1, self._runs))
        fit(state, small, config.iterations, (_PaceCallback(pace),) if limited else ())
        self.longest = max(self.longest, self.deadline.spent - begun)
        self._runs -= 1
        return state

    def _without_searches(self, config: RunConfig) -> RunConfig:
        """Returns the options of a short run; the searches of some parts have a time of their own.
        """
        config = without_open_parts(config)
        for part in PARTS if self.deadline.limited else ():
            if part.prepare:
                config = with_part(config, part, part.values[0])
        return config


def _key(config: RunConfig, level: int = LEVEL) -> tuple[object, ...]:
    """Returns what tells the short runs of a scene apart."""
    return level, *model_parts(without_open_parts(config)).values()
