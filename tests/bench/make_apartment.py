"""A walk through an apartment: `python tests/bench/make_apartment.py LIVING OFFICE OUT [--help]`.

LIVING and OFFICE are workspaces with trained Gaussians of two rooms in metres, with z up and a
corner of the floor at the origin. The third room is the first one mirrored, in other colours. They
open on a straight corridor.

Written are a video, and a Replica sequence of the same frames with exact poses and views off the
path. The walk goes through all rooms and then through them again, lower and looking elsewhere;
--frames says how much of it is filmed.
"""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import dataclass
from pathlib import Path

import click
import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter, gaussian_filter1d
from scipy.spatial.transform import Rotation, Slerp

from recon_cli.flythrough.output import VideoEncoding, encode_video
from recon_cli.io.colmap import read_images
from recon_cli.progress import TqdmProgress
from recon_cli.render import render
from recon_cli.scene.camera import Camera
from recon_cli.scene.similarity import Similarity
from recon_cli.scene.splats import SH_C0, Splats, joined, quaternion, transformed
from recon_cli.splats.ply import read_ply, write_ply

Array = NDArray[np.float64]

HEIGHT = 2.6  # of the corridor and its doors, metres
WIDTH, DOOR_WIDTH, DOOR_HEIGHT = 1.8, 1.0, 2.1
WALL = 0.3  # from a room's inner face to the corridor's
SPACING = 0.012  # of the Gaussians on a wall
EYE, LOWER = 1.45, 0.3  # height of the eyes, and how much lower the second time
STEP = 0.15  # metres a frame; a radian counts as a metre
SHAKE_M, SHAKE_DEG = 0.01, 0.8  # of the hand
FPS = 10.0
TESTS, OFF_M, OFF_DEG = 40, 0.15, 12.0  # views off the path
DEPTH_EVERY, DEPTH_SCALE = 5, 6553.5
NOISE, QUALITY = 2.0, 92  # 1/255, as a phone's frames by daylight; of JPEG


@dataclass
class Room:
    """A room in the apartment's frame; its door is in the wall that faces the corridor."""

    splats: Splats
    size: Array  # [3] of its box
    path: list[Array]  # [4, 4] camera to world
    door: float  # along the wall of the door, from the box's corner


def load(workspace: Path, size: tuple[float, float, float], *, mirrored: bool) -> Room:
    """Returns a room of a workspace, in its own frame and without a door."""
    splats = read_ply(workspace / "train" / "splats.ply").with_degree(0)
    images = read_images(workspace / "place" / "undistorted" / "sparse" / "images.bin")
    path = [np.linalg.inv(viewmat) for name, _, viewmat in sorted(images, key=lambda i: i[0])
            if name.startswith("frame")]
    box = torch.tensor(size)
    inside = ((splats.means > -WALL + 0.05) & (splats.means < box + WALL - 0.05)).all(dim=1)
    splats = splats.select(inside)
    if mirrored:
        flip = torch.tensor([-1.0, 1, 1])
        splats = Splats(
            splats.means * flip + torch.tensor([size[0], 0, 0]),
            splats.quats * torch.tensor([1.0, 1, -1, -1]), splats.log_scales,
            splats.logit_opacities, splats.sh_dc[:, [1, 2, 0]].clone(), splats.sh_rest)
        mirror = np.diag([-1.0, 1, 1, 1])
        path = [mirror @ pose @ mirror for pose in path]  # the pictures are mirrored, too
        for pose in path:
            pose[0, 3] += size[0]
    return Room(splats, np.array(size), path, 0.0)


def turned(room: Room, quarters: int) -> Room:
    """Returns a room turned about z, its box again at the origin."""
    rotation = np.round(Rotation.from_euler("z", 90 * quarters, degrees=True).as_matrix())
    corner = np.minimum(rotation @ room.size, 0)
    return moved(room, Similarity(1.0, rotation, -corner), np.abs(rotation @ room.size))


def moved(room: Room, motion: Similarity, size: Array | None = None) -> Room:
    """Returns a room after a motion of the world."""
    return Room(transformed(room.splats, motion), room.size if size is None else size,
                [motion.matrix @ pose for pose in room.path], room.door)


