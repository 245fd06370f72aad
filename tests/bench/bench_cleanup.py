"""What --drop-floaters and --drop-islands take from trained scenes, and from spoilt ones.

`python tests/bench/bench_cleanup.py WORKSPACE...`, each with a fresh training. Printed are the
Gaussians that go, by kind, and the PSNR on the validation views; then the same of the scene with 60
floaters planted on lines of sight of training views, at 15 to 60% of the way to the surface, and
with an island of 60 Gaussians planted where there is most space.

With `--bounds` a table instead: the bounding sphere of a file over that of its room, and the PSNR
that bounds of 3, 10 and 30 times the room and no backdrop cost on all views.
"""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import click
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from workbench import open_trained, print_head, print_row, workspaces_argument

from recon_cli.context import StageContext
from recon_cli.evaluation.reference_views import load_reference_views, mean_psnr
from recon_cli.export import bounds
from recon_cli.export.cleanup import count_sightings, find_floaters, find_islands
from recon_cli.export.verify import load_reference_psnr
from recon_cli.io.images import fit_camera
from recon_cli.io.views import evenly_spread
from recon_cli.render import render
from recon_cli.render.registry import resolve
from recon_cli.scene.scene import Scene
from recon_cli.scene.similarity import Similarity
from recon_cli.scene.splats import SH_C0, Splats, joined
from recon_cli.scene.train_view import TrainView
from recon_cli.train.fit.train_data import load_views

PLANTED = 60


def added(
    splats: Splats, places: NDArray[np.float64], sizes: NDArray[np.float64],
    draw: np.random.Generator,
) -> tuple[Splats, torch.Tensor]:
    """Returns the scene with round Gaussians of any colour added, and which those are [N]."""
    n = len(places)
    more = Splats(
        torch.tensor(places).float(), torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        torch.tensor(np.log(sizes)).float()[:, None].repeat(1, 3),
        torch.logit(torch.tensor(draw.uniform(0.1, 0.9, n)).float()),
        torch.tensor((draw.random((n, 3)) - 0.5) / SH_C0).float(),
        splats.sh_rest.new_zeros(0, *splats.sh_rest.shape[1:]))
    both, order = joined([splats, more])
    return both, order >= len(splats)


def before_views(
    splats: Splats, views: list[TrainView], ctx: StageContext, draw: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns places on lines of sight and sizes that cover two to six degrees."""
    places, sizes = [], []
    for _ in range(PLANTED):
        camera = views[draw.integers(len(views))].camera
        with torch.no_grad():
            shown = render(splats, camera, splats.background, splats.sh_degree, backend=ctx.backend)
        line, column = draw.integers(camera.height), draw.integers(camera.width)
        depth = float(shown.depth[line, column] / shown.alpha[line, column].clamp_min(1e-3))
        z = depth * draw.uniform(0.15, 0.6)
        ray = np.array([
            (column - camera.cx) / camera.fx * z, (line - camera.cy) / camera.fy * z, z])
        places.append(camera.viewmat[:3, :3].T @ (ray - camera.viewmat[:3, 3]))
        sizes.append(z * draw.uniform(0.02, 0.06))
    return np.array(places), np.array(sizes)


def emptiest(splats: Splats, scene: Scene, draw: np.random.Generator) -> NDArray[np.float64]:
    """Returns the place near the cameras that is farthest from all Gaussians."""
    places = scene.center + 0.8 * scene.extent * draw.uniform(-1, 1, (500, 3))
    return np.asarray(places[cKDTree(splats.means.numpy()).query(places)[0].argmax()])


def print_bounds(workspaces: tuple[Path, ...], ctx: StageContext) -> None:
    """Prints what bounds cost: a row for each workspace and bound."""
    print_head("scene", "far", "bound", "Gaussians", "sphere / room", "all views dB", "change dB",
               "seconds")
    for root in workspaces:
        config, scene, splats = open_trained(root)
        views = load_reference_views(
            [*scene.train, *scene.validation, *scene.test], config.max_size)
        cameras = [fit_camera(view.camera, bounds.SIZE)
                   for view in evenly_spread(scene.train, bounds.VIEWS)]
        room = bounds.Room.from_points(
            scene.points, np.stack([view.camera.center for view in scene.train]))
        inside = splats.means.double()[splats.within(room.center.tolist(), room.radius)]
        before = mean_psnr(splats, views, splats.sh_degree, ctx.backend)
        for name, make in (
                ("keep", lambda scene=splats: scene.with_sphere()),
                *((f"{most:g} rooms", partial(
                    bounds.bound_scene, splats, room, cameras, ctx, spheres=(most,)))
                  for most in bounds.SPHERES),
                ("drop", partial(replace, splats, backdrop=None))):
            begin = time.perf_counter()
            bounded = make()
            seconds = time.perf_counter() - begin
            after = mean_psnr(bounded, views, bounded.sh_degree, ctx.backend)
            ratio = (bounds.bounding_sphere(bounded.means.double())
                     / bounds.bounding_sphere(inside))
            print_row(root.name, config.background, name, f"{len(bounded):,}", f"{ratio:.1f}",
                      f"{after:.2f}", f"{after - before:+.2f}", f"{seconds:.1f}")


@click.command()
@click.option("--bounds", "only_bounds", is_flag=True, help="Print what bounds cost instead.")
@workspaces_argument
def main(workspaces: tuple[Path, ...], only_bounds: bool) -> None:
    """Prints some lines for each workspace."""
    backend, device = resolve("auto", "cpu")
    ctx = StageContext(backend=backend, device=device)
    if only_bounds:
        print_bounds(workspaces, ctx)
        return
    for root in workspaces:
        (config, scene, splats), draw = open_trained(root), np.random.default_rng(0)
        views, held = load_views(scene.train, config, ctx), load_reference_psnr(
            scene, Similarity(), config.max_size, ctx)
        clean = held.psnr_db(splats)
        spoilt = added(splats, *before_views(splats, views, ctx, draw), draw)
        for name, (whole, planted) in (
                ("as trained", (splats, torch.zeros(len(splats), dtype=torch.bool))),
                (f"{PLANTED} floaters", spoilt)):
            begin = time.perf_counter()
            found = find_floaters(whole, views, backend=backend)
            seconds, gone = time.perf_counter() - begin, found.all
            click.echo(
                f"{root.name}, {name}: unseen {int(found.unseen.sum())}, in front "
                f"{int(found.in_front.sum())}, harmful {int(found.harmful.sum())}; planted "
                f"{int((gone & planted).sum())} of {int(planted.sum())}; "
                f"{held.psnr_db(whole):.3f} -> {held.psnr_db(whole.select(~gone)):.3f} dB "
                f"(without any planted {clean:.3f}), {seconds:.0f} s")
        island = emptiest(splats, scene, draw) + draw.normal(0, 0.02 * scene.extent, (PLANTED, 3))
        spoilt = added(splats, island, np.full(PLANTED, 0.01 * scene.extent), draw)
        for name, (whole, planted) in (
                ("as trained", (splats, torch.zeros(len(splats), dtype=torch.bool))),
                ("an island", spoilt)):
            near = whole.within(scene.center.tolist(), scene.reach)
            gone = find_islands(whole, near, count_sightings(whole, views, backend=backend) > 0)
            click.echo(
                f"{root.name}, {name}: {int(gone.sum())} in islands, planted "
                f"{int((gone & planted).sum())} of {int(planted.sum())}; "
                f"{held.psnr_db(whole):.3f} -> {held.psnr_db(whole.select(~gone)):.3f} dB; "
                f"{int((~near).sum())} far away are left alone")


if __name__ == "__main__":
    main()
