"""Databases and models in closed form: pinhole cameras that see points exactly, or go astray."""

from collections import defaultdict
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

WIDTH, HEIGHT, FOCAL = 600, 400, 400.0
STAY = pycolmap.Rigid3d()


def wall(low: float, high: float, *, count: int, seed: int = 0) -> NDArray[np.float64]:
    """Returns points around the plane z = 5, x from low to high, [count, 3]."""
    generator = np.random.default_rng(seed)
    return np.column_stack([
        generator.uniform(low, high, count), generator.uniform(-2.6, 2.6, count),
        generator.uniform(4.8, 5.2, count)])


def along(xs: Sequence[float]) -> list[pycolmap.Rigid3d]:
    """Returns world-to-camera poses at (x, wobble, 0) that look at the wall."""
    return [pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([-x, 0.1 * np.cos(3 * x), 0.0]))
            for x in xs]


def moved(x: float, y: float, z: float, degrees: float = 0.0) -> pycolmap.Rigid3d:
    """Returns a motion of the world: a turn about the vertical, then a shift."""
    half = np.radians(degrees) / 2
    return pycolmap.Rigid3d(
        pycolmap.Rotation3d(np.array([0.0, np.sin(half), 0.0, np.cos(half)])), np.array([x, y, z]))


@dataclass
class MadeModel:
    """What the cameras see in truth, and where the model sets them.

    Attributes:
        points: of the world, [P, 3].
        poses: world to camera, in truth.
        looks: what each point looks like, [P]: points that look the same are matched.
        motions: how the model moves each camera, with what it alone sees, from the truth.
        landmark: which landmark of the model an observation (image, point) belongs to.
        unregistered: images without a camera.
        hidden: points that an image does not see though they are in its view.
        reach: images further apart than this in their order are not matched.
    """

    points: NDArray[np.float64]
    poses: list[pycolmap.Rigid3d]
    looks: NDArray[np.int64] | None = None
    motions: dict[int, pycolmap.Rigid3d] = field(default_factory=dict)
    landmark: Callable[[int, int], Hashable] = lambda _, point: point
    unregistered: frozenset[int] = frozenset()
    hidden: dict[int, NDArray[np.int64]] = field(default_factory=dict)
    reach: int = 10**9
    _views: dict[int, tuple[NDArray[np.int64], NDArray[np.float64]]] = field(default_factory=dict)

    @property
    def names(self) -> list[str]:
        return [f"{index:06d}.png" for index in range(len(self.poses))]

    def write_database(self, path: Path) -> Path:
        """Writes features and matches and returns the path."""
        camera = _camera()
        with pycolmap.Database.open(path) as opened:
            camera.camera_id = opened.write_camera(camera)
            for index, name in enumerate(self.names):
                image = pycolmap.Image(image_id=index + 1, name=name, camera_id=camera.camera_id)
                opened.write_image(image, use_image_id=True)
                opened.write_keypoints(index + 1, self._seen(index)[1].astype(np.float32))
            for first, second in combinations(range(len(self.poses)), 2):
                if second - first <= self.reach:
                    self._write_pair(opened, first, second)
        return path

    def model(self) -> pycolmap.Reconstruction:
        """Returns the model."""
        model = pycolmap.Reconstruction()
        model.add_camera_with_trivial_rig(_camera())
        tracks: dict[Hashable, list[tuple[int, int, int]]] = defaultdict(list)
        for index, name in enumerate(self.names):
            if index in self.unregistered:
                continue
            ids, places = self._seen(index)
            pose = self.poses[index] * self.motions.get(index, STAY).inverse()
            model.add_image_with_trivial_frame(
                pycolmap.Image(
                    image_id=index + 1, name=name, camera_id=1,
                    points2D=[pycolmap.Point2D(place) for place in places]), pose)
            for row, point in enumerate(ids):
                tracks[self.landmark(index, int(point))].append((index, row, int(point)))
        for observations in tracks.values():
            image, _, point = observations[0]
            track = pycolmap.Track()
            for index, row, _ in observations:
                track.add_element(index + 1, row)
            model.add_point3D(self.motions.get(image, STAY) * self.points[point], track)
        return model

    def _seen(self, index: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Returns which points an image sees, and where; projected once for all of its pairs."""
        if index not in self._views:
            self._views[index] = self._project(index)
        return self._views[index]

    def _project(self, index: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        local = self.poses[index] * self.points
        places = FOCAL * local[:, :2] / local[:, 2:] + [WIDTH / 2, HEIGHT / 2]
        inside = (local[:, 2] > 0) & (places >= 0).all(axis=1) & (
            places <= [WIDTH, HEIGHT]).all(axis=1)
        inside[self.hidden.get(index, [])] = False
        return np.flatnonzero(inside), places[inside]

    def _write_pair(self, opened: pycolmap.Database, first: int, second: int) -> None:
        looks = np.arange(len(self.points)) if self.looks is None else self.looks
        _, one, two = np.intersect1d(
            looks[self._seen(first)[0]], looks[self._seen(second)[0]], return_indices=True,
            assume_unique=self.looks is None)
        matches = np.column_stack([one, two]).astype(np.uint32)
        opened.write_matches(first + 1, second + 1, matches)
        if len(matches) < 15:  # as COLMAP's verification would
            matches = matches[:0]
        opened.write_two_view_geometry(first + 1, second + 1, pycolmap.TwoViewGeometry(
            config=pycolmap.TwoViewGeometryConfiguration.CALIBRATED, inlier_matches=matches))


def _camera() -> pycolmap.Camera:
    return pycolmap.Camera(
        camera_id=1, model="PINHOLE", width=WIDTH, height=HEIGHT,
        params=[FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2])


def walk(count: int = 1200, **changes) -> MadeModel:
    """Sixteen cameras half a metre apart along a wall; neighbours see much in common."""
    return MadeModel(wall(-4, 12, count=count), along(np.arange(16) * 0.5), **changes)


def broken_walk(at: int = 8, count: int = 1200) -> MadeModel:
    """The cameras from `at` on are turned and shifted with all that they see but a few points."""
    motion = moved(1, 2, 0, degrees=20)
    return walk(
        count,
        motions=dict.fromkeys(range(at, 16), motion),
        landmark=lambda image, point: point if point < 60 else (image >= at, point))


def doubled_place() -> MadeModel:
    """Two walls 100 m apart that share a poster, laid over each other.

    Nothing else ties the two groups of cameras, so that every match agrees with the model.
    """
    poster, first, second = (wall(-1, 0.6, count=400, seed=1), wall(-4, 4, count=1500, seed=2),
                             wall(-4, 4, count=1500, seed=3))
    away = np.array([100.0, 0, 0])
    points = np.concatenate([poster, first, poster + away, second + away])
    looks = np.arange(len(points))
    looks[1900:2300] = looks[:400]
    xs = np.arange(6) * 0.2 - 0.5
    return MadeModel(
        points, along([*xs, *(xs + 100)]), looks=looks,
        motions={index: moved(-100, 0, 0) for index in range(6, 12)},
        landmark=lambda _, point: int(looks[point]))
