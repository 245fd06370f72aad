"""Which pairs of photos learned features bridge, and which of these bridges are false.

    python tests/bench/bench_bridges.py DATA [NAMES] [--photos N]

Of each capture some photos are taken, evenly; every pair of which SIFT gives fewer matches than a
bridge is asked for is tried, with the focal length guessed as a mapper does at first. A bridge is
false where less than half of its matches lie within 6 pixels (of an image of 1,024) of the epipolar
line by the reference cameras. `doors` is made here: a corridor with two equal doors, and photos
before either, none of which shows both. No two photos of different doors see the same thing, so
that any pair across is false; mapped with and without bridges, a trusted model must not hold both.

`recon setup bridge` comes first.
"""

from __future__ import annotations

import itertools
import json
import os
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import click
import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from verdict_captures import quiet
from workbench import FOLDER, print_head, print_row

from recon_cli.errors import ReconError
from recon_cli.sfm.features import bridge, features, matching, xfeat_weights
from recon_cli.sfm.features.xfeat import Network
from recon_cli.sfm.job import CameraGroup, MappingJob
from recon_cli.sfm.limits import FEW_PAIR_MATCHES
from recon_cli.sfm.mapping import worker

NEAR_PX, MIN_TRUE = 6.0, 0.5  # of a match by the reference, and the share that a true pair has
Array = NDArray[np.float64]


@dataclass(frozen=True)
class View:
    """A photo with its reference camera."""

    image: NDArray[np.uint8]  # [H, W, 3] RGB
    world_to_camera: Array  # [4, 4]
    camera: pycolmap.Camera
    place: int = 0  # photos of different places see nothing in common


def read_model(sparse: str, images: str) -> Callable[[Path, int], dict[str, View]]:
    """Photos with the cameras of a COLMAP model."""
    def read(data: Path, count: int) -> dict[str, View]:
        model = pycolmap.Reconstruction(data / sparse)
        every = sorted((model.image(i) for i in model.reg_image_ids()), key=lambda i: i.name)
        chosen = [every[k] for k in pick(len(every), count)]
        return {f"{Path(image.name).stem}.png": View(
            load(data / images / image.name), square(image.cam_from_world().matrix()),
            image.camera) for image in chosen}
    return read


def room(name: str) -> Callable[[Path, int], dict[str, View]]:
    """A rendered room."""
    def read(data: Path, count: int) -> dict[str, View]:
        folder = data / "rooms" / name
        files = sorted((folder / "results").glob("frame*.jpg"))
        poses = np.loadtxt(folder / "traj.txt").reshape(-1, 4, 4)
        # the middle of the first pixel is (0, 0) there
        camera = pycolmap.Camera(
            model="PINHOLE", width=600, height=340, params=[300, 300, 300, 170])
        return {files[index].stem + ".png": View(
            load(files[index]), np.linalg.inv(poses[index]), camera)
            for index in pick(len(files), count)}
    return read


