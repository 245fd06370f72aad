"""Second-order steps against Adam: `python tests/bench/bench_second_order.py --help`.

WORKSPACE has its sfm done and is only read. All methods move one set of Gaussians from the same
start, a short training by the recipe up to the end of its densification; nothing is added or
deleted. Scored are validation views, in CPU seconds that leave scoring out.

- adam: the recipe's rates and schedule, over several lengths.
- lm: Gauss-Newton steps by conjugate gradients over a batch of views and a share of their pixels,
  with per-Gaussian blocks as preconditioner, Levenberg-Marquardt damping by the blocks of all
  views so far, and the step before as the start (Pehlivan et al. 2025, arXiv 2504.12905).
- blocks: momentum, divided by the blocks of all views so far; no parameter moves further in a step
  than by its rate in the recipe (as Sophia does, Liu et al. 2023).
- colours: likewise for colours and opacities alone, which are nearly linear; Adam moves the others.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path

import click
import gauss_newton as gn
import numpy as np
import torch
from workbench import numba_context, open_scene, print_head, print_row, workspace_argument

from recon_cli.config.stages import RunConfig
from recon_cli.evaluation.reference_views import mean_psnr_on_device
from recon_cli.render.numba import optimizer as adam
from recon_cli.scene.splats import Splats
from recon_cli.train.fit import fit
from recon_cli.train.initialize import first_state
from recon_cli.train.plan import first_count
from recon_cli.train.schedule import RECIPES, Schedule
from recon_cli.train.state import new_state
from recon_cli.train.stepper import Stepper
from recon_cli.train.task import Task
from recon_cli.train.train_data import load_task

VALIDATION = 0.17
DENSIFIED = 0.6  # share of the recipe's run at which densification has ended
KEEP = 0.97  # of the blocks of the views before, at each view
EPSILON = 1e-15


class FixedSchedule(Schedule):
    """The recipe's plan without densification."""

    def gathers(self, iteration: int) -> bool:  # noqa: ARG002
        """Returns False: nothing is added or deleted."""
        return False


def rates_of(task: Task, share: float, n: int) -> gn.Vector:
    """Returns the recipe's learning rate of every number after a share of a run."""
    config, schedule = task.schedule.config, task.schedule
    recipe = RECIPES[config.densify]
    iteration = round(share * config.iterations)
    factor = schedule.rate_factor(iteration)
    rates = (schedule.means_rate(iteration) * task.means_unit, factor * config.quats_rate,
             factor * recipe.scales_rate * config.scales_rate, factor * config.opacities_rate,
             factor * recipe.sh_rate * config.sh_rate)
    return np.repeat(np.array(rates, np.float32), np.array(gn.SIZES) * n)


class Method:
    """A way to move the parameters; `share` is how much of its time is used up."""

    def __init__(self, task: Task, start: Splats, seed: int) -> None:
        self.task, self.start = task, start
        self.values = gn.to_vector(start)
        self.count = len(start)
        self.random = np.random.default_rng(seed)
        self.background = start.background.detach().numpy().astype(np.float32)
        self.ssim_weight = task.schedule.config.ssim_weight
        self._queue: list[int] = []
        self.blocks = gn.Blocks(self.count)
        self.seen = 0  # views in the blocks

    @property
    def splats(self) -> Splats:
        """The Gaussians as they are now."""
        return gn.to_splats(self.values, self.start)

    def next_view(self, share: float) -> gn.TrainView:
        """Returns the next training view at the size of the recipe's schedule."""
        if not self._queue:
            self._queue = self.random.permutation(len(self.task.train)).tolist()
        steps = self.task.schedule.config.iterations
        level = self.task.schedule.level(1 + int(share * (steps - 1)))
        return self.task.pyramid.view(self._queue.pop(), level)

    def look(self, linear: gn.LinearizedView, share: float, gradient: gn.Vector, *,
             weigh: bool = True) -> None:
        """Linearises at the next view, and writes its gradient."""
        view = self.next_view(share)
        linear.render(self.values, view, self.background)
        linear.pull(linear.compare(view, self.ssim_weight, weigh=weigh), gradient)

    def gather(self, linear: gn.LinearizedView, weight: float) -> None:
        """Adds a view to the running mean of the blocks."""
        self.blocks.decay(KEEP)
        linear.add_blocks((1 - KEEP) * weight, self.blocks.geometry, self.blocks.colors)
        self.seen += 1

    @property
    def mean_factor(self) -> float:
        """What makes the running mean one, as in Adam."""
        return float(1 / (1 - KEEP**self.seen))

    def ridge(self, rates: gn.Vector, gradient: gn.Vector, strength: float) -> gn.Vector:
        """Returns a diagonal by which a usual gradient moves a number by its rate / strength."""
        result = np.empty_like(rates)
        for to, rate, slope in zip(*map(gn.parts, (result, rates, gradient)), strict=True):
            seen = slope[slope != 0]
            usual = float(np.sqrt(np.mean(np.square(seen, dtype=np.float64)))) if len(seen) else 1
            to[:] = strength * max(usual, 1e-12) / rate
        return result

    def step(self, share: float) -> None:
        """Moves the parameters once."""
        raise NotImplementedError


