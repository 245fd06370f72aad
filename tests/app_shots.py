"""Frames of a rendered room with exact poses, and what writers of captures share."""

import dataclasses

import cv2
import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

GL = np.diag([1.0, -1.0, -1.0, 1.0])
# From z up to y up; then a heading and an origin of the app's own.
Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
HEADING = np.eye(4)
HEADING[:3, :3] = Rotation.from_rotvec([0, 0.7, 0]).as_matrix()
HEADING[:3, 3] = [0.4, -1.3, 0.25]
ARKIT = HEADING @ Y_UP
STEPS = 5  # the room has depth for every fifth frame
CROP = 6  # columns: what the middle moves by, so that each frame has its own intrinsics


@dataclasses.dataclass(frozen=True, eq=False)
class Shot:
    number: int
    rgb: np.ndarray
    depth: np.ndarray  # metres, of a fraction of the size
    c2w: np.ndarray  # OpenCV, z up, metres
    inner: tuple  # fx fy cx cy for rgb
    time: float

    @property
    def size(self):
        return self.rgb.shape[1], self.rgb.shape[0]


def shots(room, count=6, step=15, factor=2, moving=True):
    """Returns frames of a room in the Replica layout, reduced by a factor."""
    poses = np.loadtxt(room / "traj.txt").reshape(-1, 4, 4)
    found = []
    for index in range(count):
        at = index * step
        rgb = np.asarray(Image.open(room / "results" / f"frame{at:06d}.jpg"))
        z = read_depth(room, at) if at % STEPS == 0 else carry_depth(room, poses, at)
        height, width = rgb.shape[0] // factor, rgb.shape[1] // factor
        rgb = cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA)
        left = index % 3 * CROP // 2 * moving
        rgb = rgb[:, left:width - (CROP - left) * moving if moving else None]
        # Depth of a quarter of the photo's size, at the middles of its pixels.
        columns = ((np.arange(rgb.shape[1] // 4) + 0.5) * 4 + left) * factor
        rows = (np.arange(rgb.shape[0] // 4) + 0.5) * 4 * factor
        depth = z[np.ix_(rows.astype(int), columns.astype(int))]
        inner = (300 / factor, 300 / factor, 300 / factor - left, 170 / factor)
        found.append(Shot(index, np.ascontiguousarray(rgb), depth, poses[at], inner, 10 + 0.1 * at))
    return found


def read_depth(room, at):
    """Returns the depth of a frame, in metres at the size of the photo."""
    return np.asarray(Image.open(room / "results" / f"depth{at:06d}.png")) / 6553.5


def carry_depth(room, poses, at):
    """Returns the depth of a frame by those before and after it, with holes."""
    near = [one for one in (at // STEPS * STEPS, (at // STEPS + 1) * STEPS)
            if (room / "results" / f"depth{one:06d}.png").exists()]
    found = None
    for one in near:
        z = read_depth(room, one)
        height, width = z.shape
        rows, columns = np.nonzero(z)
        rays = np.stack([(columns + 0.5 - 300) / 300, (rows + 0.5 - 170) / 300,
                         np.ones(len(rows))])
        motion = np.linalg.inv(poses[at]) @ poses[one]
        x, y, depth = motion[:3, :3] @ (rays * z[rows, columns]) + motion[:3, 3:]
        u, v = (np.floor(300 * along / depth + middle).astype(int)
                for along, middle in ((x, 300), (y, 170)))
        inside = (depth > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        found = np.full((height, width), np.inf) if found is None else found
        np.minimum.at(found, (v[inside], u[inside]), depth[inside])
    return np.where(np.isfinite(found), found, 0)


def cut(shot):
    """Returns a shot whose photo is a whole number of depth pixels large."""
    width, height = shot.depth.shape[1] * 4, shot.depth.shape[0] * 4
    return dataclasses.replace(shot, rgb=np.ascontiguousarray(shot.rgb[:height, :width]))


def jpeg(path, rgb):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(rgb).save(path, quality=95)


def millimetres(path, depth):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.rint(depth * 1000).astype(np.uint16)).save(path)


def levels(path, depth, high=2):
    """Writes confidence: the left column low, the next one medium, the rest high."""
    path.parent.mkdir(parents=True, exist_ok=True)
    values = np.full(depth.shape, high, np.uint8)
    values[:, 0], values[:, 1] = 0, high // 2
    Image.fromarray(values).save(path)


def rotation(matrix):
    """Returns the rotation of a pose, none of one that is not finite: its place says so."""
    good = np.isfinite(matrix[:3, :3]).all()
    return Rotation.from_matrix(matrix[:3, :3]) if good else Rotation.identity()


def quat(matrix):
    return rotation(matrix).as_quat().tolist()  # x y z w