def with_door(room: Room) -> Room:
    """Returns a room turned so that the way from its path to the wall y = 0 is freest, and open."""
    best: tuple[float, float, Room] | None = None
    for quarters in range(4):
        side = turned(room, quarters)
        means = side.splats.means.numpy()
        solid = side.splats.opacities.numpy() * side.splats.scales.numpy().max(axis=1) ** 2
        spots = np.array([pose[:3, 3] for pose in side.path])
        for spot in spots[spots[:, 1] < side.size[1] / 2]:
            if not DOOR_WIDTH < spot[0] < side.size[0] - DOOR_WIDTH:
                continue
            way = ((np.abs(means[:, 0] - spot[0]) < 0.4) & (means[:, 1] > 0.1)
                   & (means[:, 1] < spot[1]) & (means[:, 2] > 0.3) & (means[:, 2] < 1.9))
            blocked = float(solid[way].sum())
            if best is None or blocked < best[0]:
                best = blocked, float(spot[0]), side
    assert best is not None
    _, door, side = best
    means = side.splats.means
    hole = ((means[:, 0] - door).abs() < DOOR_WIDTH / 2) & (means[:, 1] < 0.1) & (
        means[:, 2] < DOOR_HEIGHT)
    return Room(side.splats.select(~hole), side.size, side.path, door)


# Surfaces of the corridor: rectangles of Gaussians with a painted texture.


def painting(height: int, width: int, draws: np.random.Generator) -> Array:
    """Returns a picture [H, W, 3] of overlapping shapes."""
    image = np.full((height, width, 3), draws.uniform(0.2, 0.9, 3))
    for _ in range(60):
        corners = (draws.uniform(0, 1, (1, 2)) + draws.normal(0, 0.15, (5, 2))) * [width, height]
        cv2.fillPoly(image, [corners.astype(np.int32)], draws.uniform(0, 1, 3).tolist(),
                     lineType=cv2.LINE_AA)
    return image


def plaster(height: int, width: int, draws: np.random.Generator) -> Array:
    """Returns a wall [H, W, 3] with blotches, and pictures and notes on it."""
    blotches = sum(level * gaussian_filter(draws.normal(size=(height, width)), sigma) * sigma
                   for level, sigma in ((0.06, 2), (0.05, 8), (0.05, 30)))
    image = draws.uniform(0.6, 0.85, 3) + np.asarray(blotches)[..., None]
    place = 0
    while place < width:
        wide, tall = (int(draws.uniform(0.25, 0.9) / SPACING) for _ in range(2))
        x, y = place + int(draws.uniform(0.1, 0.7) / SPACING), int(draws.uniform(
            0.6, 1.2) / SPACING)
        if x + wide >= width or y + tall >= height:
            break
        image[y:y + tall, x:x + wide] = painting(tall, wide, draws)
        place = x + wide
    image[:int(0.1 / SPACING)] = draws.uniform(0.2, 0.5, 3)  # skirting board
    return image


def boards(height: int, width: int, draws: np.random.Generator) -> Array:
    """Returns a floor [H, W, 3] of boards with grain."""
    grain = gaussian_filter(draws.normal(size=(height, width)), (1, 14)) * 4
    image = np.array([0.55, 0.38, 0.24]) * (1 + 0.12 * grain[..., None])
    wide, long = int(0.14 / SPACING), int(0.9 / SPACING)
    for row in range(0, height, wide):
        start = int(draws.integers(0, long))
        for column in range(-start, width, long):
            part = image[row:row + wide, max(0, column):max(0, column + long)]
            part *= draws.uniform(0.75, 1.25)
            part[:1] *= 0.5
            part[:, :1] *= 0.5
    return image


def ceiling(height: int, width: int, draws: np.random.Generator) -> Array:
    """Returns a pale ceiling [H, W, 3]."""
    rough = gaussian_filter(draws.normal(size=(height, width)), 3) * 3
    return np.array([0.88, 0.88, 0.85]) * (1 + 0.02 * rough[..., None])


def sheet(origin: Array, along: Array, up: Array, texture: Array) -> Splats:
    """Returns a rectangle of flat Gaussians, one for each pixel of a texture [H, W, 3]."""
    height, width = texture.shape[:2]
    u, v = along / np.linalg.norm(along), up / np.linalg.norm(up)
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    means = origin + SPACING * (x[..., None] * u + y[..., None] * v)
    rotation = np.stack([u, v, np.cross(u, v)], axis=1)
    count = height * width
    scales = np.log([0.65 * SPACING, 0.65 * SPACING, 0.001])
    as_tensor = torch.from_numpy
    return Splats(
        as_tensor(means.reshape(-1, 3).astype(np.float32)),
        as_tensor(np.tile(quaternion(rotation), (count, 1)).astype(np.float32)),
        as_tensor(np.tile(scales, (count, 1)).astype(np.float32)),
        torch.full((count,), 5.0),
        as_tensor(((texture.clip(0, 1) - 0.5) / SH_C0).reshape(-1, 3).astype(np.float32)),
        torch.zeros(count, 0, 3))


