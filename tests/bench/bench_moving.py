"""Trains scenes through which people walk, with masks and without.

    python tests/bench/bench_moving.py ../shared/data/rooms/living --things people

A scene is a folder of rooms (exact poses and depth; its novel views are scored) or a workspace with
a trained model, whose depth says what hides what; its held-out views are scored. People are in a
third of the training views; the views that are scored hold nobody. The last training has exact
masks: more than that masks cannot gain.
"""

from __future__ import annotations

import dataclasses
import json
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import made_people
import numpy as np
import workbench
from numpy.typing import NDArray

from recon_cli.config.stages import TrainConfig
from recon_cli.context import StageContext
from recon_cli.evaluation.reference_views import load_reference_views, mean_psnr
from recon_cli.io.images import read_image, read_mask, write_png
from recon_cli.io.views import ReferenceView
from recon_cli.render.surface_depth import render_surface
from recon_cli.scene.camera import Camera
from recon_cli.scene.scene import Scene, View
from recon_cli.scene.splats import Splats
from recon_cli.scene.train_view import TrainView, leaves_enough
from recon_cli.splats.ply import read_ply
from recon_cli.stereo.depths import unproject
from recon_cli.train.masks import FOLDER, file_name
from recon_cli.train.one_model import fit_scene
from recon_cli.workspace.summaries import TrainPlan

Array = NDArray[np.float64]
Things = Sequence[made_people.Thing]
Drawn = dict[str, NDArray[np.bool_]]  # [2, H, W] things and their shadows, by name of the view
_POINTS = 300  # of each depth map, that a room begins with
_EVENT = 11  # views in which one person crosses
_NEAR = 1.35  # metres from the camera to a person, about a tenth of the pixels
_CAMERA_HEIGHT = 1.45  # metres above the floor
_LOWEST = 2.0  # percent of the points are below the floor
_SAMPLED = 2  # each second place of people is looked at in held-out views


def room_scene(folder: Path) -> Scene:
    """Returns a room with its exact cameras; every eighth view and the novel ones are held out."""
    values = json.loads((folder / "cam_params.json").read_text())["camera"]

    def views(place: Path) -> list[View]:
        poses = np.loadtxt(place / "traj.txt").reshape(-1, 4, 4)
        paths = [place / "results" / f"frame{row:06d}.jpg" for row in range(len(poses))]
        return [View(f"{place.name}_{path.stem}.png", Camera(
            values["w"], values["h"], values["fx"], values["fy"], values["cx"] + 0.5,
            values["cy"] + 0.5, np.linalg.inv(pose)), path, path)
            for path, pose in zip(paths, poses, strict=True)]

    path, novel = views(folder), views(folder / "test")
    points, colors = [], []
    draw = np.random.default_rng(0)
    for row, view in enumerate(path):
        depth = exact_depth(view)
        if depth is None or row % 8 == 0:
            continue
        pixels = draw.permutation(np.flatnonzero(depth > 0))[:_POINTS]
        points.append(unproject(view.camera, depth, pixels))
        image = read_image(view.original, view.camera.width, view.camera.height)
        colors.append(image.reshape(-1, 3)[pixels])
    train = [view for row, view in enumerate(path) if row % 8]
    return Scene(tuple(train), (), (*path[::8], *novel), (), np.concatenate(points),
                 np.concatenate(colors), up=np.array([0, 0, 1.0]))


def exact_depth(view: View) -> NDArray[np.float32] | None:
    """Returns the depth of a view of a room in metres, 0 for none; None where it has no file."""
    path = view.original.with_name(view.original.stem.replace("frame", "depth") + ".png")
    if path == view.original or not path.exists():
        return None
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED) / 6553.5, np.float32)


@dataclass(frozen=True, eq=False)
class Metres:
    """A world in metres, z up, with the floor at 0."""

    turn: Array  # [3, 3] from the scene's axes
    unit: float  # of the scene in a metre
    shift: float  # metres, added along z

    @staticmethod
    def from_scene(scene: Scene) -> Metres:
        """Returns that of a scene whose floor is where its lowest points are."""
        up = scene.up
        if up is None:
            up = -np.mean([view.camera.viewmat[1, :3] for view in scene.train], axis=0)
        turn = _turn_to_z(up / np.linalg.norm(up))
        floor = float(np.percentile(scene.points @ turn[2], _LOWEST))
        height = float(np.median([view.camera.center @ turn[2] for view in scene.train])) - floor
        unit = height / _CAMERA_HEIGHT
        return Metres(turn, unit, -floor / unit)

    def camera(self, camera: Camera) -> Camera:
        """Returns a camera in this world."""
        viewmat = np.eye(4)
        viewmat[:3, :3] = camera.viewmat[:3, :3] @ self.turn.T
        viewmat[:3, 3] = camera.viewmat[:3, 3] / self.unit - self.shift * viewmat[:3, 2]
        return dataclasses.replace(camera, viewmat=viewmat)


