"""Does filming from the suggested places help more than filming from anywhere?

    python tests/bench/bench_film_next.py WORKSPACE... [--removed] [--model PLY]

A third of the training views is taken away in one stretch, the middle third by name, and with it
the points that fewer than two of the others see. The rest is trained and suggestions are made; of
the views taken away the one nearest to each suggestion is given back, and then as many at random,
in several draws; last those that the score of the suggestions would choose among them, as many
evenly spread over the stretch, and all of the stretch, which bounds what any choice brings. Scores
are those of the held-out views; with --removed, where these lie on the path, of every third view
taken away, which is never given back. Prints one line a workspace.

With --model, a model of the whole scene in the workspace's frame, the pictures that are added are
rendered from it, those from the suggested places themselves and those of the random frames; so are
--everywhere N views that are scored, from random standing places to random sides.
"""

from __future__ import annotations

import zlib  # noqa: F401 - before pycolmap, which brings a zlib of its own
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import click
import numpy as np
from numpy.typing import NDArray

from recon_cli.config.stages import RunConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.evaluation.reference_views import (
    load_reference_views,
    load_scene,
    mean_psnr,
    render_view,
)
from recon_cli.io.images import to_uint8, write_png
from recon_cli.io.ply import read_ply
from recon_cli.machine import usable_threads
from recon_cli.scene.camera import Camera, looking_at
from recon_cli.scene.covisibility import observe_points
from recon_cli.scene.scene import Scene, View
from recon_cli.scene.splats import Splats
from recon_cli.train.fit import fit
from recon_cli.train.initialize import first_state
from recon_cli.train.schedule import make_schedule
from recon_cli.train.train_data import load_task
from recon_cli.trust.assess import film_next, standing_places
from recon_cli.trust.film_next import Suggestion, choose_views
from recon_cli.trust.scene_trust import Trust, measure_trust
from recon_cli.workspace.summaries import WorldSummary

SEES = 2  # views that a point needs, as in any mapping