def patch(origin: Array, along: Array, up: Array, paint, draws: np.random.Generator) -> Splats:  # type: ignore[no-untyped-def]
    """Returns a painted rectangle between a corner and two edges."""
    shape = [max(1, round(float(np.linalg.norm(edge)) / SPACING)) for edge in (up, along)]
    return sheet(origin, along, up, paint(*shape, draws))


def wall(start: Array, end: Array, draws: np.random.Generator, doors: list[float]) -> Splats:
    """Returns a wall of the corridor between two points of its floor, with holes for doors."""
    part = patch(start, end - start, np.array([0, 0, HEIGHT]), plaster, draws)
    unit = (end - start) / np.linalg.norm(end - start)
    along = (part.means.numpy() - start) @ unit
    hole = np.zeros(len(part), bool)
    for door in doors:
        hole |= (np.abs(along - door) < DOOR_WIDTH / 2) & (part.means.numpy()[:, 2] < DOOR_HEIGHT)
    return part.select(torch.from_numpy(~hole))


def frame_of_door(origin: Array, along: Array, inward: Array, draws: np.random.Generator) -> Splats:
    """Returns the jambs, the lintel and the sill of a door; `origin` is the middle of its floor."""
    left, deep = origin - along * DOOR_WIDTH / 2, inward * WALL
    up = np.array([0, 0, DOOR_HEIGHT])
    right, top = left + along * DOOR_WIDTH, left + up
    across = along * DOOR_WIDTH
    return joined([
        patch(left, deep, up, painting, draws), patch(right, deep, up, painting, draws),
        patch(top, across, deep, painting, draws), patch(left, across, deep, boards, draws)])[0]


def backdrop(room: Room, draws: np.random.Generator) -> Splats:
    """Returns what is seen through the windows of a room: a pale box around it, but at the door."""
    w, d, h = room.size
    lo, margin = np.array([-WALL, 0.0, -0.1]), WALL - 0.02
    x, y, z = np.eye(3)
    corners = [(lo, y * (d + margin), z * (h + 0.2)),
               (lo + x * (w + 2 * margin), y * (d + margin), z * (h + 0.2)),
               (lo + y * (d + margin), x * (w + 2 * margin), z * (h + 0.2))]
    return joined([patch(*corner, ceiling, draws) for corner in corners])[0]


@dataclass
class Apartment:
    """All Gaussians, and the places that a walk goes through."""

    splats: Splats
    rooms: list[Room]
    doors: list[Array]  # [2, 3] the middle of the door in the corridor's wall, and the way in
    corridor: list[Array]  # [3] corners of the corridor's middle line; the first is the start


def place(room: Room, door: Array, inward: Array) -> Room:
    """Returns a room with its door at a place of the corridor's wall."""
    angle = math.atan2(inward[1], inward[0]) - math.pi / 2
    rotation = np.round(Rotation.from_euler("z", angle).as_matrix())
    at = rotation @ np.array([room.door, -WALL, 0.0])
    return moved(room, Similarity(1.0, rotation, door - at))


