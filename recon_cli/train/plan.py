"""Decisions before the first training step: parts of the model, steps, cap of the count.

The plan is recorded, and an interrupted run continues by the record: whatever a clock or a trial
would say now, the same numbers give the same bytes.
"""

from __future__ import annotations

import dataclasses
import filecmp
import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from recon_cli.config.protocols import follow
from recon_cli.config.stages import MIN_GAUSSIANS, RunConfig, TrainConfig
from recon_cli.context import StageContext
from recon_cli.deadline import Deadline, OutOfTime
from recon_cli.scene.scene import Scene
from recon_cli.scene.train_view import TrainView
from recon_cli.time_estimate import TimeEstimator, format_minutes
from recon_cli.train.cost import calibrate, list_work
from recon_cli.train.finished_model import FinishedModel
from recon_cli.train.fit.initialize import first_state, restore_state
from recon_cli.train.fit.schedule import RECIPES, Schedule, make_schedule
from recon_cli.train.fit.state import TrainState
from recon_cli.train.fit.task import Task
from recon_cli.train.fit.train_data import (
    gaussians_that_fit,
    image_file,
    load_task,
    load_views,
    read_config,
    write_config,
)
from recon_cli.train.masks import EditedMasks, copy_masks, with_masks, write_masks
from recon_cli.train.parts.part import TrialScene
from recon_cli.train.parts.table import PARTS, model_parts
from recon_cli.train.parts.trials import Needs, examine
from recon_cli.workspace.atomic import write_json
from recon_cli.workspace.summaries import TrainPlan

# Shares of --minutes: of trials and the search for surfaces together at most, of the trials alone
# at most (surfaces gain in every room, trials in some), and of the steps at least.
EXTRAS_SHARE, TRIALS_SHARE, STEPS_SHARE = 0.2, 0.1, 0.5
CALIBRATION_SHARE = 0.05  # of the minutes, at most
LEAST_STEPS = 0.15  # of the quality's steps, below which a scene is blurred: the user is told
CALIBRATION_SECONDS = 0.5  # where no time is given: a twentieth of a draft

_RUN = (100, 100_000)  # steps; fewer show nothing of a room, more are three times the reference's
_DETAIL = 4.0  # grey levels a pixel; camera noise stays below it after denoising
_DETAIL_VIEWS = 16  # looked at; the mean of more differs by less than 3%
_FULL_AT = 2400  # steps after which there may be a Gaussian for each pixel with detail
# Faces of a panorama that count as one view: pixels of a panorama are coarser than a phone's, and
# half of its faces show a floor, a ceiling or whoever carries the camera.
_FACES = 2
_VIEWS_EACH = 8  # views that must show a Gaussian, about, to tell where it is
_FIRST = 0.5  # of the cap, at the start
_FEWEST = 5000
_UNLIMITED = 0.5  # of the room in memory; a run that resumes must find the same room again
# Real Gaussians cover more tiles than timed ones: ten runs took -1 to 17% longer, 9% on the mean
_LONGER = 1.09
_ROUND = 100  # counts are multiples of this

logger = logging.getLogger("recon")


@dataclass(frozen=True)
class Quality:
    """The preset of --quality; the same on every machine, so that results are, too."""

    iterations: int  # steps
    max_size: int  # longest side of a training image in pixels


# A draft takes 11 to 15 CPU seconds of one thread on living, office and fox
# (tests/bench/notes/training.md); the others follow from what steps of their size and count take.
QUALITIES = {"draft": Quality(1500, 400), "normal": Quality(2400, 600), "high": Quality(8000, 800)}


@dataclass(frozen=True)
class Facts:
    """The facts on a scene that a plan needs."""

    detail: int  # of `count_detail`
    views: int  # to train on
    points: int  # sparse ones, from which the Gaussians begin
    room: int  # the most Gaussians that memory has room for


def first_config(asked: TrainConfig) -> RunConfig:
    """Returns the options before any image is read; where open, the quality's and the least cap."""
    quality = QUALITIES[asked.quality]
    return _fill_in(
        asked, asked.iterations or quality.iterations, asked.max_gaussians or _FEWEST,
        asked.max_size or quality.max_size)


def run_config(asked: TrainConfig, plan: TrainPlan) -> RunConfig:
    """Returns the options of the run: those given, and the plan's numbers for the rest."""
    return _fill_in(asked, plan.iterations, plan.max_gaussians, plan.max_size)


