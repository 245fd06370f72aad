"""Which weights of the error model fit what the views of a capture do not show?

    python tests/bench/fit_trust_weights.py WORKSPACE... [--max-size 320]

A third of the training views of each capture is taken away in one stretch, the middle third by
name, and with it the points that fewer than two of the others see; the rest is trained, and the
weights of the expected error are fitted to the real errors in
the stretch, without the pull towards PRIOR, for each capture by itself and for all with a bias
each. The last row is what PRIOR is rounded from. Held-out views are not looked at.
"""

from __future__ import annotations

import zlib  # noqa: F401 - before pycolmap, which brings a zlib of its own
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from workbench import numba_context, open_scene, print_head, print_row, workspaces_argument

from recon_cli.config.stages import RunConfig
from recon_cli.context import StageContext
from recon_cli.evaluation.reference_views import RenderedModel
from recon_cli.machine import usable_threads
from recon_cli.scene.covisibility import observe_points
from recon_cli.scene.scene import Scene, View
from recon_cli.scene.splats import Splats
from recon_cli.train.fit.initialize import first_state
from recon_cli.train.fit.loop import fit
from recon_cli.train.fit.schedule import make_schedule
from recon_cli.train.fit.train_data import load_task, load_views
from recon_cli.trust.error_model import picture_terms
from recon_cli.trust.records import PRIOR, TERMS
from recon_cli.trust.scene_trust import measure_trust
from recon_cli.trust.support import error_image

PIXELS = 60_000  # of each capture
MOST = 6.0  # of a weight

SEES = 2  # views that a point needs, as in any mapping

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Capture:
    """A capture with a hole."""

    scene: Scene  # without the stretch
    taken: tuple[View, ...]  # the stretch
    config: RunConfig
    ctx: StageContext

    def train(self) -> tuple[Splats, Scene]:
        """Returns a short training, and what it was trained on."""
        scene = self.scene
        sees = observe_points(scene.points, [view.camera for view in scene.train])
        kept = np.bincount(sees.point, minlength=len(scene.points)) >= SEES
        scene = replace(scene, points=scene.points[kept], colors=scene.colors[kept])
        task = replace(load_task(scene, self.config, self.ctx), schedule=make_schedule(
            self.config, None))
        state = first_state(task, scene.points, scene.colors, most=self.config.max_gaussians // 2)
        fit(state, task, self.config.iterations)
        return state.splats.map(lambda tensor: tensor.detach()), scene


def open_capture(workspace: Path, max_size: int, iterations: int) -> Capture:
    """Returns the capture of a workspace without its middle third."""
    scene = open_scene(workspace, 0.05)
    every, third = scene.train, len(scene.train) // 3
    stretch = every[third:2 * third]
    names = {view.name for view in stretch}
    low, high = min(names), max(names)
    config = RunConfig(iterations=iterations, max_size=max_size, max_gaussians=30_000, sh_degree=1,
                       images="original", background="off", exposure="off")
    return Capture(
        replace(scene, train=tuple(view for view in every if view.name not in names),
                # a validation view in the stretch would show what is missing
                validation=tuple(view for view in scene.validation
                                 if not low <= view.name <= high)),
        tuple(stretch), config, numba_context(usable_threads()))


def read_stretch(workspace: Path, max_size: int, iterations: int) -> tuple[Array, Array]:
    """Returns the terms [P, K] of pixels in the stretch that was taken away, and their errors."""
    capture = open_capture(workspace, max_size, iterations)
    splats, scene = capture.train()
    model = RenderedModel(splats, capture.config.sh_degree, "numba")
    support = measure_trust(model, scene, capture.config, max_size, capture.ctx).support
    columns: list[Array] = []
    errors: list[Array] = []
    for view in load_views(capture.taken, capture.config, capture.ctx):
        picture = picture_terms(model, support, view.camera)
        error, counts = error_image(picture.rgb, view, gains=False)
        used = counts > 0
        errors.append(np.asarray(error[used], np.float64))
        columns.append(np.stack([picture.terms[name][used] for name in TERMS], 1).astype(float))
    real = np.concatenate(errors)
    rows = slice(None, None, max(1, len(real) // PIXELS))
    return np.concatenate(columns)[rows], real[rows]


def fit_together(captures: Sequence[tuple[Array, Array]]) -> Array:
    """Returns the weights [K] that fit all captures best, each with a bias of its own.

    Poisson's quasi-likelihood in units of a capture's mean error, as in `fit_weights`.
    """
    def loss(values: Array) -> tuple[float, Array]:
        total, slope = 0.0, np.zeros_like(values)
        for index, (terms, errors) in enumerate(captures):
            log = np.minimum(values[index] + terms @ values[len(captures):], 50)
            expected, mean = np.exp(log), errors.mean()
            gap = (expected - errors) / mean
            total += float((expected - errors * log).mean() / mean)
            slope[index] = gap.mean()
            slope[len(captures):] += (terms * gap[:, None]).mean(0)
        return total, slope

    prior = np.array([PRIOR[name] for name in TERMS])
    biases = [np.log(errors.mean() / np.exp(terms @ prior).mean()) for terms, errors in captures]
    result = minimize(
        loss, np.concatenate([biases, prior]), jac=True, method="L-BFGS-B",
        bounds=[(None, None)] * len(captures) + [(0, MOST)] * len(prior))
    return np.asarray(result.x[len(captures):])


@click.command()
@workspaces_argument
@click.option("--max-size", default=320, show_default=True, help="Longest side in pixels.")
@click.option("--iterations", default=1000, show_default=True, help="Steps of each training.")
def main(workspaces: Sequence[Path], max_size: int, iterations: int) -> None:
    """Print the weights of each capture and of all together."""
    print_head("capture", *TERMS)
    captures = []
    for workspace in workspaces:
        captures.append(read_stretch(workspace, max_size, iterations))
        print_weights(workspace.name, fit_together(captures[-1:]))
    print_weights("all", fit_together(captures))
    print_weights("PRIOR", np.array([PRIOR[name] for name in TERMS]))


def print_weights(name: str, weights: Array) -> None:
    """Prints a row of the table."""
    print_row(name, *(f"{weight:.2f}" for weight in weights))


if __name__ == "__main__":
    main()