def build(living: Room, office: Room, third: Room) -> Apartment:
    """Returns the apartment along a straight corridor."""
    draws = np.random.default_rng(1)
    x, y, z = np.eye(3)
    length = living.size[0] + office.size[0] + 3 * WALL
    across = length / 2
    doors = [(np.array([WALL + living.door, 0, 0]), y),
             (np.array([2 * WALL + living.size[0] + office.door, 0, 0]), y),
             (np.array([across, -WIDTH, 0]), -y)]
    shells = [(np.array([0, -WIDTH, 0]), np.array([length, 0, 0]),
               {0: [across], 2: [length - door[0][0] for door in doors[:2]]})]
    corridor = [np.array([0.5, -WIDTH / 2, 0]), np.array([length - 0.5, -WIDTH / 2, 0])]
    floors = [(np.array([0, -WIDTH, 0]), x * length, y * WIDTH)]
    rooms = [place(room, *door) for room, door in zip((living, office, third), doors, strict=True)]
    parts = [room.splats for room in rooms]
    for room, door in zip((living, office, third), doors, strict=True):
        behind = Room(backdrop(room, draws), room.size, [], room.door)
        parts.append(place(behind, *door).splats)
        parts.append(frame_of_door(
            np.asarray(door[0], float), np.abs(np.cross(door[1], z)), door[1], draws))
    for low, high, holes in shells:
        corners = [low, np.array([high[0], low[1], 0]), high, np.array([low[0], high[1], 0]), low]
        for side, (start, end) in enumerate(itertools.pairwise(corners)):
            parts.append(wall(start.astype(float), end.astype(float), draws, holes.get(side, [])))
    for origin, along, up in floors:
        origin = origin.astype(float)
        parts.append(patch(origin, along, up, boards, draws))
        parts.append(patch(origin + HEIGHT * z, along, up, ceiling, draws))
    splats = joined([Splats(**{name: value.float() for name, value in part.parameters().items()})
                     for part in parts])[0]
    return Apartment(splats, rooms, [np.stack(door) for door in doors], corridor)


# The walk.


def facing(position: Array, direction: Array) -> Array:
    """Returns a level camera [4, 4] at a place that looks in a direction."""
    ahead = direction / np.linalg.norm(direction)
    right = np.cross(ahead, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    pose[:3, 3] = position
    return pose


def along_corridor(apartment: Apartment, start: Array, end: Array) -> list[Array]:
    """Returns cameras on the middle line of the corridor between two places next to it."""
    line = np.array(apartment.corridor)
    lengths = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    dense = np.linspace(0, lengths[-1], 400)
    spots = np.stack([np.interp(dense, lengths, line[:, i]) for i in range(3)], axis=1)
    first, last = (int(np.argmin(np.linalg.norm(spots - place, axis=1))) for place in (start, end))
    step = 1 if last >= first else -1
    way = spots[first:last + step:step][::8]
    if len(way) < 3:
        return []
    ahead = gaussian_filter1d(np.gradient(way, axis=0), 1.5, axis=0)
    up = np.array([0, 0, 1.0])
    return [facing(spot + EYE * up, direction - 0.05 * np.linalg.norm(direction) * up)
            for spot, direction in zip(way, ahead, strict=True)]


def visit(room: Room, door: Array, *, again: bool) -> list[Array]:
    """Returns cameras in through the door, round the room by its own path, and out again."""
    at, inward = door
    eye = np.array([0, 0, EYE])
    outside, inside = at - 0.5 * inward + eye, at + (WALL + 0.5) * inward + eye
    poses = [pose.copy() for pose in room.path]
    nearest = int(np.argmin([np.linalg.norm(pose[:3, 3] - inside) for pose in poses]))
    poses = poses[nearest:] + poses[:nearest]
    if again:
        poses = poses[::-1]
        for index, pose in enumerate(poses):
            pose[2, 3] -= LOWER
            turn = 25 * math.sin(index / 9)
            pose[:3, :3] = Rotation.from_euler("z", turn, degrees=True).as_matrix() @ pose[:3, :3]
    return [facing(outside, inward), facing(inside, inward), *poses[::3],
            facing(inside, -inward), facing(outside, -inward)]


def walk(apartment: Apartment) -> list[Array]:
    """Returns the cameras that a walk passes: each room, and each again."""
    keys: list[Array] = []
    spot = apartment.corridor[0]
    for again in (False, True, True):
        order = [2, 1, 0] if again else [0, 1, 2]
        for index in order:
            door = apartment.doors[index]
            keys += along_corridor(apartment, spot, door[0])
            keys += visit(apartment.rooms[index], door, again=again)
            spot = door[0]
    return keys


def resampled(keys: list[Array], frames: int, draws: np.random.Generator) -> list[Array]:
    """Returns cameras at equal steps along keys, with a shaking hand."""
    places = np.array([key[:3, 3] for key in keys])
    turns = Rotation.from_matrix(np.array([key[:3, :3] for key in keys]))
    angles = (turns[:-1].inv() * turns[1:]).magnitude()
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1) + angles
    keep = np.concatenate([[True], steps > 1e-6])
    way = np.concatenate([[0], np.cumsum(steps)])[keep]
    if way[-1] < STEP * frames:
        raise click.ClickException(f"the walk has {int(way[-1] / STEP)} frames, not {frames}")
    when = STEP * np.arange(frames)
    spots = PchipInterpolator(way, places[keep])(when)
    rotations = Slerp(way, turns[keep])(when)
    spots = gaussian_filter1d(spots, 1.0, axis=0, mode="nearest")
    shake = gaussian_filter1d(draws.normal(size=(frames, 6)), 2.0, axis=0) * 2
    spots = spots + SHAKE_M * shake[:, :3]
    rotations = rotations * Rotation.from_rotvec(np.radians(SHAKE_DEG) * shake[:, 3:])
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotations.as_matrix(), spots
    return list(poses)