@dataclasses.dataclass(frozen=True)
class LmOptions:
    """How lm steps."""

    views: int = 16
    products: int = 4  # with the curvature, of each view in a step
    pixels: float = 0.3  # share that products see
    damping: float = 1.0  # of the blocks of all views
    ridge: float = 0.05  # of a usual gradient over the rate
    momentum: float = 0.5  # of the step before, at which conjugate gradients start
    length: float = 1.0  # of a step; falls to a tenth of it


class LevenbergMarquardt(Method):
    """Damped Gauss-Newton steps by conjugate gradients."""

    def __init__(
        self, task: Task, start: Splats, seed: int, options: LmOptions | None = None
    ) -> None:
        super().__init__(task, start, seed)
        self.options = options or LmOptions()
        self._views = [gn.LinearizedView() for _ in range(self.options.views)]
        self._before = np.zeros_like(self.values)

    def step(self, share: float) -> None:
        """Looks at a batch of views and solves for the step that all of them want."""
        options = self.options
        gradient, one = np.zeros_like(self.values), np.empty_like(self.values)
        for linear in self._views:
            self.look(linear, share, one)
            gradient += one / len(self._views)
            linear.sample(options.pixels, self.random)
            self.gather(linear, 1 / options.pixels)
        rates = rates_of(self.task, share, self.count)
        ridge = self.ridge(rates, gradient, options.ridge)
        mean = self.mean_factor
        inverse = gn.invert(self.blocks, (1 + options.damping) * mean, ridge)

        def multiply(change: gn.Vector) -> gn.Vector:
            product = gn.multiply_views(self._views, change, options.pixels)
            product += np.float32(options.damping * mean) * self.blocks.multiply(change)
            product += ridge * change
            return product

        start = np.float32(options.momentum) * self._before if options.momentum else None
        self._before = gn.conjugate_gradients(
            multiply, -gradient, inverse.multiply, options.products, start)
        self.values += np.float32(options.length * 0.1**share) * self._before


@dataclasses.dataclass(frozen=True)
class BlockOptions:
    """How blocks steps."""

    every: int = 8  # steps between views whose blocks are looked at
    momentum: float = 0.8
    length: float = 0.3  # of a Newton step
    most: float = 1.0  # rates that a number moves at most
    ridge: float = 0.03  # of a usual gradient over the rate
    colors_only: bool = False  # and opacities; Adam moves the others


class BlockNewton(Method):
    """Momentum, divided by the diagonal blocks of the curvature, and held to the rates."""

    def __init__(
        self, task: Task, start: Splats, seed: int, options: BlockOptions | None = None
    ) -> None:
        super().__init__(task, start, seed)
        self.options = options or BlockOptions()
        self._view = gn.LinearizedView()
        self._inverse = gn.Blocks(self.count)
        self._mean = np.zeros_like(self.values)
        self._square = np.zeros_like(self.values)
        self._steps = 0

    def step(self, share: float) -> None:
        """Looks at a view and moves along the running mean of the gradients."""
        options, gradient = self.options, np.empty_like(self.values)
        gathers = self._steps % options.every == 0
        self.look(self._view, share, gradient, weigh=gathers)
        self._steps += 1
        rates = rates_of(self.task, share, self.count)
        if gathers:
            self.gather(self._view, 1.0)
            blocks = self.blocks.select_appearance() if options.colors_only else self.blocks
            self._inverse = gn.invert(
                blocks, self.mean_factor / options.length,
                self.ridge(rates, gradient, options.ridge))
        if options.colors_only:
            self._adam(gradient, rates)
            return
        self._mean *= np.float32(options.momentum)
        self._mean += np.float32(1 - options.momentum) * gradient
        step = self._inverse.multiply(self._mean)
        bound = np.float32(options.most) * rates
        self.values -= np.clip(step, -bound, bound)

    def _adam(self, gradient: gn.Vector, rates: gn.Vector) -> None:
        momentum = RECIPES[self.task.schedule.config.densify].momentum
        before = self.values.copy()
        arrays = [[torch.from_numpy(part) for part in gn.parts(vector)]
                  for vector in (self.values, gradient, self._mean, self._square)]
        adam.step(arrays[0], arrays[1], (arrays[2], arrays[3]),
                  [float(part[0]) for part in gn.parts(rates)], count=self._steps,
                  betas=(momentum, 0.999), epsilon=EPSILON)
        step = self._inverse.multiply(self._mean)
        bound = np.float32(self.options.most) * rates
        for to, start, change, most in list(zip(*map(
                gn.parts, (self.values, before, step, bound)), strict=True))[3:]:
            to[:] = start - np.clip(change, -most, most)