def probe_config(asked: TrainConfig, facts: Facts) -> RunConfig:
    """Returns the options whose cap is worth timing: of the run if its length is known."""
    config = first_config(asked)
    return dataclasses.replace(config, max_gaussians=cap(asked, facts, config.iterations))


def make_plan(
    asked: TrainConfig, facts: Facts, estimator: TimeEstimator, *, left: float | None = None,
    model: FinishedModel | None = None,
) -> TrainPlan:
    """Returns the plan, whose steps take the seconds that are `left` where minutes are asked for.

    None: all of them but those of the calibration. `model` is the one that the run continues.
    """
    continues_at = None if model is None else model.steps

    def at(iterations: int) -> TrainPlan:
        most = cap(asked, facts, iterations)
        if model is not None:
            most = max(most, model.gaussians)
        config = _fill_in(asked, iterations, most, first_config(asked).max_size)
        first = first_count(config, facts.points) if model is None else model.gaussians
        schedule = make_schedule(_likely(config, facts), continues_at)
        return TrainPlan(
            iterations=iterations, max_gaussians=most, max_size=config.max_size,
            first_gaussians=first, detail=facts.detail,
            seconds=round(
                _LONGER * estimator.total(list_work(schedule, first, estimator.costs)), 2),
            cost=dataclasses.asdict(estimator), continues_at=continues_at)

    if asked.minutes is None:
        return at(first_config(asked).iterations)
    left = 60 * asked.minutes - estimator.seconds if left is None else left
    return at(_largest(lambda steps: at(steps).seconds <= left, *_RUN))


def cap(asked: TrainConfig, facts: Facts, iterations: int) -> int:
    """Returns the cap of the count: the option's, or the limit of images, steps and memory.

    A Gaussian for each pixel of a mean view that holds detail, after 2,400 steps; in other runs by
    the square root of the steps, as a new Gaussian must still find its place. No more than an
    eighth of the detail of all views: what few views see fits each of them and nothing between. On
    living and office, doubling the cap gave .5 to 1.3 dB for 15 to 30% more time
    (tests/bench/notes/training.md).
    """
    if asked.max_gaussians is not None:
        return asked.max_gaussians
    if _is_unlimited(asked):
        return max(MIN_GAUSSIANS, int(_UNLIMITED * facts.room))
    return min(useful_cap(facts, iterations), max(MIN_GAUSSIANS, facts.room))


def _is_unlimited(config: TrainConfig) -> bool:
    """Returns whether only memory limits the count, as a protocol may ask for."""
    protocol = follow(config.protocol)
    return protocol is not None and not protocol.limits_count


def _likely(config: RunConfig, facts: Facts) -> RunConfig:
    """Returns the options with the count that a run is likely to end with, to tell its time.

    Where memory is the limit that is told by `useful_cap`, and may well be more: 577,000 for bonsai
    and 30,000 steps, where the reference ended with 974,000.
    """
    if not _is_unlimited(config):
        return config
    likely = max(MIN_GAUSSIANS, facts.points, useful_cap(facts, config.iterations))
    return dataclasses.replace(config, max_gaussians=min(config.max_gaussians, likely))


def first_count(config: RunConfig, points: int) -> int:
    """Returns how many Gaussians a run begins with: of many points a seeded draw is taken.

    A count that grows begins with half of its cap: on `living`, 3,000 steps to 100,000 Gaussians
    end at 28.03 dB from 25,000 and at 28.28 dB from 50,000. The reference takes all points.
    """
    share = 1 if RECIPES[config.densify].resets else _FIRST
    return min(points, config.max_gaussians, max(_FEWEST, int(share * config.max_gaussians)))


def useful_cap(facts: Facts, iterations: int) -> int:
    """Returns the cap that `cap` describes, memory aside."""
    share = min(math.sqrt(iterations / _FULL_AT), facts.views / _VIEWS_EACH)
    return max(_FEWEST, round(facts.detail * share / _ROUND) * _ROUND)