def nudged(poses: list[Array], draws: np.random.Generator) -> list[Array]:
    """Returns views off the path, evenly along it."""
    views = []
    for index in np.linspace(5, len(poses) - 6, TESTS).astype(int):
        pose = poses[index].copy()
        pose[:3, 3] += draws.uniform(-OFF_M, OFF_M, 3)
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(
            np.radians(draws.uniform(-OFF_DEG, OFF_DEG, 3))).as_matrix()
        views.append(pose)
    return views


def write_sequence(
    folder: Path, splats: Splats, poses: list[Array], camera: Camera, noise: float,
    draws: np.random.Generator,
) -> list[Path]:
    """Writes a Replica sequence and returns its pictures."""
    results = folder / "results"
    results.mkdir(parents=True, exist_ok=True)
    written = []
    with TqdmProgress().bar(folder.name, len(poses), unit="view") as bar:
        for index, pose in enumerate(poses):
            view = Camera(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy,
                          np.linalg.inv(pose))
            with torch.no_grad():
                output = render(splats, view, torch.zeros(3), 0, backend="numba")
            rgb = output.rgb.clamp(0, 1).numpy()
            seen = np.clip(np.rint(255 * rgb + draws.normal(0, noise, rgb.shape)), 0, 255)
            path = results / f"frame{index:06d}.jpg"
            cv2.imwrite(str(path), seen.astype(np.uint8)[:, :, ::-1],
                        [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
            if index % DEPTH_EVERY == 0:
                depth = (output.depth / output.alpha.clamp(min=1e-6)).numpy() * (
                    output.alpha.numpy() > 0.5)
                cv2.imwrite(str(results / f"depth{index:06d}.png"), np.rint(
                    depth * DEPTH_SCALE).clip(0, 65535).astype(np.uint16))
            written.append(path)
            bar.advance(1)
    (folder / "traj.txt").write_text("".join(
        " ".join(f"{value:.9e}" for value in pose.ravel()) + "\n" for pose in poses))
    return written


@click.command()
@click.argument("living", type=click.Path(exists=True, path_type=Path))
@click.argument("office", type=click.Path(exists=True, path_type=Path))
@click.argument("out", type=click.Path(path_type=Path))
@click.option("--frames", default=300, show_default=True)
@click.option("--width", default=640, show_default=True)
@click.option("--height", default=360, show_default=True)
def main(living: Path, office: Path, out: Path, frames: int, width: int, height: int) -> None:
    """Writes the video and the sequence."""
    rooms = [load(living, (5.4, 4.6, 2.65), mirrored=False),
             load(office, (4.9, 4.2, 2.6), mirrored=False),
             load(living, (5.4, 4.6, 2.65), mirrored=True)]
    apartment = build(*(with_door(room) for room in rooms))
    out.mkdir(parents=True, exist_ok=True)
    write_ply(out / "apartment.ply", apartment.splats)
    click.echo(f"{len(apartment.splats):,} Gaussians")
    draws = np.random.default_rng(0)
    poses = resampled(walk(apartment), frames, draws)
    focal = width / 2
    camera = Camera(width, height, focal, focal, width / 2, height / 2, np.eye(4))
    pictures = write_sequence(out, apartment.splats, poses, camera, NOISE, draws)
    write_sequence(out / "test", apartment.splats, nudged(poses, draws), camera, 0.0, draws)
    (out / "cam_params.json").write_text(json.dumps({"camera": {
        "w": width, "h": height, "fx": focal, "fy": focal, "cx": width / 2 - 0.5,
        "cy": height / 2 - 0.5, "scale": DEPTH_SCALE}}))
    encode_video(pictures, out / "video.mp4", VideoEncoding("h264", 18, width, height, FPS),
                 threads=2, on_frame=lambda: None)


if __name__ == "__main__":
    main()