def score(splats: Splats, task: Task) -> float:
    """Returns the mean PSNR of the validation views."""
    return mean_psnr_on_device(splats, task.validation, 0, task.backend)


Curve = list[tuple[float, float]]  # CPU seconds, dB


def run_method(method: Method, seconds: float, looks: int) -> tuple[Curve, int]:
    """Returns the curve of a method that has so many CPU seconds, and its steps."""
    used, steps, curve = 0.0, 0, list[tuple[float, float]]()
    while used < seconds:
        begin = time.process_time()
        method.step(used / seconds)
        used += time.process_time() - begin
        steps += 1
        if used >= seconds * (len(curve) + 1) / looks:
            curve.append((used, score(method.splats, method.task)))
    return curve, steps


def run_adam(task: Task, start: Splats, steps: int) -> tuple[float, float]:
    """Returns CPU seconds and dB of a run by the recipe over so many steps."""
    config = dataclasses.replace(task.schedule.config, iterations=steps)
    run = dataclasses.replace(task, schedule=FixedSchedule(config))
    copy = start.map(lambda tensor: tensor.detach().clone())
    state = new_state(copy, config, task.means_unit, backend=task.backend)
    stepper = Stepper(state, run, None)
    begin = time.process_time()
    for _ in range(steps):
        stepper.step()
    return time.process_time() - begin, score(
        state.splats.map(lambda tensor: tensor.detach()), task)


def make_start(workspace: Path, config: RunConfig, threads: int) -> tuple[Task, Splats]:
    """Returns the task, and the Gaussians of the recipe's run when densification has ended."""
    scene = open_scene(workspace, VALIDATION)
    task = load_task(scene, config, numba_context(threads))
    state = first_state(
        task, scene.points, scene.colors, most=first_count(config, len(scene.points)))
    fit(state, task, round(DENSIFIED * config.iterations))
    splats = state.splats.map(lambda tensor: tensor.detach().clone())
    return dataclasses.replace(task, schedule=FixedSchedule(config)), splats


METHODS: dict[str, Callable[[Task, Splats, int], Method]] = {
    "lm": LevenbergMarquardt,
    "blocks": BlockNewton,
    "colours": lambda task, start, seed: BlockNewton(
        task, start, seed, BlockOptions(colors_only=True)),
}


@click.command()
@workspace_argument
@click.option("--max-size", default=320, show_default=True)
@click.option("--max-gaussians", default=20_000, show_default=True)
@click.option("--start", "start_steps", default=200, show_default=True,
              help="Steps of the recipe's run that the start is taken from.")
@click.option("--steps", default="50,100,200,400", show_default=True, help="Lengths of Adam's.")
@click.option("--methods", default=",".join(METHODS), show_default=True)
@click.option("--share", default=0.7, show_default=True,
              help="CPU seconds of the others, of those of Adam's longest run.")
@click.option("--seed", default=0, show_default=True)
@click.option("--threads", default=1, show_default=True)
def main(workspace: Path, max_size: int, max_gaussians: int, start_steps: int, steps: str,
         methods: str, share: float, seed: int, threads: int) -> None:
    """Print validation PSNR against CPU seconds of each method."""
    config = RunConfig(
        iterations=start_steps, max_size=max_size, max_gaussians=max_gaussians, seed=seed,
        validation=VALIDATION, images="original", far="on", exposure="off", early_stop=False,
        sh_degree=0)
    task, start = make_start(workspace, config, threads)
    lengths = [int(word) for word in steps.split(",")]
    task = dataclasses.replace(task, schedule=FixedSchedule(
        dataclasses.replace(config, iterations=max(lengths))))
    click.echo(f"{len(start):,} Gaussians, {len(task.train)} views, start at "
               f"{score(start, task):.2f} dB")
    print_head("method", "steps", "CPU s", "dB")
    run_adam(task, start, 2)  # loads what is compiled
    seconds = 0.0
    for length in lengths:
        seconds, psnr = run_adam(task, start, length)
        print_row("adam", f"{length}", f"{seconds:.1f}", f"{psnr:.2f}")
    for name in methods.split(","):
        METHODS[name](task, start, seed).step(0.0)
        curve, count = run_method(METHODS[name](task, start, seed), share * seconds, 5)
        for used, psnr in curve:
            print_row(name, f"{round(count * used / curve[-1][0])}", f"{used:.1f}", f"{psnr:.2f}")


if __name__ == "__main__":
    main()
