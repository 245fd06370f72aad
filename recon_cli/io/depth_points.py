"""Initial points from depth: a spread of pixels of many frames, thinned evenly over surfaces."""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from recon_cli.errors import FormatError, InputError
from recon_cli.io.calibration import directions
from recon_cli.io.posed import PosedImage, PosedSet
from recon_cli.scene.camera import MODELS, Lens

_FARTHEST = float(np.finfo(np.float32).max)


@dataclass(frozen=True)
class DepthFile:
    """Reads the z-depth of an image from its file.

    Depth of another size than the image is looked up at the nearest pixel along the same ray, for a
    mean over an edge would be the depth of nothing. The rays are compared without distortion.

    Attributes:
        path: the file.
        unit: world units of a value of 1.
        lens: intrinsics of the image.
        own: intrinsics of the depth; None where it covers the same field of view.
    """

    path: Path
    unit: float
    lens: Lens
    own: Lens | None = None

    def __call__(self) -> NDArray[np.float32]:
        """Returns [H, W] z-depth at the size of the image, in world units, 0 where there is none.

        Raises:
            FormatError: the file is missing, damaged or no depth.
        """
        values = _read(self.path)
        exact = values.astype(np.float64) * self.unit
        depth = np.where((exact > 0) & (exact < _FARTHEST), exact, 0).astype(np.float32)
        height, width = depth.shape
        own = self.own if self.own is not None else self.lens.resized(width, height)
        if (width, height) != (own.width, own.height):
            own = own.resized(width, height)
        if own == self.lens:
            return depth
        columns, inside_x = _nearest(_axis(self.lens, 0), _axis(own, 0), self.lens.width, width)
        rows, inside_y = _nearest(_axis(self.lens, 1), _axis(own, 1), self.lens.height, height)
        found: NDArray[np.float32] = depth[np.ix_(rows, columns)]
        found[~(inside_y[:, None] & inside_x[None, :])] = 0
        return found


def _read(path: Path) -> NDArray[np.generic]:
    hint = "Copy the file again, or delete it to go without its depth."
    if not path.is_file():
        raise FormatError(f"{path} is missing.", hint=hint)
    try:
        if path.suffix.lower() == ".npy":
            values = np.asarray(np.load(path, allow_pickle=False))
        else:
            # Not OpenCV, which gives the first rows of a damaged PNG for the whole.
            with Image.open(path, formats=("PNG", "TIFF")) as image:
                values = np.asarray(image)
    except (OSError, ValueError, EOFError, SyntaxError, struct.error, zlib.error) as error:
        raise FormatError(f"{path} is no depth that can be read: {error}.", hint=hint) from error
    if values.ndim != 2 or values.dtype.kind not in "uif" or not values.size:
        raise FormatError(
            f"{path} is no depth: it holds {values.dtype} of shape {values.shape}, needed one "
            "value a pixel.", hint=hint)
    return values


def _axis(lens: Lens, axis: int) -> tuple[float, float]:
    """Returns focal length and principal point along x or y."""
    focals, _ = MODELS[lens.model]
    return lens.params[axis if focals == 2 else 0], lens.params[focals + axis]


