"""Trains scenes through which people walk, or in which a chair is moved, with masks and without.

    python tests/bench/bench_moving.py ../shared/data/rooms/living --things people

A scene is a folder of rooms (exact poses and depth; its novel views are scored) or a workspace with
a trained model, whose depth says what hides what; its held-out views are scored. People are in a
third of the training views; the views that are scored hold nobody. The chair stands in one place in
the first half of the capture and in another in the second.
"""

from __future__ import annotations

import dataclasses
import json
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import cv2
import made_people
import numpy as np
import workbench
from numpy.typing import NDArray

from recon_cli.config.stages import TrainConfig
from recon_cli.context import StageContext
from recon_cli.evaluation.reference_views import load_reference_views, mean_psnr, render_view
from recon_cli.io.images import read_image, read_mask, write_png
from recon_cli.render.surface_depth import render_surface
from recon_cli.scene.camera import Camera
from recon_cli.scene.scene import Scene, View
from recon_cli.scene.splats import Splats
from recon_cli.splats.ply import read_ply
from recon_cli.stereo.depths import places
from recon_cli.train.moving_masks import FOLDER, file_name
from recon_cli.train.one_model import fit_scene
from recon_cli.workspace.summaries import TrainPlan

Array = NDArray[np.float64]
_POINTS = 300  # of each depth map, that a room begins with
_EVENT = 11  # views in which one person crosses
_NEAR = 1.35  # metres from the camera to a person, about a tenth of the pixels
_CAMERA_HEIGHT = 1.45  # metres, of whoever films, where a scene has no scale


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
        points.append(places(view.camera, depth, pixels))
        image = read_image(view.original, view.camera.width, view.camera.height)
        colors.append(image.reshape(-1, 3)[pixels])
    train = [view for row, view in enumerate(path) if row % 8]
    return Scene(tuple(train), (), (*path[::8], *novel), (), np.concatenate(points),
                 np.concatenate(colors), up=np.array([0, 0, 1.0]))


def exact_depth(view: View) -> NDArray[np.float32] | None:
    """Returns the depth of a view of a room in metres, 0 for none; None where it has no file."""
    path = view.original.with_name(view.original.stem.replace("frame", "depth") + ".png")
    if not path.exists():
        return None
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED) / 6553.5, np.float32)


def draw_into(
    scene: Scene, splats: Splats, things: Callable[[int], Sequence[made_people.Thing]], out: Path
) -> tuple[Scene, dict[str, NDArray[np.bool_]]]:
    """Returns a scene whose training photos hold things, by their place, and where they do."""
    out.mkdir(parents=True)
    drawn, views = {}, []
    for row, view in enumerate(scene.train):
        here = things(row)
        if here:
            image, solid, shadow = draw_one(view, splats, here)
            if solid.any():
                drawn[view.name] = np.stack([solid, shadow])
                write_png(out / view.name, image)
                view = dataclasses.replace(view, original=out / view.name,
                                           denoised=out / view.name)
        views.append(view)
    return dataclasses.replace(scene, train=tuple(views)), drawn


def draw_one(
    view: View, splats: Splats, things: Sequence[made_people.Thing]
) -> tuple[NDArray[np.uint8], NDArray[np.bool_], NDArray[np.bool_]]:
    """Returns a photo with things in it, and where they and their shadows are."""
    depth = exact_depth(view)
    if depth is None:
        depth = np.asarray(
            render_surface(splats, view.camera, backend="numba").depth.numpy(), np.float32)
    photo = read_image(view.original, view.camera.width, view.camera.height)
    return made_people.draw(photo, depth, view.camera, things)


def _unit(scene: Scene) -> float:
    """Returns the units of a metre, by the height of the cameras above the floor at 0."""
    return float(np.median([view.camera.center[2] for view in scene.train]) / _CAMERA_HEIGHT)


def people(scene: Scene) -> Callable[[int], Sequence[made_people.Thing]]:
    """Returns who is in which training view: one person after another, in a third of them."""
    count = len(scene.train)
    unit = _unit(scene)
    events = max(1, round(count / 3 / _EVENT))
    length = round(count / 3 / events)
    here: dict[int, made_people.Thing] = {}
    for event in range(events):
        first = round((event + 0.5) * count / events - length / 2)
        way = made_people.cross_view(
            scene.train[first].camera, scene.train[first + length - 1].camera, length,
            _NEAR * unit)
        for step, (foot, heading, walked) in enumerate(way):
            here[first + step] = made_people.person(foot, heading, walked, 1.7 * unit)
    return lambda row: [here[row]] if row in here else []


