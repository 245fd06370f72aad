"""Regions of a picture without texture, and the plane that the points around one lie in.

Such a region is one surface, most often: a bare wall, a ceiling, a door. It has no points itself,
but things on it and its edges have, and what stands before it has nearer ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.scene.camera import Camera
from recon_cli.scene.train_view import TrainView

_SIDE = 320  # pixels of the longer side in which regions are looked for
_FLAT = 1.4  # gray levels a pixel; a gradient below it is no texture
_LEAST_REGION = 0.004  # of the picture
_AROUND = 0.03  # of the longer side: how far from a region its points may lie
_LEAST_POINTS = 6
_LEVEL_TRIALS, _UPRIGHT_TRIALS = 40, 150
_NEAR = 0.012  # of a depth, within which a point lies in a plane
_BEHIND = 0.024  # of a depth, from which on it lies behind one
_BLAME = 2  # points in a plane that one behind it takes back
_LEAST_INSIDE = 5  # points, more than those behind take back
_LEAST_SHARE = 0.25  # of the points around a region, in its plane
_LEAST_SPAN = 0.4  # of the region's longer side, over which the points in its plane spread
_HULL_SAMPLES = 300  # pixels of a region, of which as many as its points enclose are counted

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Picture:
    """A small training view with the points that it sees."""

    camera: Camera
    image: NDArray[np.uint8]  # [H, W, 3]
    rows: NDArray[np.int64]  # [K] of the points
    points: Array  # [K, 3]
    pixels: Array  # [K, 2] where they are seen
    depths: Array  # [K]

    @staticmethod
    def of(view: TrainView, points: Array, rows: NDArray[np.int64]) -> Picture:
        """Returns a reduced view that sees `rows` of the points [P, 3]."""
        scale = min(1.0, _SIDE / max(view.camera.width, view.camera.height))
        camera = view.camera.resized(
            max(1, round(scale * view.camera.width)), max(1, round(scale * view.camera.height)))
        image = cv2.resize(
            view.image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        x, y, z = (points[rows] @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]).T
        ahead = np.maximum(z, 1e-9)
        pixels = np.stack([
            camera.fx * x / ahead + camera.cx, camera.fy * y / ahead + camera.cy], axis=1)
        inside = (z > 1e-9) & (pixels >= 0).all(1) & (
            pixels < [camera.width, camera.height]).all(1)
        rows = rows[inside]
        return Picture(camera, np.asarray(image, np.uint8), rows, points[rows], pixels[inside],
                       z[inside])

    def rays(self, lines: NDArray[np.int64], columns: NDArray[np.int64]) -> Array:
        """Returns [N, 3] rays through pixels, of depth 1, in the world."""
        camera = self.camera
        along = np.stack([(columns + 0.5 - camera.cx) / camera.fx,
                          (lines + 0.5 - camera.cy) / camera.fy, np.ones(len(lines))], axis=1)
        return np.asarray(along @ camera.viewmat[:3, :3])


@dataclass(frozen=True, eq=False)
class Region:
    """A part of a picture without texture."""

    lines: NDArray[np.int64]  # [N] of its pixels
    columns: NDArray[np.int64]  # [N]
    around: NDArray[np.int64]  # [K] rows of the picture's points that lie in or near it

    def coverage(self, corners: Array) -> float:
        """Returns the share of the region in the convex hull of pixels [C, 2]."""
        chosen = np.linspace(0, len(self.lines) - 1, _HULL_SAMPLES).astype(int)
        shape = self.lines.max() + 1, self.columns.max() + 1
        hull = cv2.fillConvexPoly(
            np.zeros(shape, np.uint8),
            cv2.convexHull(corners.astype(np.float32)).astype(np.int32), 1)
        return float(hull[self.lines[chosen], self.columns[chosen]].mean())


@dataclass(frozen=True, eq=False)
class Fit:
    """The plane n x = h that the points around a region lie in."""

    normal: Array  # [3] unit vector, towards the camera
    offset: float
    inside: NDArray[np.int64]  # rows of the scene's points that lie in it
    pixels: int  # of the region


def find_regions(picture: Picture, mask: NDArray[np.bool_] | None) -> list[Region]:
    """Returns the regions without texture; `mask` [H, W] is False where a pixel does not count."""
    gray = cv2.GaussianBlur(
        cv2.cvtColor(picture.image, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 1.0)
    across, down = (cv2.Sobel(gray, cv2.CV_32F, *order, scale=0.125) for order in ((1, 0), (0, 1)))
    flat = np.hypot(across, down) < _FLAT
    if mask is not None:
        flat &= mask
    flat = cv2.erode(flat.astype(np.uint8), np.ones((3, 3), np.uint8))
    count, labels, statistics, _ = cv2.connectedComponentsWithStats(flat, connectivity=4)
    radius = max(3, round(_AROUND * max(flat.shape)))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    column, line = picture.pixels.astype(np.int64).T
    regions = []
    for number in range(1, count):
        if statistics[number, cv2.CC_STAT_AREA] < _LEAST_REGION * flat.size:
            continue
        own = (labels == number).astype(np.uint8)
        around = np.flatnonzero(cv2.dilate(own, disc)[line, column])
        if len(around) >= _LEAST_POINTS:
            lines, columns = np.nonzero(own)
            regions.append(Region(lines, columns, around))
    return regions


def plane_depths(
    picture: Picture, rays: Array, normals: Array, offsets: Array
) -> Array:
    """Returns the depths [N, C] at which rays [N, 3] meet planes [C]; infinite where they do not.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        depths = (offsets - picture.camera.center @ normals.T) / (rays @ normals.T)
    return np.where(depths > 0, depths, np.inf)