def _nearest(
    image: tuple[float, float], own: tuple[float, float], size: int, own_size: int
) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Returns the pixel of the depth that each pixel of the image falls in, and whether any."""
    rays = (np.arange(size) + 0.5 - image[1]) / image[0]
    # The tiny nudge decides for exact halves, where rounding would.
    at = np.floor(rays * own[0] + own[1] + 1e-6).astype(np.intp)
    return at.clip(0, own_size - 1), (at >= 0) & (at < own_size)


MAX_POINTS = 100_000  # as many as INRIA's 3DGS draws where a data set has no points of its own
# Frames that are read, evenly spread: at two a second they cover a walk of 100 s, which is a room,
# and each costs the reading of an image.
MAX_FRAMES = 200
_SAMPLES = 8  # for each point that is kept, so that thinning can choose where frames overlap
_HALVINGS = 24  # of the interval of voxel sizes; the count then changes by less than a hundredth


def points_from_depth(
    posed: PosedSet, *, most: int = MAX_POINTS
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Returns points [P, 3] in the world of the set, and their RGB colours [P, 3].

    Held-out images are left alone: neither their depth nor their colours may be known before the
    score. The same set gives the same points.

    Args:
        posed: a set in which some images have depth.
        most: greatest number of points.

    Raises:
        InputError: no image that may be used has depth at any pixel.
        FormatError: an image or its depth cannot be read.
    """
    images = [image for image in posed.images if image.depth is not None and not image.held_out]
    images = _spread(images)
    pixels = sum(posed.lenses[image.lens].width * posed.lenses[image.lens].height
                 for image in images)
    step = max(1, math.ceil(math.sqrt(pixels / (_SAMPLES * most))))
    clouds = [_unproject(image, posed.lenses[image.lens], step) for image in images]
    points = np.concatenate([cloud for cloud, _ in clouds]) if clouds else np.zeros((0, 3))
    if not len(points):
        raise InputError(
            f"None of the {len(images)} frames with depth has any above 0.",
            hint="Check the depth files and their scale.")
    colors = np.concatenate([color for _, color in clouds])
    kept = _thin(points, most)
    return points[kept], colors[kept]


def _spread(images: Sequence[PosedImage]) -> list[PosedImage]:
    count = min(len(images), MAX_FRAMES)
    return [images[int((at + 0.5) * len(images) / count)] for at in range(count)]


def _unproject(
    image: PosedImage, lens: Lens, step: int
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Returns the world points and colours of every step-th pixel of a frame that has depth."""
    assert image.depth is not None
    depth = image.depth()[step // 2::step, step // 2::step]
    rgb = _read_rgb(image, lens)[step // 2::step, step // 2::step]
    rows, columns = np.nonzero(depth)
    at = np.stack([columns, rows], axis=1).astype(np.float64) * step + (step // 2 + 0.5)
    rays = directions(lens, at)
    z = depth[rows, columns].astype(np.float64)
    camera = np.column_stack([rays * z[:, None], z])
    rotation, shift = image.viewmat[:3, :3], image.viewmat[:3, 3]
    world = (camera - shift) @ rotation  # R^T (x - t), for each row
    good = np.isfinite(world).all(axis=1)
    return world[good], rgb[rows, columns][good]


def _read_rgb(image: PosedImage, lens: Lens) -> NDArray[np.uint8]:
    # Poses and depth belong to the pixels as they lie in the file.
    data = cv2.imread(str(image.path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if data is None or data.shape[:2] != (lens.height, lens.width):
        raise FormatError(
            f"{image.path} cannot be read as an image of {lens.width}x{lens.height} pixels.",
            hint="Copy the image again.")
    return np.asarray(data[:, :, ::-1], np.uint8)


def _thin(points: NDArray[np.float64], most: int) -> NDArray[np.intp]:
    """Returns the indices of one point for each voxel, of the smallest voxels that allow it."""
    if len(points) <= most:
        return np.arange(len(points))
    low = points.min(axis=0)
    extent = float((points - low).max())
    small, large = math.log(max(extent, 1e-12)) - 18 * math.log(2), math.log(max(extent, 1e-12)) + 1
    for _ in range(_HALVINGS):
        middle = (small + large) / 2
        if len(np.unique(_cells(points - low, math.exp(middle)))) > most:
            small = middle
        else:
            large = middle
    _, first = np.unique(_cells(points - low, math.exp(large)), return_index=True)
    return np.sort(first)


def _cells(offsets: NDArray[np.float64], voxel: float) -> NDArray[np.int64]:
    """Returns the number of the voxel that each point lies in."""
    at = (offsets / voxel).astype(np.int64)  # below 2^19, so three of them fit in 63 bits
    return np.asarray((at[:, 0] << 40) | (at[:, 1] << 20) | at[:, 2])