def _turn_to_z(up: Array) -> Array:
    aside = np.eye(3)[np.abs(up).argmin()]
    x = np.cross(aside, up) / np.linalg.norm(np.cross(aside, up))
    return np.stack([x, np.cross(up, x), up])


@dataclass(frozen=True, eq=False)
class Stage:
    """A scene into which things are drawn."""

    scene: Scene
    splats: Splats  # whose depth says what hides what, where none is exact
    metres: Metres

    def draw_into(self, things: Sequence[Things], out: Path) -> tuple[Scene, Drawn]:
        """Returns the scene with things in each training photo, and where they are by name."""
        out.mkdir(parents=True)
        drawn, views = {}, []
        for view, here in zip(self.scene.train, things, strict=True):
            if here:
                image, solid, shadow = self.draw_one(view, here)
                if solid.any():
                    drawn[view.name] = np.stack([solid, shadow])
                    write_png(out / view.name, image)
                    view = dataclasses.replace(view, original=out / view.name,
                                               denoised=out / view.name)
            views.append(view)
        return dataclasses.replace(self.scene, train=tuple(views)), drawn

    def draw_one(
        self, view: View, things: Things
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_], NDArray[np.bool_]]:
        """Returns a photo with things in it, and where they and their shadows are."""
        depth = exact_depth(view)
        if depth is None:
            depth = np.asarray(
                render_surface(self.splats, view.camera, backend="numba").depth.numpy(), np.float32)
        photo = read_image(view.original, view.camera.width, view.camera.height)
        return made_people.draw(
            photo, depth / np.float32(self.metres.unit), self.metres.camera(view.camera), things)

    @property
    def cameras(self) -> list[Camera]:
        """Those of training, in metres."""
        return [self.metres.camera(view.camera) for view in self.scene.train]


def _events(count: int) -> list[range]:
    """Returns stretches of training views that are a third of all."""
    events = max(1, round(count / 3 / _EVENT))
    length = round(count / 3 / events)
    firsts = [round((event + 0.5) * count / events - length / 2) for event in range(events)]
    return [range(first, first + length) for first in firsts]


def people(cameras: Sequence[Camera]) -> list[Things]:
    """Returns who is in which training view: one person after another, in a third of them."""
    here: list[Things] = [[] for _ in cameras]
    for rows in _events(len(cameras)):
        way = made_people.cross_view(cameras[rows[0]], cameras[rows[-1]], len(rows), _NEAR)
        for row, (foot, heading, walked) in zip(rows, way, strict=True):
            here[row] = [made_people.person(foot, heading, walked)]
    return here


