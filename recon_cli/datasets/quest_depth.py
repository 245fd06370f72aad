"""Depth of a Quest headset, which has a camera of its own, as the colour cameras see it.

{left,right}_depth/<ms>.raw hold float32 values of a depth buffer, and _depth_descriptors.csv for
each its size, planes, tangents of the field of view, and pose in Unity's axes. Neither the order of
the rows nor which tangent belongs to the first column is documented, so both are tried: what makes
the depth of different places agree is right, and without a clear winner no depth is read.
(t-34400/QuestRealityCapture; metaquest-3d-reconstruction, utils/depth_utils.py.)
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.datasets.depth_agreement import CLEARLY_WORSE, DepthView, compare_views
from recon_cli.datasets.depth_file import LIDAR_RANGE, DepthFile
from recon_cli.datasets.frame_files import numbers, pose_from_unity, read_csv
from recon_cli.datasets.frame_table import UNUSABLE, FrameTable, LeftOutError, nearest
from recon_cli.errors import FormatError
from recon_cli.scene.camera import Lens, make_lens

_TANGENTS = ("left", "right", "top", "down")
_POSE = tuple(f"create_pose_location_{axis}" for axis in "xyz")
_TURN = tuple(f"create_pose_rotation_{axis}" for axis in "xyzw")
_COLUMNS = ("timestamp_ms", "width", "height", "near_z", "far_z", *_POSE, *_TURN, *(
    f"fov_{side}_angle_tangent" for side in _TANGENTS))
_MOST_APART_MS = 50  # from a photo to its depth; a head turns by a degree or two meanwhile
_GOOD = 0.04  # relative error in which the best order must agree; the next one clearly worse
_MOST_SIDE = 4096  # pixels


@dataclass(frozen=True, eq=False)
class DepthFrame:
    """A depth buffer and its camera."""

    path: Path
    time_ms: float
    size: tuple[int, int]  # width, height
    planes: tuple[float, float]  # near and far, metres; far may be infinite
    tangents: tuple[float, ...]  # left, right, top, down; above 0
    viewmat: NDArray[np.float64]  # [4, 4] world to camera, OpenCV's axes, y up

    def read(self, order: Order) -> NDArray[np.float32]:
        """Returns z-depth [h, w] in metres, the top row first; FormatError if damaged."""
        width, height = self.size
        try:
            values = np.fromfile(self.path, "<f4").astype(np.float64)
        except OSError as error:
            raise FormatError(f"{self.path} cannot be read: {error}.") from error
        if values.size != width * height:
            raise FormatError(f"{self.path} does not hold {width}x{height} values.",
                              hint="Copy the recording from the headset again.")
        near, far = self.planes
        with np.errstate(divide="ignore", invalid="ignore"):
            if not near < far < np.inf:
                z = -2 * near / (2 * values - 2)
            else:
                z = -2 * near * far / (far - near) / (
                    2 * values - 1 - (far + near) / (far - near))
        z = np.where(np.isfinite(z) & (values > 0) & (values < 1) & (z > 0), z, 0)
        return z.reshape(height, width)[::-1 if order.bottom_first else 1].astype(np.float32)

    def lens(self, order: Order) -> Lens:
        """Returns the intrinsics."""
        width, height = self.size
        left, right, top, down = self.tangents
        first = right if order.swapped else left
        return make_lens("PINHOLE", width, height, (
            width / (left + right), height / (top + down), width * first / (left + right),
            height * top / (top + down)), str(self.path))


@dataclass(frozen=True)
class Order:
    """How a buffer lies in its file."""

    bottom_first: bool
    swapped: bool  # the right tangent is that of the first column


_ORDERS = tuple(Order(bottom, swapped) for bottom in (False, True) for swapped in (False, True))


def list_depth(folder: Path, eye: str, table: FrameTable) -> list[DepthFrame]:
    """Returns the depth frames of one side, in order of time; none where their list is missing."""
    descriptors = folder / f"{eye}_depth_descriptors.csv"
    frames = []
    for row in read_csv(descriptors, _COLUMNS) if descriptors.is_file() else ():
        with table.frame(f"depth {row.get('timestamp_ms', '?')}"):
            time, size, planes, tangents = _read_camera(row)
            path = folder / f"{eye}_depth" / f"{int(time)}.raw"
            viewmat = table.pose(_pose, row)
            if path.is_file():
                frames.append(DepthFrame(path, time, size, planes, tangents, viewmat))
    return sorted(frames, key=lambda frame: frame.time_ms)


def _read_camera(
    row: Mapping[str, str]
) -> tuple[float, tuple[int, int], tuple[float, float], tuple[float, ...]]:
    """Returns time, size, planes and tangents of a frame of depth."""
    try:
        time, width, height, near, far = numbers(row, _COLUMNS[:5])
        tangents = tuple(abs(one) for one in numbers(row, _COLUMNS[-4:]))
        size = int(width), int(height)
        angles = tangents[0] + tangents[1], tangents[2] + tangents[3]
        if not (min(size) > 0 and max(size) <= _MOST_SIDE and near > 0
                and min(angles) > 0 and np.isfinite(angles).all() and np.isfinite(time)):
            raise ValueError("no camera")
    except UNUSABLE as error:
        raise LeftOutError("of depth without a camera") from error
    return time, size, (near, far), tangents


def _pose(row: Mapping[str, str]) -> NDArray[np.float64]:
    return pose_from_unity(numbers(row, _TURN), numbers(row, _POSE))


def find_order(frames: Sequence[DepthFrame]) -> Order | None:
    """Returns the order that makes depth from different places agree; None without a winner."""
    errors = {}
    for order in _ORDERS:
        try:
            errors[order] = compare_views([
                DepthView(depth, frame.lens(order), frame.viewmat) for frame in frames
                if (depth := _within(frame.read(order))).any()])
        except FormatError:
            return None
    best = min(errors, key=lambda order: errors[order])
    others = [error for order, error in errors.items() if not _alike(order, best, frames)]
    if not errors[best] <= _GOOD or min(others, default=np.inf) < CLEARLY_WORSE * errors[best]:
        return None
    return best


def _within(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.where(depth <= LIDAR_RANGE, depth, 0)


def _alike(one: Order, other: Order, frames: Sequence[DepthFrame]) -> bool:
    """Returns whether orders mean the same, as swapped tangents of a symmetric camera do."""
    return one.bottom_first == other.bottom_first and all(
        abs(frame.lens(one).params[2] - frame.lens(other).params[2]) < 1 for frame in frames)


def depth_of_photo(
    frames: Sequence[DepthFrame], order: Order, time_ms: float, lens: Lens,
    viewmat: NDArray[np.float64],
) -> DepthFile | None:
    """Returns the depth that a colour camera sees, from the frame nearest in time if any is."""
    frame = nearest({frame.time_ms: frame for frame in reversed(frames)}, time_ms, _MOST_APART_MS)
    if frame is None:
        return None
    share = min(1.0, frame.size[0] / lens.width)
    own = lens.resized(round(share * lens.width), round(share * lens.height))
    return DepthFile(
        frame.path, 1.0, lens, own=own, reliable=LIDAR_RANGE,
        make=functools.partial(_carry, frame, order, own, viewmat))


def _carry(
    frame: DepthFrame, order: Order, lens: Lens, viewmat: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Returns the depth [h, w] of a frame as another camera sees it: the nearest, else 0."""
    depth, (fx, fy, cx, cy) = frame.read(order), frame.lens(order).params
    rows, columns = np.nonzero(depth)
    z = depth[rows, columns].astype(np.float64)
    points = np.stack([(columns + 0.5 - cx) / fx * z, (rows + 0.5 - cy) / fy * z, z])
    motion = viewmat @ np.linalg.inv(frame.viewmat)
    x, y, z = motion[:3, :3] @ points + motion[:3, 3:]
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.floor(x / z * lens.params[0] + lens.params[2])
        v = np.floor(y / z * lens.params[1] + lens.params[3])
    inside = (z > 0) & (u >= 0) & (u < lens.width) & (v >= 0) & (v < lens.height)
    seen = np.full((lens.height, lens.width), np.inf, np.float32)
    np.minimum.at(seen, (v[inside].astype(int), u[inside].astype(int)), z[inside])
    return np.where(np.isfinite(seen), seen, 0).astype(np.float32)