def gather_facts(task: Task, scene: Scene, room: int, detail: int) -> Facts:
    """Returns the facts on a scene; `room` as in `Facts`, `detail` by `count_detail`.

    Of panoramas two faces are one view.
    """
    each = _FACES if any(view.face_of is not None for view in scene.train) else 1
    return Facts(each * detail, max(1, len(task.train) // each), len(scene.points), room)


def count_detail(views: Sequence[TrainView]) -> int:
    """Returns how many unmasked pixels of a mean view have a gradient above 4 grey levels."""
    chosen = np.unique(np.linspace(0, len(views) - 1, _DETAIL_VIEWS).round().astype(int))
    return round(float(np.mean([_count_detailed_pixels(views[i]) for i in chosen])))


def _count_detailed_pixels(view: TrainView) -> int:
    grey = cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    across, down = (cv2.Sobel(grey, cv2.CV_32F, *order, scale=1 / 8) for order in ((1, 0), (0, 1)))
    detailed = np.hypot(across, down) > _DETAIL
    return int((detailed if view.mask is None else detailed & view.mask).sum())


def _fill_in(asked: TrainConfig, iterations: int, max_gaussians: int, max_size: int) -> RunConfig:
    values = {item.name: getattr(asked, item.name) for item in dataclasses.fields(asked)}
    degree = 3 if asked.sh_degree is None else asked.sh_degree
    return RunConfig(**{
        **values, "minutes": None, "sh_degree": degree, "iterations": iterations,
        "max_gaussians": max_gaussians, "max_size": max_size})


def _largest(fits: Callable[[int], bool], low: int, high: int) -> int:
    """Returns the largest integer in [low, high] that fits; `low` where none does."""
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if fits(middle) else (low, middle - 1)
    return low


def plan_task(
    config: TrainConfig, scene: Scene, out: Path, ctx: StageContext,
    model: FinishedModel | None = None, edited: EditedMasks | None = None,
) -> Task:
    """Returns the task of a run by its plan: a recorded one, or one that is made and recorded.

    `model` is the one that the run continues, with its parts; `edited` are a user's masks.
    """
    seconds = math.inf if config.minutes is None else 60 * config.minutes
    given, edited, deadline = scene, edited or EditedMasks(), Deadline(seconds)
    planned = (out / TrainPlan.FILE).exists()
    if not planned and model is not None:
        copy_masks(model.folder, model.moving, out)
    elif not planned:
        write_masks(out, scene, None, edited)
    scene = with_masks(scene, out)
    if planned:
        recorded = dataclasses.replace(read_config(out), checkpoint_every=config.checkpoint_every)
        schedule = make_schedule(recorded, TrainPlan.read(out).continues_at)
        return dataclasses.replace(load_task(scene, recorded, ctx), schedule=schedule)
    if model is not None:
        config = dataclasses.replace(config, **model.choose_parts(config))
    first = first_config(config)
    if model is not None:  # all of it must fit
        first = dataclasses.replace(
            first, max_gaussians=max(first.max_gaussians, model.gaussians))
    fit_memory = gaussians_that_fit(scene, first, ctx)
    task = load_task(scene, first, ctx)
    extras = deadline.part(EXTRAS_SHARE)
    needs = Needs(first, model.plan.needs if model.plan else ()) if model else choose_parts(
        task, scene, ctx, harmonics=config.sh_degree is None, deadline=deadline.part(TRIALS_SHARE))
    if needs.config.images == "denoised" and first.images != "denoised":
        task = load_task(scene, dataclasses.replace(first, images="denoised"), ctx)
    detail = count_detail(task.train)  # behind what moves there is as much as beside it
    if needs.masks is not None:
        write_masks(out, given, needs.masks, edited)
        scene = with_masks(given, out)
        task = load_task(scene, dataclasses.replace(first, images=needs.config.images), ctx)
    asked = dataclasses.replace(config, **model_parts(needs.config))
    facts = gather_facts(task, scene, fit_memory, detail)
    if any(part.prepare and part.is_on(config) for part in PARTS):  # asked for, whatever it takes
        extras = Deadline()
    timed = _plan_in_time(asked, facts, task, scene, out, deadline, extras, model)
    given_up = [f"{one.name} is {'on' if one.on else 'off'}" for one in needs.untried]
    given_up += [f"{part.name} is off" for part in PARTS
                 if part.is_on(asked) and not part.is_on(timed[0])]
    asked, plan = timed
    if given_up:
        ctx.notice(f"{seconds:.0f} s of training leave no time to try all parts of the model: "
                   f"{', '.join(given_up)}.")
    _report_plan(plan, asked, facts, ctx)
    config = run_config(asked, plan)
    write_config(out, config)
    write_json(out / TrainPlan.FILE, dataclasses.replace(plan, needs=needs.decisions).to_json())
    return dataclasses.replace(task, schedule=make_schedule(config, plan.continues_at))


def _plan_in_time(
    asked: TrainConfig, facts: Facts, task: Task, scene: Scene, out: Path, deadline: Deadline,
    extras: Deadline, model: FinishedModel | None,
) -> tuple[TrainConfig, TrainPlan]:
    """Returns the options, and the plan by timed steps that ends by the deadline.

    Parts are left out whose search would not end by that of the `extras`.
    """
    def search(asked: TrainConfig, likely: RunConfig) -> TrainConfig:
        late = [] if model is not None else _find_late_parts(likely, task, scene, extras)
        off: dict[str, Any] = dict.fromkeys(late, "off")
        return dataclasses.replace(asked, **off)

    def plan() -> TrainPlan:
        left = max(deadline.left, STEPS_SHARE * deadline.seconds)
        return make_plan(asked, facts, estimator, left=left, model=model)

    asked = search(asked, probe_config(asked, facts))
    estimator = _measure_cost(asked, facts, task, scene, out)
    if deadline.limited:  # longer than the likely run, with more room
        asked = search(asked, run_config(asked, plan()))
    return asked, plan()


def choose_parts(
    task: Task, scene: Scene, ctx: StageContext, *, harmonics: bool = False,
    deadline: Deadline | None = None,
) -> Needs:
    """Returns which parts of the model the scene needs, and logs the reasons.

    Trials that would not end by the deadline are left out.
    """
    config = task.schedule.config

    def twins() -> list[TrainView]:
        denoised = dataclasses.replace(config, images="denoised")
        file = None if task.train[0].file is None else image_file(ctx)
        return [*load_views(scene.train, denoised, ctx, file)]

    changed = config.images == "auto" and any(
        not filecmp.cmp(view.original, view.denoised, shallow=False) for view in scene.train)
    needs = examine(TrialScene(
        task, scene.points, scene.colors, twins if changed else None, harmonics,
        tuple(view.name for view in (*scene.train, *scene.validation)), deadline or Deadline()))
    for decision in needs.decisions:
        logger.info("%s: %s, %s", decision.name, "on" if decision.on else "off", decision.reason)
    return needs


def _find_late_parts(
    config: RunConfig, task: Task, scene: Scene, deadline: Deadline
) -> list[str]:
    """Searches what parts add to the start, once at most; returns those without time for it."""
    task = dataclasses.replace(task, schedule=Schedule(config))
    late = []
    for part in PARTS:
        if part.prepare and part.is_on(config):
            try:
                part.prepare(task, task.evidence_of(scene.points), deadline)
            except OutOfTime:
                late.append(part.name)
    return late


def _measure_cost(
    config: TrainConfig, facts: Facts, task: Task, scene: Scene, out: Path
) -> TimeEstimator:
    """Returns the estimator of a run by timed steps."""
    seconds = CALIBRATION_SECONDS
    if config.minutes is not None:
        seconds = CALIBRATION_SHARE * 60 * config.minutes
    schedule = Schedule(probe_config(config, facts))
    return calibrate(
        dataclasses.replace(task, schedule=schedule), scene.points, scene.colors,
        scratch=out / "calibration.safetensors", seconds=seconds)


def _report_plan(plan: TrainPlan, config: TrainConfig, facts: Facts, ctx: StageContext) -> None:
    logger.info(
        "training takes about %.0f s: %s steps, up to %s Gaussians, images of up to %d pixels",
        plan.seconds, f"{plan.iterations - (plan.continues_at or 0):,}",
        f"{plan.max_gaussians:,}", plan.max_size)
    useful = useful_cap(facts, plan.iterations)
    if config.max_gaussians is None and plan.max_gaussians < useful:
        ctx.notice(f"memory has room for {plan.max_gaussians:,} Gaussians; {useful:,} would suit "
                   "the images")
    steps, usual = plan.iterations - (plan.continues_at or 0), QUALITIES[config.quality].iterations
    if config.minutes is not None and steps < LEAST_STEPS * usual:
        ctx.notice(f"{60 * config.minutes:.0f} s of training are too short: {steps:,} steps take "
                   f"{plan.seconds:.0f} s, and a {config.quality} run has {usual:,}. The scene "
                   f"will be blurred; about {format_minutes(plan.seconds * usual / steps)} of "
                   "training would not leave it so.")


def first_or_saved(
    task: Task, scene: Scene, checkpoint: Path, model: FinishedModel | None = None
) -> TrainState:
    """Returns the state that a checkpoint holds, or the first one: that of `model` if given."""
    if checkpoint.exists():
        return restore_state(checkpoint, task)
    if model is not None:
        return model.first_state(task)
    most = first_count(task.schedule.config, len(scene.points))
    return first_state(task, scene.points, scene.colors, most=most)
