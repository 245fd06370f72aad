"""Good and broken models made from a good one, self-consistent as a mapper would leave them.

A part of the cameras is moved; then points are triangulated from the matches with those poses, and
everything is adjusted, so that what the matches still allow is mended and the rest looks sound.
"""

from __future__ import annotations

import dataclasses
import json
import shutil
import sqlite3
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recon_cli.sfm import database
from recon_cli.sfm.job import MappingJob
from recon_cli.sfm.mapping import mapper
from recon_cli.sfm.mapping.merge_models import build_posed_model

REACH = 10  # neighbours that are matched where not all pairs are
OVERLAP = 40  # points that two images share at least where a skeleton would match them

Poses = dict[str, pycolmap.Rigid3d]  # world to camera by name, in the order of the capture


@dataclasses.dataclass(frozen=True)
class Variant:
    """A model made from a good one.

    Attributes:
        name: what was done.
        change: returns the new poses of those cameras that stay; random draws come from a seed.
        thin: match only neighbours and images that see the same.
    """

    name: str
    change: Callable[[Poses], Poses]
    thin: bool = False


def ordered_poses(job: MappingJob, model: pycolmap.Reconstruction) -> Poses:
    """The cameras of a model in the order of the capture."""
    poses = {model.image(i).name: model.image(i).cam_from_world() for i in model.reg_image_ids()}
    return dict(sorted(poses.items(), key=lambda item: (job.times.get(item[0], 0.0), item[0])))


def _centers(poses: Poses) -> NDArray[np.float64]:
    return np.array([pose.inverse().translation for pose in poses.values()])


def extent(poses: Poses) -> float:
    """Diagonal of the box of the centres."""
    return float(np.linalg.norm(np.ptp(_centers(poses), axis=0)))


def _move(
    poses: Poses, names: Sequence[str], *, degrees: float = 0.0, shift: float = 0.0,
    scale: float = 1.0
) -> Poses:
    """Turns, shifts (in extents) and scales some cameras about the first of them."""
    pivot = poses[names[0]].inverse()
    up = pivot.rotation.matrix()[:, 1]
    turn = Rotation.from_rotvec(np.radians(degrees) * up).as_matrix()
    aside = (pivot.rotation.matrix() @ np.array([0.8, 0.0, 0.6])) * shift * extent(poses)
    offset = pivot.translation - scale * turn @ pivot.translation + aside
    motion = pycolmap.Sim3d(scale, pycolmap.Rotation3d(turn), offset)
    return {name: motion.transform_camera_world(pose) if name in set(names) else pose
            for name, pose in poses.items()}


