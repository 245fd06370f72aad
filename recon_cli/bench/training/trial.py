"""One run of one arm on one scene: trained, stopped here and there, scored off the clock."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from recon_cli.bench.training.arms import Arm
from recon_cli.bench.training.clock import TrainingClock
from recon_cli.bench.training.removal import remove
from recon_cli.bench.training.scoring import load_scored, score
from recon_cli.config import RunConfig
from recon_cli.errors import ConfigError
from recon_cli.scene.scene import Scene, View
from recon_cli.stages.context import StageContext
from recon_cli.stages.fitting import MASK_HINT, load_task
from recon_cli.train.fit import Task, fit
from recon_cli.train.initialize import splats_from_points
from recon_cli.train.schedule import Schedule
from recon_cli.train.state import TrainState, new_state
from recon_cli.train.step import TrainView, fuses

PILOT_STEPS = 200  # the count changes twice in them at the usual hundred steps
_WARM_STEPS = 10  # caches and threads; the kernels are compiled before


@dataclass(frozen=True)
class Point:
    """How a run stands at one step.

    Attributes:
        iteration: steps done.
        seconds: of training alone, on the wall.
        cpu_seconds: of training alone, of all threads.
        gaussians: count.
        bytes: of the .ply that would be written.
        psnr_db: mean over the scored views.
        ssim: mean over the scored views.
    """

    iteration: int
    seconds: float
    cpu_seconds: float
    gaussians: int
    bytes: int
    psnr_db: float
    ssim: float


@dataclass(frozen=True)
class Run:
    """What is run: one arm from one seed for so many steps.

    Attributes:
        arm: how it is trained.
        base: options that all arms share.
        iterations: steps.
        seed: of every random choice.
    """

    arm: Arm
    base: RunConfig
    iterations: int
    seed: int

    @property
    def config(self) -> RunConfig:
        """The options of this run."""
        return self.arm.config(self.base, iterations=self.iterations, seed=self.seed)


@dataclass(frozen=True, eq=False)
class Stand:
    """A scene in memory, ready to be trained on by any arm.

    Attributes:
        name: of the scene.
        scene: its views and points.
        scored: the views that scores come from, with their original pixels.
        ctx: where to compute.
    """

    name: str
    scene: Scene
    scored: Sequence[TrainView]
    ctx: StageContext
    _tasks: dict[str, Task] = field(default_factory=dict)

    def task(self, config: RunConfig) -> Task:
        """Returns the task of a run; training itself looks at no view that it does not fit."""
        if config.images not in self._tasks:
            self._tasks[config.images] = load_task(self.scene, config, self.ctx)
        return dataclasses.replace(
            self._tasks[config.images], validation=[], schedule=Schedule(config))


def stand(
    name: str, scene: Scene, scored: Sequence[View], base: RunConfig, ctx: StageContext
) -> Stand:
    """Returns a scene with the views in memory that scores come from.

    Raises:
        ConfigError: the views are too small, or their masks leave none.
    """
    views = load_scored(scored, base.max_size, ctx)
    if not views:
        raise ConfigError(f"The masks of {name} leave no view to score.", hint=MASK_HINT)
    return Stand(name, scene, views, ctx)


def run_trial(
    where: Stand, run: Run, looks: Sequence[int], *, on_step: Callable[[], None]
) -> tuple[Point, ...]:
    """Trains and returns how the run stood after the steps in `looks`, and at its end.

    Args:
        where: the scene.
        run: what is trained.
        looks: steps after which the model is scored; 0 is before the first.
        on_step: called after each step.

    Raises:
        TrainingError: memory is short, or training diverged.
    """
    config = run.config
    task = where.task(config)
    state = _first_state(where.scene, config, task)
    cut = _cut(run)
    clock = TrainingClock(where.ctx.device)
    points = []
    for stop in sorted({*looks, run.iterations} | ({cut} if cut else set())):
        with clock.running():
            fit(state, task, stop, on_step=lambda _state: on_step(), on_report=lambda _report: None)
            if stop == cut and run.arm.prune:
                remove(state, task, run.arm.prune)
        if stop in looks or stop == run.iterations:
            points.append(_look(where, state, task, clock))
    return tuple(points)


def _cut(run: Run) -> int | None:
    """Returns the step after which the arm prunes."""
    if run.arm.prune is None:
        return None
    return min(run.iterations, max(1, round(run.arm.prune.at * run.iterations)))


def _first_state(scene: Scene, config: RunConfig, task: Task) -> TrainState:
    """Returns what the train stage starts from."""
    first = splats_from_points(
        scene.points, scene.colors, most=config.max_gaussians, seed=config.seed,
        sh_degree=config.sh_degree)
    return new_state(
        first.map(lambda tensor: tensor.to(task.device)), config, task.extent,
        fused=fuses(task.backend))


def _look(where: Stand, state: TrainState, task: Task, clock: TrainingClock) -> Point:
    found = score(
        state.splats.map(lambda tensor: tensor.detach()), where.scored,
        task.schedule.sh_degree(max(1, state.iteration)), where.ctx)
    return Point(
        state.iteration, round(clock.seconds, 3), round(clock.cpu_seconds, 3), found.gaussians,
        found.bytes, found.psnr_db, found.ssim)


def pilot(where: Stand, arm: Arm, base: RunConfig, *, on_step: Callable[[], None]) -> Point:
    """Returns the end of a short run, whose seconds say what a step of the arm costs here.

    It goes through the whole plan of the recipe. A few steps ahead warm the caches.
    """
    for iterations in (_WARM_STEPS, PILOT_STEPS):
        found = run_trial(where, Run(arm, base, iterations, 0), (), on_step=on_step)
    return found[-1]
