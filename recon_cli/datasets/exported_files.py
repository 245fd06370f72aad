"""What readers of photogrammetry exports share: points beside photos, far worlds, lenses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from recon_cli.datasets.depth_points import MAX_POINTS, thin_points
from recon_cli.datasets.posed import PosedSet
from recon_cli.errors import FormatError, InputError
from recon_cli.scene.camera import Lens, make_lens

# Beyond this many units from the origin, map coordinates: float32 would round to centimetres.
_FAR = 1e4
_MOST_OFF = 0.25  # pixels by which a lens without r^8 may miss one that has it
_FITS = 3.0  # points of the same world lie within so many times the extent of the cameras
# Points of a model lie on surfaces, most of which a scan of the same world shows too: one of a
# hundred points spread over them is this near, as a share of the extent. So many are asked.
_NEAR, _ASKED = 0.1, 2000

Point = tuple[Sequence[float], Sequence[float]]  # place, and RGB from 0 to 255


def thin_cloud(posed: PosedSet, cloud: Sequence[Point]) -> PosedSet:
    """Returns the set with the points that are finite, some of very many, evenly spread."""
    values = np.array([[*place, *rgb] for place, rgb in cloud]).reshape(-1, 6)
    values = values[np.isfinite(values).all(axis=1)]
    values = values[thin_points(values[:, :3], MAX_POINTS)]
    if not len(values):
        return posed
    return replace(posed, points=values[:, :3], colors=values[:, 3:].clip(0, 255).astype(np.uint8))


def shift_far(posed: PosedSet) -> PosedSet:
    """Returns the set with its world moved to its cameras, if it lies as far off as on a map."""
    middle = np.round(np.median(posed.centers, axis=0))
    if np.abs(middle).max() < _FAR:
        return posed
    images = []
    for image in posed.images:
        viewmat = image.viewmat.copy()
        viewmat[:3, 3] += viewmat[:3, :3] @ middle
        images.append(replace(image, viewmat=viewmat))
    text = " ".join(f"{value:.0f}" for value in middle)
    return replace(
        posed, images=tuple(images), points=None if posed.points is None else posed.points - middle,
        notices=(*posed.notices, f"its world lies far from the origin, as on a map: {text} was "
                 "subtracted from all positions"))


def find_points(posed: PosedSet, folder: Path) -> PosedSet:
    """Returns the set with the points of the one .ply beside it, if it has one that fits."""
    files = sorted(path for path in folder.glob("*.ply") if path.is_file())
    if posed.points is not None or not files:
        return posed
    if len(files) > 1:
        return _with_notice(posed, f"its {len(files)} .ply files are not read: one may be given")
    return read_points(posed, files[0])


def read_points(posed: PosedSet, path: Path) -> PosedSet:
    """Returns the set with the points of a .ply, in place of its own; a notice if they do not fit.

    Of very many points some are taken, evenly spread.
    """
    try:
        points, colors = read_cloud(path)
    except (FormatError, InputError) as error:
        return _with_notice(posed, f"{path.name} is not read: {error.message}")
    if not _fits(points, posed):
        return _with_notice(posed, f"{path.name} is not read: its points lie far from the cameras, "
                            "or from the set's own points")
    rows = thin_points(points, MAX_POINTS)
    count = f"{len(points)} points" + f", {len(rows)} of them, evenly spread" * (
        len(rows) < len(points))
    return _with_notice(
        replace(posed, points=points[rows], colors=colors[rows]), f"{path.name} gives {count}")


def read_cloud(path: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Returns the points [P, 3] of a .ply and their colours, gray where it has none."""
    # Late, for it imports torch, which nothing else here needs.
    from recon_cli.splats.ply import read_ply_points

    points, colors = read_ply_points(path)
    return points, np.full(points.shape, 128, np.uint8) if colors is None else colors


def _fits(points: NDArray[np.float64], posed: PosedSet) -> bool:
    """Returns whether points may be of the world of a set, by its cameras and its own points."""
    if not len(points):
        return False
    centers = posed.centers
    extent = max(float(np.ptp(centers, axis=0).max()), _extent(points))
    if not np.linalg.norm(np.median(points - np.median(centers, axis=0), axis=0)) <= _FITS * extent:
        return False
    if posed.points is None or not len(posed.points):
        return True
    some = posed.points[::max(1, len(posed.points) // _ASKED)]
    return bool(np.median(KDTree(points).query(some)[0]) <= _NEAR * extent)


def _extent(points: NDArray[np.float64]) -> float:
    """Returns the longest side of the box that holds most points."""
    return float(np.ptp(np.percentile(points, (5, 95), axis=0), axis=0).max())


def _with_notice(posed: PosedSet, text: str) -> PosedSet:
    return replace(posed, notices=(*posed.notices, text))


def radial_lens(
    size: tuple[int, int], inner: Sequence[float], radial: Sequence[float],
    tangential: tuple[float, float], where: str,
) -> Lens:
    """Returns a lens of fx fy cx cy, k1 to k4 of r^2 to r^8, and OpenCV's p1 and p2.

    COLMAP's models have no r^8: with k4, the others are those that come nearest over the picture.
    FormatError if they miss it.
    """
    if radial[3]:
        radial = (*_without_last(size, inner, np.array(radial), where), 0.0)
    k1, k2, k3, _ = map(float, radial)
    if not any((k1, k2, k3, *tangential)):
        return make_lens("PINHOLE", *size, inner, where)
    if not k3:
        return make_lens("OPENCV", *size, (*inner, k1, k2, *tangential), where)
    return make_lens(
        "FULL_OPENCV", *size, (*inner, k1, k2, *tangential, k3, 0.0, 0.0, 0.0), where)


def _without_last(
    size: tuple[int, int], inner: Sequence[float], radial: NDArray[np.float64], where: str
) -> NDArray[np.float64]:
    """Returns k1 to k3 that move points as k1 to k4 do, to a fraction of a pixel."""
    width, height = size
    fx, fy, cx, cy = inner
    corner = np.hypot(max(cx, width - cx) / fx, max(cy, height - cy) / fy)
    r = np.linspace(0, corner, 200)
    powers = r[:, None]**np.array([3, 5, 7, 9]) * fx  # pixels along the radius
    offsets = powers @ radial
    if not np.isfinite(offsets).all():
        raise FormatError(f"{where} has coefficients of distortion that are not finite.")
    fitted = np.linalg.lstsq(powers[:, :3], offsets, rcond=None)[0]
    off = float(np.abs(powers[:, :3] @ fitted - offsets).max())
    if off > _MOST_OFF:
        raise FormatError(
            f"{where} has k4 = {radial[3]:g}, a term of r^8 that moves points by up to {off:.1f} "
            "pixels, and cannot be used.", hint="Export undistorted images, or fit without k4.")
    return np.asarray(fitted)