def _half(poses: Poses) -> list[str]:
    names = list(poses)
    return names[len(names) // 2:]


def _stretch(poses: Poses, start: float, end: float) -> list[str]:
    names = list(poses)
    return names[int(start * len(names)):int(end * len(names))]


def _noise(poses: Poses) -> Poses:
    draws, size = np.random.default_rng(0), extent(poses)
    turns = Rotation.from_rotvec(np.radians(4) * draws.normal(size=(len(poses), 3))).as_matrix()
    return {
        name: pycolmap.Rigid3d(
            pycolmap.Rotation3d(turn @ pose.rotation.matrix()),
            turn @ pose.translation + 0.05 * size * draws.normal(size=3))
        for (name, pose), turn in zip(poses.items(), turns, strict=True)}


def _relabel(poses: Poses, first: Sequence[str], second: Sequence[str]) -> Poses:
    """The images `first` and `second` exchange their poses."""
    pairs = list(zip(first, second, strict=False))
    return {**poses, **{one: poses[two] for one, two in pairs},
            **{two: poses[one] for one, two in pairs}}


def _lay_over(poses: Poses, names: Sequence[str], target: str) -> Poses:
    """Moves cameras rigidly so that the first of them stands where `target` does."""
    motion = poses[target].inverse() * poses[names[0]]  # new world from old world
    return {name: pose * motion.inverse() if name in set(names) else pose
            for name, pose in poses.items()}


def _shorten(poses: Poses) -> Poses:
    """The capture without a stretch, what follows laid to what comes before."""
    head, tail = _stretch(poses, 0, 0.4), _stretch(poses, 0.6, 1)
    laid = _lay_over(poses, tail, head[-1])
    return {name: laid[name] for name in [*head, *tail]}


def _every(poses: Poses, step: int) -> Poses:
    return {name: poses[name] for name in list(poses)[::step]}


BROKEN = (
    Variant("half turned 5", lambda poses: _move(poses, _half(poses), degrees=5)),
    Variant("half turned 15", lambda poses: _move(poses, _half(poses), degrees=15)),
    Variant("half turned 40", lambda poses: _move(poses, _half(poses), degrees=40)),
    Variant("half moved 8%", lambda poses: _move(poses, _half(poses), shift=0.08)),
    Variant("half moved 15%", lambda poses: _move(poses, _half(poses), shift=0.15)),
    Variant("half moved 30%", lambda poses: _move(poses, _half(poses), shift=0.30)),
    Variant("half scaled 1.3", lambda poses: _move(poses, _half(poses), scale=1.3)),
    Variant("half scaled 2", lambda poses: _move(poses, _half(poses), scale=2.0)),
    Variant("middle turned 30", lambda poses: _move(
        poses, _stretch(poses, 0.4, 0.6), degrees=30)),
    Variant("stretches swapped", lambda poses: _relabel(
        poses, _stretch(poses, 0.2, 0.35), _stretch(poses, 0.6, 0.75))),
    Variant("stretch reversed", lambda poses: _relabel(
        poses, _stretch(poses, 0.3, 0.4), _stretch(poses, 0.4, 0.5)[::-1])),
    Variant("second lap laid over", lambda poses: _lay_over(
        poses, _half(poses), next(iter(poses)))),
    Variant("stretch laid over", lambda poses: _lay_over(
        poses, _stretch(poses, 0.65, 0.8), _stretch(poses, 0.15, 0.3)[0])),
    Variant("shortened", _shorten),
    Variant("noise on poses", _noise),
    Variant("half scaled 1.3, thin", lambda poses: _move(poses, _half(poses), scale=1.3),
            thin=True),
    Variant("half turned 15, thin", lambda poses: _move(poses, _half(poses), degrees=15),
            thin=True),
)
GOOD = (
    Variant("every 2nd", lambda poses: _every(poses, 2)),
    Variant("first half", lambda poses: {n: poses[n] for n in _stretch(poses, 0, 0.5)}),
    Variant("thin pairs", lambda poses: poses, thin=True),
)


def make(
    job: MappingJob, base: pycolmap.Reconstruction, variant: Variant, folder: Path
) -> pycolmap.Reconstruction | None:
    """Writes the model of a variant into the folder, or reads it; None if nothing is left of it."""
    done = folder / "done.json"
    if not done.exists():
        folder.mkdir(parents=True, exist_ok=True)
        own = dataclasses.replace(job, out=folder)
        own.attempts.mkdir(exist_ok=True)
        poses = ordered_poses(job, base)
        if variant.thin:
            shutil.copyfile(job.database, own.database)
            _thin(own.database, list(poses), base)
        else:
            own.database.unlink(missing_ok=True)
            own.database.symlink_to(job.database)
        changed = variant.change(poses)
        model = mapper.triangulate(own, build_posed_model(own.database, base, changed))
        if model.num_points3D():
            mapper.adjust(model)
            model.write(folder)
        done.write_text(json.dumps(sorted(changed)), encoding="utf-8")
        shutil.rmtree(own.attempts)
    if not (folder / "images.bin").exists():
        return None
    return pycolmap.Reconstruction(folder)


def _thin(path: Path, order: Sequence[str], base: pycolmap.Reconstruction) -> None:
    """Keeps of the pairs in a database the neighbours and those that see the same points."""
    seen = {
        image.name: {point.point3D_id for point in image.points2D if point.has_point3D()}
        for image in (base.image(i) for i in base.reg_image_ids())}
    place = {name: index for index, name in enumerate(order)}
    drop = []
    for first, second in database.pair_names(path):
        near = first in place and second in place and abs(place[first] - place[second]) <= REACH
        both = len(seen.get(first, set()) & seen.get(second, set()))
        if not near and both < OVERLAP:
            drop.append((first, second))
    with closing(sqlite3.connect(path)) as connection, connection:
        ids = dict(connection.execute("SELECT name, image_id FROM images"))
        for first, second in drop:
            low, high = sorted((ids[first], ids[second]))
            number = low * (2**31 - 1) + high
            for table in ("matches", "two_view_geometries"):
                connection.execute(f"DELETE FROM {table} WHERE pair_id = ?", (number,))