def judge(
    picture: Picture, region: Region, normals: Array, offsets: Array
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Returns which of the K points around a region lie in each of C planes, and which behind."""
    points, depths = picture.points[region.around], picture.depths[region.around, None]
    rays = (points - picture.camera.center) / depths
    met = plane_depths(picture, rays, normals, offsets)
    return np.abs(met - depths) < _NEAR * depths, depths > (1 + _BEHIND) * met


def fit_plane(
    picture: Picture, region: Region, up: Array, generator: np.random.Generator
) -> Fit | None:
    """Returns the level or upright plane of most points (RANSAC); None where too few agree."""
    points = picture.points[region.around]
    normals, offsets = _candidates(points, up, generator)
    inside, behind = judge(picture, region, normals, offsets)
    scores = inside.sum(0) - _BLAME * behind.sum(0)
    best = int(scores.argmax())
    chosen = inside[:, best]
    if scores[best] < _LEAST_INSIDE or chosen.mean() < _LEAST_SHARE:
        return None
    spread = float(np.ptp(picture.pixels[region.around[chosen]], axis=0).max())
    if spread < _LEAST_SPAN * max(int(np.ptp(region.lines)), int(np.ptp(region.columns))):
        return None
    normal, offset = normals[best], float(offsets[best])
    side = 1.0 if picture.camera.center @ normal > offset else -1.0
    return Fit(side * normal, side * offset, picture.rows[region.around[chosen]],
               len(region.lines))


def _candidates(
    points: Array, up: Array, generator: np.random.Generator
) -> tuple[Array, Array]:
    """Returns planes [C] through one point, level, and through two points, upright."""
    level = points[generator.permutation(len(points))[:_LEVEL_TRIALS]] @ up
    pairs = generator.integers(0, len(points), (_UPRIGHT_TRIALS, 2))
    first, second = points[pairs[:, 0]], points[pairs[:, 1]]
    upright = np.cross(second - first, up)
    length = np.linalg.norm(upright, axis=1)
    apart = length > 1e-9
    upright = upright[apart] / length[apart, None]
    normals = np.concatenate([np.tile(up, (len(level), 1)), upright])
    return normals, np.concatenate([level, (first[apart] * upright).sum(1)])


def choose_plane(
    picture: Picture, region: Region, normals: Array, offsets: Array,
    *, least: int, coverage: float, farthest: float,
) -> int | None:
    """Returns which of C planes a region lies in: the nearest that its points speak for, or None.

    `least` points, more than those behind take back, must lie in it and enclose `coverage` of the
    region; all of the region must lie nearer than `farthest`.
    """
    inside, behind = judge(picture, region, normals, offsets)
    scores = inside.sum(0) - (_BLAME + 1) * behind.sum(0)
    chosen = np.linspace(0, len(region.lines) - 1, 40).astype(int)
    depths = plane_depths(
        picture, picture.rays(region.lines[chosen], region.columns[chosen]), normals, offsets)
    scores[(depths < farthest).mean(0) < 0.98] = -1
    for number in np.flatnonzero(scores >= least):
        corners = picture.pixels[region.around[inside[:, number]]]
        if region.coverage(corners) < coverage:
            scores[number] = -1
    good = scores >= max(least, 0.5 * float(scores.max(initial=0)))
    if not good.any():
        return None
    return int(np.where(good, np.median(np.minimum(depths, farthest), axis=0), np.inf).argmin())


def look_at(
    views: Sequence[TrainView], seen: Sequence[NDArray[np.int64]], points: Array
) -> list[tuple[Picture, list[Region]]]:
    """Returns the pictures of views, each seeing some rows of the points, and their regions."""
    looked = []
    for view, rows in zip(views, seen, strict=True):
        picture = Picture.of(view, points, rows)
        mask = None
        if view.mask is not None:
            size = picture.camera.width, picture.camera.height
            mask = cv2.resize(view.mask.astype(np.float32), size,
                              interpolation=cv2.INTER_AREA) == 1
        looked.append((picture, find_regions(picture, mask)))
    return looked