def chairs(scene: Scene) -> tuple[Callable[[int], Sequence[made_people.Thing]], list[Array]]:
    """Returns which chair is in which training view, and the two places where it stands.

    The floor is searched for places that many views of each half see from a distance.
    """
    half, unit = len(scene.train) // 2, _unit(scene)
    low, high = np.percentile(scene.points[:, :2], [10, 90], axis=0)
    places = [np.array([x, y]) for x in np.linspace(low[0], high[0], 9)
              for y in np.linspace(low[1], high[1], 9)]

    def seen(place: Array) -> tuple[int, int]:
        rows = [_shows(view.camera, np.array([*place, 0.45 * unit]), unit) for view in scene.train]
        return sum(rows[:half]), sum(rows[half:])

    counts = np.array([seen(place) for place in places])
    # each where one half saw it more, and both saw it
    first = int(np.argmax(np.where(counts[:, 0] > counts[:, 1], counts.min(axis=1), -1)))
    second = int(np.argmax(np.where(counts[:, 1] > counts[:, 0], counts.min(axis=1), -1)))
    chosen = [places[first], places[second]]
    stands = [made_people.chair(place, 0.7, 0.9 * unit) for place in chosen]
    return lambda row: [stands[0] if row < half else stands[1]], chosen


def _shows(camera: Camera, place: Array, unit: float) -> bool:
    """Returns whether a camera has a place well inside its image, not too near."""
    x, y, z = camera.viewmat[:3, :3] @ place + camera.viewmat[:3, 3]
    return bool(z > 1.2 * unit and 0.1 < (camera.fx * x / z + camera.cx) / camera.width < 0.9
                and 0.1 < (camera.fy * y / z + camera.cy) / camera.height < 0.9)


def ghosts(
    scene: Scene, splats: Splats, model: Splats, config: TrainConfig, standing: Sequence[Array]
) -> list[float]:
    """Returns how much of the rarer state shows where the chair stood, 0 to 1, for each place.

    In the pixels of the chair in held-out views a render is compared with the photo and with the
    photo with the chair: it is a mixture of both.
    """
    found = []
    unit, half = _unit(scene), len(scene.train) // 2
    for index, place in enumerate(standing):
        thing = made_people.chair(place, 0.7, 0.9 * unit)
        middle = np.array([*place, 0.45 * unit])
        rows = [_shows(view.camera, middle, unit) for view in scene.train]
        by_half = sum(rows[:half]), sum(rows[half:])
        there = by_half[index] > by_half[1 - index]
        top = bottom = 0.0
        for view in scene.test:
            if not _shows(view.camera, middle, unit):
                continue
            with_it, solid, _ = draw_one(view, splats, [thing])
            empty = read_image(view.original, view.camera.width, view.camera.height)
            usual, rare = (with_it, empty) if there else (empty, with_it)
            rgb = 255 * render_view(model, view.camera, config.sh_degree or 0, "numba").rgb.numpy()
            apart = (rare.astype(float) - usual)[solid]
            top += float(((rgb - usual)[solid] * apart).sum())
            bottom += float((apart**2).sum())
        found.append(top / max(bottom, 1e-9))
    return found


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


@workbench.click.command()
@workbench.click.argument("folder", type=workbench.FOLDER)
@workbench.click.argument("out", type=workbench.click.Path(path_type=Path))
@workbench.click.option("--things", type=workbench.click.Choice(["people", "chair"]),
                        default="people")
@workbench.click.option("--iterations", default=1000)
@workbench.click.option("--max-size", default=320)
def main(folder: Path, out: Path, things: str, iterations: int, max_size: int) -> None:
    """Trains clean, without masks and with them, in OUT, and scores views that hold nobody."""
    workbench.numba_context()
    scene, splats = open_scene(folder)
    config = TrainConfig(
        iterations=iterations, max_size=max_size, sh_degree=1, far="off", exposure="off",
        stereo="off", validation=0.0)
    clean, seconds, _ = train(scene, config, out / "clean")
    splats = splats or clean
    chosen, standing = chairs(scene) if things == "chair" else (people(scene), [])
    shutil.rmtree(out / "photos", ignore_errors=True)
    made, drawn = draw_into(scene, splats, chosen, out / "photos")
    workbench.print_head("training", "path dB", "novel dB", "things masked", "shadows", "others",
                         "ghost A", "ghost B", "CPU s")
    held_out = load_reference_views(scene.test, max_size)
    sides = [[view for view in held_out if view.name.startswith("test_") is novel]
             for novel in (False, True)]

    def show(name: str, model: Splats, seconds: float) -> None:
        scores = [f"{mean_psnr(model, side, 1, 'numba'):.2f}" if side else "" for side in sides]
        marks = [f"{value:.2f}" for value in ghosts(scene, splats, model, config, standing)]
        masked = [f"{100 * share:.1f}%" for share in found_shares(scene, out / name, drawn)]
        workbench.print_row(name, *scores, *masked, *(marks or ["", ""]), f"{seconds:.0f}")

    show("clean", clean, seconds)
    for name, moving in (("without", "off"), ("with", "auto")):
        model, seconds, plan = train(
            made, dataclasses.replace(config, moving=moving), out / name)
        show(name, model, seconds)
        for decision in plan.needs:
            workbench.click.echo(f"{decision.name}: {decision.reason}")


if __name__ == "__main__":
    main()
