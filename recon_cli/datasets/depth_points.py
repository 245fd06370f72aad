"""Initial points from depth: evenly spread pixels of many frames, thinned over surfaces."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.datasets.posed import PosedImage, PosedSet
from recon_cli.errors import FormatError, InputError
from recon_cli.io.calibration import undistort_pixels
from recon_cli.io.images import decode_file
from recon_cli.io.views import spread_inside

MAX_POINTS = 100_000  # as many as INRIA's 3DGS draws if a data set has no points
# Frames that are read, evenly spread: at two a second 100 s of walking, enough for a room.
MAX_FRAMES = 200
_SAMPLES = 8  # for each point that is kept, so that thinning can choose where frames overlap
_HALVINGS = 24  # of the interval of voxel sizes; the count then changes by less than a hundredth


def points_from_depth(
    posed: PosedSet, *, max_points: int = MAX_POINTS
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Returns points [P, 3] in the world of the set, and their RGB colours [P, 3]; deterministic.

    Held-out images are not used: neither their depth nor their colours may be known before the
    score. InputError if no image that may be used has depth, FormatError if one cannot be read.
    """
    images = [image for image in posed.images if image.depth is not None and not image.held_out]
    images = spread_inside(images, MAX_FRAMES)
    pixels = sum(image.lens.width * image.lens.height for image in images)
    step = max(1, math.ceil(math.sqrt(pixels / (_SAMPLES * max_points))))
    clouds = [_unproject(image, step) for image in images]
    points = np.concatenate([cloud for cloud, _ in clouds]) if clouds else np.zeros((0, 3))
    if not len(points):
        raise InputError(
            f"None of the {len(images)} frames with depth has any above 0.",
            hint="Check the depth files and their scale.")
    colors = np.concatenate([color for _, color in clouds])
    rows = thin_points(points, max_points)
    return points[rows], colors[rows]


def _unproject(image: PosedImage, step: int) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Returns the world points and colours of every step-th pixel of a frame that has depth."""
    assert image.depth is not None
    depth = image.depth()[step // 2::step, step // 2::step]
    rgb = _read_rgb(image)[step // 2::step, step // 2::step]
    rows, columns = np.nonzero(depth)
    at = np.stack([columns, rows], axis=1).astype(np.float64) * step + (step // 2 + 0.5)
    rays = undistort_pixels(image.lens, at)
    z = depth[rows, columns].astype(np.float64)
    camera = np.column_stack([rays * z[:, None], z])
    rotation, shift = image.viewmat[:3, :3], image.viewmat[:3, 3]
    world = (camera - shift) @ rotation  # R^T (x - t), for each row
    good = np.isfinite(world).all(axis=1)
    return world[good], rgb[rows, columns][good]


def _read_rgb(image: PosedImage) -> NDArray[np.uint8]:
    lens = image.lens
    # Poses and depth belong to the pixels as they lie in the file.
    data = decode_file(image.path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if data is None or data.shape[:2] != (lens.height, lens.width):
        raise FormatError(
            f"{image.path} cannot be read as an image of {lens.width}x{lens.height} pixels.",
            hint="Copy the image again.")
    return np.asarray(data[:, :, ::-1], np.uint8)


def thin_points(points: NDArray[np.float64], max_points: int) -> NDArray[np.intp]:
    """Returns the indices of one point for each voxel, of the smallest voxels that allow it."""
    if len(points) <= max_points:
        return np.arange(len(points))
    offsets = np.ascontiguousarray((points - points.min(axis=0)).T)
    extent = float(offsets.max())
    small, large = math.log(max(extent, 1e-12)) - 18 * math.log(2), math.log(max(extent, 1e-12)) + 1
    for _ in range(_HALVINGS):
        middle = (small + large) / 2
        # Far faster than `np.unique`, which hashes integers.
        cells = np.sort(_cells(offsets, math.exp(middle)))
        if 1 + np.count_nonzero(cells[1:] != cells[:-1]) > max_points:
            small = middle
        else:
            large = middle
    _, first = np.unique(_cells(offsets, math.exp(large)), return_index=True)
    return np.sort(first)


def _cells(offsets: NDArray[np.float64], voxel: float) -> NDArray[np.int64]:
    """Returns the number of the voxel that each point lies in; `offsets` are [3, P]."""
    x, y, z = ((row / voxel).astype(np.int64) for row in offsets)
    return np.asarray((x << 40) | (y << 20) | z)  # each below 2^19: 63 bits hold them