@dataclass(frozen=True)
class Capture:
    """A capture with a hole."""

    scene: Scene  # without the stretch
    taken: tuple[View, ...]  # that can be given back
    scored: tuple[View, ...]
    config: RunConfig
    ctx: StageContext

    def train(self, given: Sequence[View]) -> tuple[Splats, Scene]:
        """Returns a short training with some views given back, and what it was trained on."""
        scene = replace(self.scene, train=tuple(
            sorted((*self.scene.train, *given), key=lambda view: view.name)))
        sees = observe_points(scene.points, [view.camera for view in scene.train])
        kept = np.bincount(sees.point, minlength=len(scene.points)) >= SEES
        scene = replace(scene, points=scene.points[kept], colors=scene.colors[kept])
        task = replace(load_task(scene, self.config, self.ctx), schedule=make_schedule(
            self.config, None))
        state = first_state(task, scene.points, scene.colors, most=self.config.max_gaussians // 2)
        fit(state, task, self.config.iterations)
        return state.splats.map(lambda tensor: tensor.detach()), scene

    def psnr(self, splats: Splats) -> float:
        """Returns the mean PSNR of the scored views."""
        views = load_reference_views(self.scored, self.config.max_size)
        return mean_psnr(splats, views, self.config.sh_degree, "numba", threads=self.ctx.threads)


def nearest(suggestions: Sequence[Suggestion], views: Sequence[View], scene: Scene) -> list[View]:
    """Returns for each suggestion the nearest view not taken yet: in place and direction.

    A radian counts as the median distance of the points.
    """
    size, left, chosen = scene.nearness, list(views), []
    for each in suggestions:
        apart = [np.linalg.norm(view.camera.center - each.position) / size + np.arccos(
            np.clip(view.camera.viewmat[2, :3] @ each.forward, -1, 1)) for view in left]
        chosen.append(left.pop(int(np.argmin(apart))))
    return chosen


def film(
    cameras: Sequence[Camera], model: Splats, folder: Path, ctx: StageContext
) -> list[View]:
    """Returns views whose pictures are rendered from a model of the whole scene."""
    views = []
    for number, camera in enumerate(cameras):
        path = folder / f"filmed_{number}.png"
        write_png(path, to_uint8(render_view(
            model, camera, model.sh_degree, ctx.backend).rgb.numpy()))
        views.append(View(path.name, camera, path, path))
    return views


def cameras_at(suggestions: Sequence[Suggestion], like: Camera) -> list[Camera]:
    """Returns level cameras at the suggested places; z is up wherever there are suggestions."""
    return [replace(like, viewmat=looking_at(
        np.array(each.position), np.array(each.position) + each.forward, np.array([0.0, 0.0, 1.0])))
        for each in suggestions]


def best_views(
    splats: Splats, trust: Trust, scene: Scene, workspace: Path, capture: Capture, count: int
) -> list[View]:
    """Returns the views taken away that the score itself would choose."""
    places, why = standing_places(splats, trust, scene, WorldSummary.read(workspace / "sfm"))
    assert places is not None, why
    rows = choose_views(splats, trust.support, trust.error, places, [
        view.camera for view in capture.taken], count, backend="numba")
    return [capture.taken[row] for row in rows]


def open_capture(workspace: Path, max_size: int, iterations: int, *, removed: bool) -> Capture:
    """Returns the capture of a workspace without its middle third."""
    inputs = StageInputs({name: workspace / name for name in ("ingest", "sfm")})
    scene = load_scene(inputs, validation=0.05)
    every, third = scene.train, len(scene.train) // 3
    stretch = every[third:2 * third]
    names = {view.name for view in stretch}
    low, high = min(names), max(names)
    aside = stretch[1::3] if removed else ()
    config = RunConfig(iterations=iterations, max_size=max_size, max_gaussians=30_000, sh_degree=1,
                       images="original", far="off", exposure="off")
    return Capture(
        replace(scene, train=tuple(view for view in every if view.name not in names),
                # a validation view in the stretch would show what is missing
                validation=tuple(view for view in scene.validation
                                 if not low <= view.name <= high)),
        tuple(view for view in stretch if view not in aside), aside or scene.test, config,
        StageContext(backend="numba", threads=usable_threads()))


def random_cameras(eyes: NDArray[np.float64], count: int, like: Camera) -> list[Camera]:
    """Returns level cameras at some of the places [P, 3], each to a random side."""
    rng = np.random.default_rng(1)
    up = np.array([0.0, 0.0, 1.0])
    cameras = []
    for row, angle in zip(rng.integers(len(eyes), size=count), rng.uniform(0, 2 * np.pi, count),
                          strict=True):
        ahead = np.array([np.cos(angle), np.sin(angle), 0.0])
        cameras.append(replace(like, viewmat=looking_at(eyes[row], eyes[row] + ahead, up)))
    return cameras


def compare_filmed(
    name: str, capture: Capture, splats: Splats, suggestions: Sequence[Suggestion], model: Splats,
    draws: int, scored: Sequence[Camera],
) -> None:
    """Prints the row of a workspace whose added pictures, and those `scored`, are rendered.

    `splats` were trained without any, `model` renders them.
    """
    like, rng = capture.taken[0].camera, np.random.default_rng(0)
    with TemporaryDirectory() as folder, TemporaryDirectory() as other:
        if scored:
            capture = replace(
                capture, scored=tuple(film(scored, model, Path(other), capture.ctx)))

        def psnr(cameras: Sequence[Camera]) -> float:
            return capture.psnr(capture.train(
                film(cameras, model, Path(folder), capture.ctx))[0])

        without = capture.psnr(splats)
        there = psnr(cameras_at(suggestions, like))
        scores = [psnr([capture.taken[row].camera for row in rng.choice(
            len(capture.taken), len(suggestions), replace=False)]) for _ in range(draws)]
    click.echo(
        f"| {name} | {len(capture.scored)} | {without:.2f} | {there:.2f} | {np.mean(scores):.2f} | "
        f"{' '.join(f'{score:.2f}' for score in scores)} | {there - np.mean(scores):+.2f} | | | |")


@click.command()
@click.argument("workspaces", nargs=-1, required=True,
                type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--removed", is_flag=True, help="Score views of the stretch.")
@click.option("--max-size", default=320, show_default=True, help="Longest side in pixels.")
@click.option("--iterations", default=1000, show_default=True, help="Steps of each training.")
@click.option("--draws", default=5, show_default=True, help="Random choices.")
@click.option("--everywhere", default=0, help="Views that are scored in place of the held-out.")
@click.option("--model", type=click.Path(exists=True, path_type=Path), help="Renders the pictures.")
def main(
    workspaces: Sequence[Path], removed: bool, max_size: int, iterations: int, draws: int,
    model: Path | None, everywhere: int,
) -> None:
    """Print PSNR with the nearest views to the suggestions, and with random ones."""
    if everywhere and model is None:
        raise click.UsageError("--everywhere needs a --model that its views are rendered from.")
    whole = None if model is None else read_ply(model)
    click.echo("| workspace | scored views | with a third missing | + suggested | + random | draws "
               "| gain | + by score | + evenly | + all |\n"
               "|---|---:|---:|---:|---:|---|---:|---:|---:|---:|")
    details = []
    for workspace in workspaces:
        capture = open_capture(workspace, max_size, iterations, removed=removed)
        splats, scene = capture.train(())
        trust = measure_trust(splats, scene, capture.config, max_size, capture.ctx)
        suggestions, why = film_next(
            splats, trust, scene, WorldSummary.read(workspace / "sfm"), capture.ctx)
        if not suggestions:
            click.echo(f"| {workspace.name} | {why} | | | | | | | | |")
            continue
        without = capture.psnr(splats)
        chosen = nearest(suggestions, capture.taken, scene)
        if whole is not None:
            places, _ = standing_places(
                splats, trust, scene, WorldSummary.read(workspace / "sfm"))
            assert places is not None
            compare_filmed(
                workspace.name, capture, splats, suggestions, whole, draws,
                random_cameras(places.eyes, everywhere, capture.taken[0].camera))
            continue
        details += [f"{workspace.name}: {each.describe('units')} -> {view.name}"
                    for each, view in zip(suggestions, chosen, strict=True)]
        with_chosen = capture.psnr(capture.train(chosen)[0])
        by_score = capture.psnr(capture.train(best_views(
            splats, trust, scene, workspace, capture, len(chosen)))[0])
        count = len(capture.taken)
        evenly = capture.psnr(capture.train([capture.taken[row] for row in np.linspace(
            0, count - 1, 2 * len(chosen) + 1).round().astype(int)[1::2]])[0])
        everything = capture.psnr(capture.train(capture.taken)[0])
        rng, scores = np.random.default_rng(0), []
        for _ in range(draws):
            rows = rng.choice(len(capture.taken), len(chosen), replace=False)
            scores.append(capture.psnr(capture.train([capture.taken[row] for row in rows])[0]))
        click.echo(
            f"| {workspace.name} | {len(capture.scored)} | {without:.2f} | {with_chosen:.2f} | "
            f"{np.mean(scores):.2f} | {' '.join(f'{score:.2f}' for score in scores)} | "
            f"{with_chosen - np.mean(scores):+.2f} | {by_score:.2f} | {evenly:.2f} | "
            f"{everything:.2f} |")
    click.echo("\n".join(["", *details]))


if __name__ == "__main__":
    main()