def standing(cameras: Sequence[Camera]) -> list[Things]:
    """Returns who is in which training view: people who stand still, each in several views."""
    here: list[Things] = [[] for _ in cameras]
    for rows in _events(len(cameras)):
        middle = rows[len(rows) // 2]
        (foot, heading, _), = made_people.cross_view(
            cameras[middle], cameras[middle], 1, _NEAR, bearing=0.1)
        for row in rows:
            here[row] = [made_people.person(foot, heading, 0.2)]
    return here


def train(scene: Scene, config: TrainConfig, out: Path) -> tuple[Splats, float, TrainPlan]:
    """Returns the Gaussians of a training, its CPU seconds, and its plan."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    start = time.process_time()
    fit_scene(config, scene, out, StageContext(backend="numba", threads=1))
    return read_ply(out / "splats.ply"), time.process_time() - start, TrainPlan.read(out)


def found_shares(
    scene: Scene, out: Path, drawn: Mapping[str, NDArray[np.bool_]]
) -> tuple[float, float, float]:
    """Returns which share of things and of shadows is masked, and of all other pixels."""
    sums = np.zeros((3, 2))
    for view in scene.train:
        shape = view.camera.height, view.camera.width
        path = out / FOLDER / file_name(view)
        masked = ~read_mask(path, shape[1], shape[0]) if path.exists() else np.zeros(shape, bool)
        solid, shadow = drawn.get(view.name, np.zeros((2, *shape), bool))
        for row, part in zip(sums, (solid, shadow, ~solid & ~shadow), strict=True):
            row += (masked & part).sum(), part.sum()
    shares = sums[:, 0] / np.maximum(sums[:, 1], 1)
    return float(shares[0]), float(shares[1]), float(shares[2])


def open_scene(folder: Path) -> tuple[Scene, Splats | None]:
    """Returns a room, or the scene and the model of a workspace."""
    if (folder / "cam_params.json").exists():
        return room_scene(folder), None
    _, scene, splats = workbench.open_trained(folder)
    return scene, splats


def mark_places(
    stage: Stage, held_out: Sequence[ReferenceView], things: Sequence[Things]
) -> list[TrainView]:
    """Returns held-out views of which only the pixels count where a thing stood at some time."""
    by_name = {view.name: view for view in stage.scene.test}
    every = [thing for here in things[::_SAMPLED] for thing in here]
    marked = []
    for view in held_out:
        _, solid, _ = stage.draw_one(by_name[view.name], every)
        there = cv2.resize(solid.astype(np.uint8), (view.camera.width, view.camera.height),
                           interpolation=cv2.INTER_NEAREST) > 0
        if leaves_enough(there):
            marked.append(dataclasses.replace(view, mask=there))
    return marked


def with_ideal_masks(made: Scene, drawn: Drawn, out: Path) -> Scene:
    """Returns a scene of which exactly what was drawn is masked, 2 pixels more around."""
    out.mkdir(parents=True)
    views = []
    for view in made.train:
        if view.name in drawn:
            hidden = cv2.dilate(drawn[view.name].any(axis=0).astype(np.uint8), np.ones((5, 5)))
            write_png(out / view.name, ((hidden == 0) * 255).astype(np.uint8))
            view = dataclasses.replace(view, mask=out / view.name)
        views.append(view)
    return dataclasses.replace(made, train=tuple(views))


KINDS = {"people": people, "standing": standing}


@workbench.click.command()
@workbench.click.argument("folder", type=workbench.FOLDER)
@workbench.click.argument("out", type=workbench.click.Path(path_type=Path))
@workbench.click.option("--things", "kind", default="people",
                        type=workbench.click.Choice([*KINDS]))
@workbench.click.option("--iterations", default=1000)
@workbench.click.option("--max-size", default=320)
@workbench.click.option("--only", multiple=True, help="Trainings, of those in the table.")
def main(
    folder: Path, out: Path, kind: str, iterations: int, max_size: int, only: tuple[str, ...]
) -> None:
    """Trains clean, without masks and with them, in OUT, and scores views that hold nobody."""
    workbench.numba_context()
    scene, splats = open_scene(folder)
    config = TrainConfig(
        iterations=iterations, max_size=max_size, sh_degree=1, background="off", exposure="off",
        stereo="off", validation=0.0, moving="off")
    if (out / "clean/splats.ply").exists():
        clean, seconds = read_ply(out / "clean/splats.ply"), 0.0
    else:
        clean, seconds, _ = train(scene, config, out / "clean")
    stage = Stage(scene, splats or clean, Metres.from_scene(scene))
    things = KINDS[kind](stage.cameras)
    for name in ("photos", "ideal-masks"):
        shutil.rmtree(out / name, ignore_errors=True)
    made, drawn = stage.draw_into(things, out / "photos")
    workbench.print_head("training", "path dB", "novel dB", "where things were", "things masked",
                         "shadows", "others", "CPU s")
    held_out = load_reference_views(scene.test, max_size)
    sides: list[Sequence[TrainView]] = [
        [view for view in held_out if view.name.startswith("test_") is novel]
        for novel in (False, True)]
    sides.append(mark_places(stage, held_out, things))

    def show(name: str, model: Splats, seconds: float) -> None:
        scores = [f"{mean_psnr(model, side, 1, 'numba'):.2f}" if side else "" for side in sides]
        masked = [f"{100 * share:.1f}%" for share in found_shares(scene, out / name, drawn)]
        workbench.print_row(name, *scores, *masked, f"{seconds:.0f}")

    show("clean", clean, seconds)
    for name, moving in (("without", "off"), ("with", "auto"), ("ideal", "off")):
        if only and name not in only:
            continue
        trained = made if name != "ideal" else with_ideal_masks(made, drawn, out / "ideal-masks")
        model, seconds, plan = train(
            trained, dataclasses.replace(config, moving=moving), out / name)
        show(name, model, seconds)
        for decision in plan.needs:
            workbench.click.echo(f"{decision.name}: {decision.reason}")


if __name__ == "__main__":
    main()