def trident(data: Path, count: int) -> dict[str, View]:
    """The can whose label repeats front and back."""
    folder = data / "walks" / "trident_desk"
    found = json.loads((folder / "transforms_train.json").read_text(encoding="utf-8"))
    lens = [found[key] for key in ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2")]
    camera = pycolmap.Camera(model="OPENCV", width=720, height=1280, params=lens)
    poses = {int(Path(frame["file_path"]).stem) - 1: np.array(frame["transform_matrix"])
             for frame in found["frames"]}
    return {f"{index:06d}.png": View(image, np.linalg.inv(
        poses[index] @ np.diag([1, -1, -1, 1])), camera)
        for index, image in film(folder / "video.mp4", [
            sorted(poses)[place] for place in pick(len(poses), count)])}


def hololens(data: Path, count: int) -> dict[str, View]:
    """A lounge, a kitchen and a corridor."""
    folder = data / "walks" / "hololens_walk"
    matrix = np.loadtxt(folder / "K.txt")
    camera = pycolmap.Camera(model="PINHOLE", width=540, height=360, params=[
        matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])
    poses = np.loadtxt(folder / "poses.txt").reshape(-1, 4, 4)
    return {f"{index:06d}.png": View(image, np.linalg.inv(poses[index]), camera)
            for index, image in film(folder / "video.mp4", pick(len(poses), count))}


def film(video: Path, wanted: Sequence[int]) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Frames of a video by their places, in RGB."""
    stream = cv2.VideoCapture(str(video))
    for index in range(max(wanted) + 1):
        found = stream.read()[1]
        if index in wanted:
            yield index, np.asarray(cv2.cvtColor(found, cv2.COLOR_BGR2RGB), np.uint8)


def doors(_: Path, count: int) -> dict[str, View]:
    """Photos before each of two equal doors in one wall of a corridor."""
    generator, views = np.random.default_rng(0), {}
    walls = make_corridor(generator)
    camera = pycolmap.Camera(model="PINHOLE", width=800, height=600, params=[500, 500, 400, 300])
    for place, x in enumerate(DOORS):
        for index in range(max(4, count // 4)):
            along = np.linspace(-2.2, 2.2, max(4, count // 4))[index]
            center = np.array([x + along + generator.normal(0, 0.1), generator.normal(1.5, 0.15),
                               generator.uniform(0.2, 1.2)])
            turn = Rotation.from_euler("yxz", [
                -np.arctan2(along, center[2] + HALF) + generator.normal(0, 0.08),
                generator.normal(0, 0.05), generator.normal(0, 0.03)]).as_matrix()
            pose = np.eye(4)
            pose[:3, :3] = np.diag([1, -1, -1]) @ turn  # looks along -z at the wall, y down
            pose[:3, 3] = center
            image = draw(walls, pose, camera) + generator.normal(0, 2, (600, 800, 3))
            views[f"{place}{index:05d}.png"] = View(
                np.clip(image, 0, 255).astype(np.uint8), np.linalg.inv(pose), camera, place)
    return views


# The corridor, metres: x along it, y up, its walls at -z and z; the middles of the doors in x.
LENGTH, TALL, HALF, PIXELS, DOORS = 14.0, 2.6, 1.4, 150, (3.0, 11.0)


# A rectangle: the axis that it is normal to, where on it, its corner and size, its texture.
Surface = tuple[int, float, tuple[float, float], tuple[float, float], NDArray[np.uint8]]


def make_corridor(generator: np.random.Generator) -> list[Surface]:
    """The walls, floor and ceiling: grain, some things on them, the doors, and boards before them.
    """
    def grained(height: float, level: float) -> NDArray[np.float64]:
        shape = int(height * PIXELS), int(LENGTH * PIXELS)
        coarse = cv2.resize(generator.normal(0, 4, (shape[0] // 30, shape[1] // 30)), shape[::-1])
        return np.repeat((level + coarse + generator.normal(0, 3, shape))[:, :, None], 3, axis=2)

    def clutter(surface: NDArray[np.float64], count: int, middle: float, low: int) -> None:
        for _ in range(count):
            x, y = generator.normal(middle, 1.3) * PIXELS, generator.integers(low, len(surface))
            w, h = generator.integers(6, 40, 2)
            cv2.rectangle(surface, (int(x), int(y)), (int(x + w), int(y + h)),
                          generator.integers(20, 230, 3).tolist(), -1)

    def board(size: tuple[float, float]) -> NDArray[np.uint8]:
        image = np.full((int(size[1] * PIXELS), int(size[0] * PIXELS), 3), 120.0)
        image += generator.normal(0, 4, image.shape)
        for _ in range(12):
            x, y = (int(generator.integers(0, side)) for side in image.shape[1::-1])
            colour = generator.integers(0, 256, 3).tolist()
            cv2.rectangle(image, (x, y), (x + 12, y + 8), colour, -1)
        return np.clip(image, 0, 255).astype(np.uint8)

    found = {"front": grained(TALL, 190), "back": grained(TALL, 180),
             "floor": grained(2 * HALF, 110), "ceiling": grained(2 * HALF, 220)}
    door = make_door(np.random.default_rng(7))
    for middle in DOORS:
        clutter(found["front"], 40, middle, 0)  # of each place its own
        clutter(found["floor"], 60, middle, 0)
        x, y = int((middle - 0.5) * PIXELS), len(found["front"]) - len(door)
        found["front"][y:, x:x + door.shape[1]] = door
    for wall in ("left", "between", "right"):  # so that no photo shows both places
        found[wall] = grained(TALL, 170)
    planes = {"front": (2, -HALF), "back": (2, HALF), "floor": (1, 0.0), "ceiling": (1, TALL),
              "left": (0, 0.0), "between": (0, LENGTH / 2), "right": (0, LENGTH)}
    surfaces: list[Surface] = [
        (*planes[name], (0.0, 0.0), (LENGTH, 2 * HALF if planes[name][0] == 1 else TALL),
         np.clip(texture, 0, 255).astype(np.uint8)) for name, texture in found.items()]
    for middle, side in itertools.product(DOORS, (-1, 1)):
        for _ in range(3):
            size = (float(generator.uniform(0.25, 0.5)), float(generator.uniform(0.3, 0.8)))
            corner = (middle + side * float(generator.uniform(0.9, 1.9)) - size[0] / 2,
                      float(generator.uniform(0.4, TALL - 1.0)))
            surfaces.append((2, -HALF + float(generator.uniform(0.2, 0.7)), corner, size,
                             board(size)))
    return surfaces


def make_door(generator: np.random.Generator) -> NDArray[np.float64]:
    """A door of one by 2.1 metres with panels, a handle, a notice and some grain."""
    shape = int(2.1 * PIXELS), PIXELS
    door = np.repeat((130 + cv2.resize(generator.normal(0, 8, (40, 4)), shape[::-1])
                      + generator.normal(0, 5, shape))[:, :, None], 3, axis=2) * [0.7, 0.85, 1.1]
    for top, bottom in ((15, 130), (160, 300)):
        cv2.rectangle(door, (18, top), (shape[1] - 18, bottom), (60, 70, 80), 3)
    for _ in range(14):
        x, y = generator.integers([20, 20], [shape[1] - 30, 120])
        cv2.rectangle(door, (int(x), int(y)), (int(x) + 12, int(y) + 5),
                      generator.integers(0, 256, 3).tolist(), -1)
    cv2.circle(door, (shape[1] - 14, 165), 6, (220, 220, 60), -1)
    return door


def draw(
    surfaces: Sequence[Surface], pose: Array, camera: pycolmap.Camera
) -> NDArray[np.float64]:
    """A photo of the corridor by rays, four a pixel."""
    fx, fy, cx, cy = camera.params
    y, x = np.mgrid[0:2 * camera.height, 0:2 * camera.width] / 2 + 0.25
    rays = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)], axis=2) @ pose[:3, :3].T
    image, nearest = np.zeros((*x.shape, 3)), np.full(x.shape, np.inf)
    for axis, at, corner, size, texture in surfaces:
        with np.errstate(divide="ignore", invalid="ignore"):
            far = np.nan_to_num((at - pose[axis, 3]) / rays[:, :, axis])
        spot = pose[:3, 3] + far[:, :, None] * rays
        right = spot[:, :, 2] + HALF if axis == 0 else spot[:, :, 0] - corner[0]
        down = spot[:, :, 2] + HALF if axis == 1 else TALL - spot[:, :, 1] - corner[1]
        seen = cv2.remap(texture, (right * PIXELS).astype(np.float32),
                         (down * PIXELS).astype(np.float32), cv2.INTER_LINEAR)
        hit = (far > 0) & (far < nearest) & (right > 0) & (right < size[0]) & (
            down > 0) & (down < size[1])
        image[hit], nearest[hit] = seen[hit], far[hit]
    return cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)


CAPTURES: dict[str, Callable[[Path, int], dict[str, View]]] = {
    "doors": doors,
    "lockers": read_model("walks/club_room_lockers/sparse/0", "walks/club_room_lockers/images"),
    "can": trident,
    "kitchen walk": hololens,
    "desk": read_model("desk_monitors/sparse_text", "desk_monitors/images"),
    "office": room("office"),
    "living": room("living"),
}


def pick(count: int, wanted: int) -> list[int]:
    """Places spread evenly over all."""
    return sorted(set(np.linspace(0, count - 1, wanted).astype(int).tolist()))


def load(path: Path) -> NDArray[np.uint8]:
    """A picture in RGB."""
    return np.asarray(cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB), np.uint8)


def square(matrix: Array) -> Array:
    """[3, 4] with the last row."""
    return np.vstack([matrix, [0, 0, 0, 1]])


def true_share(first: View, second: View, ours: Array, theirs: Array) -> float:
    """Share of matches [M, 2] that lie near the epipolar lines of the reference cameras."""
    if first.place != second.place:
        return 0.0
    motion = second.world_to_camera @ np.linalg.inv(first.world_to_camera)
    x, y, z = motion[:3, 3]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ motion[:3, :3]
    sides = []
    for view, xy in ((first, ours), (second, theirs)):
        factor = view.camera.width / view.image.shape[1]  # of a reference of larger photos
        sides.append(np.asarray(view.camera.cam_from_img(xy * factor)))
    off = bridge.epipolar_distances(essential, *sides) * first.camera.mean_focal_length()
    return float((off * 1024 / max(first.camera.width, first.camera.height) < NEAR_PX).mean())


def write_job(views: Mapping[str, View], folder: Path) -> MappingJob:
    """Photos as a capture, without features."""
    sizes: dict[tuple[int, int], list[str]] = {}
    (folder / "frames").mkdir()
    for name, view in views.items():
        cv2.imwrite(str(folder / "frames" / name), cv2.cvtColor(view.image, cv2.COLOR_RGB2BGR))
        sizes.setdefault((view.image.shape[1], view.image.shape[0]), []).append(name)
    return MappingJob(
        frames=folder / "frames", out=folder, groups=tuple(
            CameraGroup(tuple(sorted(names)), *size) for size, names in sorted(sizes.items())),
        masks=None, poses=None, pose_use="ignore", given_points=False, pairs="auto",
        max_features=3000, min_registered=0.1, accept_weak=False, partial=True,
        max_minutes=60, seed=0, threads=1, sharpness={}, times={})


def count_bridges(views: Mapping[str, View], folder: Path) -> list[str]:
    """The cells of a capture's row."""
    start, job = time.process_time(), write_job(views, folder)
    matching.create_database(job)
    features.extract_features(job, quiet())
    matching.match_pairs(job, matching.exhaustive_pairs(job.names), quiet())
    verified = matching.read_verified(job.database)
    weak = [pair for pair in itertools.combinations(sorted(views), 2) if (
        pair not in verified or len(verified[pair].inlier_matches) < FEW_PAIR_MATCHES)]
    by_sift = [(verified[pair].inlier_matches, pair) for pair in weak if pair in verified]
    weights = xfeat_weights.load_weights()
    assert weights is not None, "type `recon setup bridge` first"
    photos = bridge._read_photos(job, Network(weights), sorted(views))
    xy = {name: np.concatenate([photo.xy, photo.learned.xy]) for name, photo in photos.items()}
    made = [(geometry.inlier_matches, pair) for pair, geometry in bridge._find_bridges(
        job, photos, weak, verified) if geometry is not None]
    false = [sum(true_share(*(views[name] for name in pair), *(
        xy[name][rows[:, side]] for side, name in enumerate(pair))) < MIN_TRUE
        for rows, pair in found) for found in (by_sift, made)]
    new = [pair for _, pair in made if pair not in verified]
    return [str(len(views)), str(len(weak)), f"{len(by_sift)} ({false[0]})",
            f"{len(made)} ({false[1]})", str(len(new)), f"{time.process_time() - start:.0f}"]


def map_places(views: Mapping[str, View], with_bridges: bool) -> str:
    """What a mapping of photos of two places comes to."""
    with tempfile.TemporaryDirectory() as name, mock.patch.object(
            xfeat_weights, "are_installed", return_value=with_bridges):
        job = write_job(views, Path(name))
        try:
            worker.work(job, quiet())
        except ReconError as error:
            return f"refused: {error.message[:90]}"
        parts = [pycolmap.Reconstruction(path) for path in sorted(job.parts.iterdir())]
        held = [sorted(part.image(i).name for i in part.reg_image_ids()) for part in parts]
        mixed = sum(len({views[name].place for name in names}) > 1 for names in held)
        return f"parts of {[len(names) for names in held]}; of both places: {mixed}"


@click.command(help=__doc__)
@click.argument("data", type=FOLDER)
@click.argument("names", nargs=-1)
@click.option("--photos", default=24, help="Of each capture.")
def main(data: Path, names: tuple[str, ...], photos: int) -> None:
    """Prints the table."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    pycolmap.logging.minloglevel = 2
    print_head("capture", "photos", "weak pairs", "of SIFT (false)", "bridged (false)",
               "SIFT has none", "CPU s")
    for name in names or CAPTURES:
        views = CAPTURES[name](data, photos)
        with tempfile.TemporaryDirectory() as folder:
            print_row(name, *count_bridges(views, Path(folder)))
        if name == "doors":
            for with_bridges in (False, True):
                click.echo(f"doors, mapped {'with' if with_bridges else 'without'} bridges: "
                           f"{map_places(views, with_bridges)}")


if __name__ == "__main__":
    main()
