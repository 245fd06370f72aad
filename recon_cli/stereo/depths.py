"""Depth maps of photos by dense stereo, where another photo finds the same surface.

Training fits colours. Where a wall has little texture, Gaussians at many depths give the same
images, and structure from motion finds no points. Images of neighbours still differ there by their
shading: summed over windows and made smooth along paths of pixels, that tells the depth
(`kernels.match`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.kernels.thread_pool import pool
from recon_cli.scene.camera import Camera
from recon_cli.scene.train_view import TrainView
from recon_cli.stereo.kernels import compare, lay_planes, match

_LEAST_SIDE = 8  # pixels of any side; windows have 5
# Weight of a neighbour: the points seen by both, each by the angle between the rays to it. Below
# the best angle depth is uncertain, far beyond it surfaces look different.
_ANGLE, _NARROWER, _WIDER = 5.0, 1.5, 8.0  # degrees: the best, and standard deviations
_LEAST_ANGLE = 1.0  # degrees; below it all depths look alike
LEAST_SEEN = 10  # points that a view, or two together, must see
# The first search, at half the size: inverse depths evenly spread, over more than the surface spans
_HYPOTHESES, _RADIUS = 64, 1
_BEYOND = (0.7, 1.4)
COMPARED = 14  # partners of a view at most; what is level or refined is compared with all
# and along level planes, by their distance from the camera in median depths: in rooms from 65 cm,
# which a table top lies below a standing person's eyes, to 3 m
_LEVELS, _HEIGHTS = 32, (0.25, 1.2)
# The second one, about what the first found: a window then follows slanted surfaces.
_REFINED, _FINER, _REFINED_RADIUS = 9, 4, 2
EDGE = 0.03  # of an inverse depth; larger steps between pixels are edges of things
TOLERANCE = 0.015  # of a depth, within which another view confirms it
_FRONTAL = np.zeros(3)  # planes parallel to each image
_WINDOW, _TEXTURE = 5, 6.0  # pixels a side; deviation of grey levels at which a plane counts 1/e
_SMALL = 16  # pixels a side


@dataclass(frozen=True, eq=False)
class Levels:
    """The level planes, floors and ceilings above all, that are searched as well.

    Up has to be known: tilted planes find less of a ceiling than no planes at all.
    """

    up: NDArray[np.float64]  # [3] unit vector
    median: float  # depth of all photos, world units


@dataclass(frozen=True, eq=False)
class _Sweep:
    """One search: see `match`."""

    partners: NDArray[np.int64]  # [V, K]
    base: Sequence[NDArray[np.float32]]  # [H, W] of each photo
    lowest: NDArray[np.float64]  # [V]
    steps: NDArray[np.float64]  # [V]
    hypotheses: int
    radius: int
    normal: NDArray[np.float64]  # [3]


@dataclass(frozen=True, eq=False)
class StereoView:
    """A view and the range of depths to search."""

    view: TrainView
    nearest: float  # world units
    farthest: float
    gain: float = 1.0  # of its exposure

    @property
    def grey(self) -> NDArray[np.float32]:
        """Grey levels [H, W] as they were at the mean exposure."""
        grey = cv2.cvtColor(np.ascontiguousarray(self.view.image), cv2.COLOR_RGB2GRAY)
        return np.asarray(grey, np.float32) / np.float32(self.gain)


def find_depths(
    photos: Sequence[StereoView], partners: NDArray[np.int64], near: float,
    on_photo: Callable[[], None] = lambda: None, *, levels: Levels | None = None,
) -> list[NDArray[np.float32]]:
    """Returns a depth map [H, W] in world units of each photo, 0 where there is none.

    Args:
        photos: at the size that is searched.
        partners: [V, K] photos that each is compared with, -1 for none.
        near: least depth of a surface, world units.
        on_photo: called for each photo twice, with `levels` three times.
        levels: to be searched as well; two fifths more time for more of floors and ceilings.
    """
    full = [(photo.grey, photo.view.camera) for photo in photos]
    half = [_halved(*image) for image in full]
    near_share, far_share = _BEYOND
    ranges = np.array([(1 / (far_share * photo.farthest), 1 / max(near_share * photo.nearest, near))
                       for photo in photos])
    lowest = np.ascontiguousarray(ranges[:, 0])
    steps = (ranges[:, 1] - lowest) / (_HYPOTHESES - 1)
    base = [np.zeros(image.shape, np.float32) for image, _ in half]
    sweeps = [_Sweep(
        partners[:, :COMPARED], base, lowest, steps, _HYPOTHESES, _RADIUS, _FRONTAL)]
    if levels:
        first, last = 1 / (_HEIGHTS[1] * levels.median), 1 / (_HEIGHTS[0] * levels.median)
        step = (last - first) / (_LEVELS - 1)
        sweeps.append(_Sweep(
            partners, base, np.full(len(photos), first), np.full(len(photos), step), _LEVELS,
            _RADIUS, levels.up))
    coarse = _search(half, sweeps, on_photo)
    coarse = _laid_on_planes(half, coarse, partners, near, steps)
    fine = steps / _FINER
    priors = [_enlarged(found, image.shape)
              for (image, _), found in zip(full, coarse, strict=True)]
    refined = _search(full, [_Sweep(
        partners, priors, -fine * (_REFINED // 2), fine, _REFINED, _REFINED_RADIUS, _FRONTAL)],
        on_photo)
    depths = [np.where(prior > 0, _depth(inverse), np.float32(0))
              for prior, inverse in zip(priors, refined, strict=True)]
    masks = [photo.view.mask for photo in photos]
    confirmed = _confirmed(depths, [camera for _, camera in full], partners, near)
    return [np.where(there if mask is None else there & mask, depth, np.float32(0))
            for depth, there, mask in zip(depths, confirmed, masks, strict=True)]


def find_partners(
    cameras: Sequence[Camera], points: NDArray[np.float64], seen: NDArray[np.bool_], most: int
) -> NDArray[np.int64]:
    """Returns the views [V, most] that each view is compared with, best first, -1 for none.

    `seen` [V, P] tells which view sees which of the points [P, 3].
    """
    rays = points - np.stack([camera.center for camera in cameras])[:, None]
    rays /= np.maximum(np.linalg.norm(rays, axis=2, keepdims=True), 1e-12)
    partners = np.full((len(cameras), most), -1, np.int64)
    for own in range(len(cameras)):
        mine = np.flatnonzero(seen[own])
        angles = np.degrees(np.arccos(np.clip((rays[:, mine] * rays[own, mine]).sum(2), -1, 1)))
        spread = np.where(angles < _ANGLE, _NARROWER, _WIDER)
        both = seen[:, mine] & (angles >= _LEAST_ANGLE)
        worth = (both * np.exp(-0.5 * ((angles - _ANGLE) / spread) ** 2)).sum(axis=1)
        worth[both.sum(axis=1) < LEAST_SEEN] = 0
        worth[own] = 0
        best = np.argsort(-worth, kind="stable")[:most]
        best = best[worth[best] > 0]
        partners[own, :len(best)] = best
    return partners


def unproject(
    camera: Camera, depth: NDArray[np.float32], pixels: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Returns where some pixels of a depth map [H, W] lie, [N, 3] in world units."""
    line, column = np.divmod(pixels, depth.shape[1])
    return camera.unproject(np.stack([column, line], axis=1) + 0.5, depth.reshape(-1)[pixels])


def compile_kernels() -> None:
    """Compiles the kernels, or loads them from the cache, by a search of two small photos."""
    cameras = [Camera(_SMALL, _SMALL, _SMALL, _SMALL, _SMALL / 2, _SMALL / 2, viewmat)
               for viewmat in (np.eye(4), np.eye(4))]
    image = np.zeros((_SMALL, _SMALL, 3), np.uint8)
    find_depths([StereoView(TrainView(camera, image), 1.0, 2.0) for camera in cameras],
                np.array([[1], [0]]), near=0.1)


NEAREST = 0.02  # of the median depth; nothing nearer to a camera is a surface


def spanned(depths: NDArray[np.floating]) -> tuple[float, float]:
    """Returns how near and how far a view is searched: between the outer hundredths of [N]."""
    near, far = np.quantile(depths, [0.01, 1 - 0.01])
    return float(near), float(far)


CAMERA_NUMBERS = 9 + 3 + 6  # rotation, translation, and focal lengths to size


def camera_row(camera: Camera) -> NDArray[np.float64]:
    """Returns a camera as the kernels read it, [CAMERA_NUMBERS]."""
    return np.concatenate([
        camera.viewmat[:3, :3].reshape(-1), camera.viewmat[:3, 3],
        [camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height]])


def _halved(image: NDArray[np.float32], camera: Camera) -> tuple[NDArray[np.float32], Camera]:
    width, height = (max(_LEAST_SIDE, round(side / 2)) for side in (camera.width, camera.height))
    small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.float32), camera.resized(width, height)


def _search(
    images: Sequence[tuple[NDArray[np.float32], Camera]], sweeps: Sequence[_Sweep],
    on_photo: Callable[[], None],
) -> list[NDArray[np.float32]]:
    """Returns the inverse depths [H, W] of least cost in any sweep, 0 where there are none."""
    sizes = [image.size for image, _ in images]
    starts = np.concatenate([[0], np.cumsum(sizes)])
    inverse, least = np.zeros(starts[-1], np.float32), np.full(starts[-1], np.inf, np.float32)
    flat = np.concatenate([image.reshape(-1) for image, _ in images])
    cameras = np.stack([camera_row(camera) for _, camera in images])
    for sweep in sweeps:
        arguments = (
            flat, starts[:-1], cameras, np.ascontiguousarray(sweep.partners), sweep.radius,
            sweep.normal,
            np.concatenate([part.reshape(-1) for part in sweep.base]), sweep.lowest, sweep.steps,
            sweep.hypotheses, inverse, least)
        for first in range(0, len(images), pool.size):
            rows = np.arange(first, min(first + pool.size, len(images)))
            pool.run(match, rows, *arguments, scratch=False)
            for _ in rows:
                on_photo()
    return [inverse[start:start + size].reshape(image.shape)
            for start, size, (image, _) in zip(starts, sizes, images, strict=False)]


def _enlarged(inverse: NDArray[np.float32], shape: tuple[int, int]) -> NDArray[np.float32]:
    """Returns inverse depths in another size; edges stay sharp."""
    size = shape[1], shape[0]
    nearest, linear = (cv2.resize(inverse, size, interpolation=way)
                       for way in (cv2.INTER_NEAREST, cv2.INTER_LINEAR))
    return np.asarray(np.where(np.abs(linear - nearest) < EDGE * nearest, linear, nearest))


def _laid_on_planes(
    images: Sequence[tuple[NDArray[np.float32], Camera]], inverse: Sequence[NDArray[np.float32]],
    partners: NDArray[np.int64], near: float, steps: NDArray[np.float64],
) -> list[NDArray[np.float32]]:
    """Returns inverse depths [H, W] that lie on planes where the images are blank.

    Matching goes by steps there, and by noise: the second search would only follow them.
    """
    confirmed = _confirmed(
        [_depth(one) for one in inverse], [camera for _, camera in images], partners, near)
    plane_depth = [np.zeros_like(one) for one in inverse]
    for (image, _), found, certain, step, result in zip(
            images, inverse, confirmed, steps, plane_depth, strict=True):
        pool.run(lay_planes, found, image, certain, _blankness(image), float(step), result,
                 scratch=False)
    return plane_depth


def _blankness(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Returns 1 where windows about a pixel have one brightness, 0 where they have texture."""
    mean, square = (cv2.blur(one, (_WINDOW, _WINDOW)) for one in (image, image * image))
    return np.asarray(np.exp(-np.maximum(square - mean * mean, 0) / _TEXTURE**2), np.float32)


def _depth(inverse: NDArray[np.float32]) -> NDArray[np.float32]:
    """Returns depths, 0 where there is none."""
    return np.where(inverse > 0, 1 / np.maximum(inverse, 1e-12), 0).astype(np.float32)


def _confirmed(
    depths: Sequence[NDArray[np.float32]], cameras: Sequence[Camera],
    partners: NDArray[np.int64], near: float,
) -> list[NDArray[np.bool_]]:
    """Returns where another view agrees with each depth map."""
    flat = np.concatenate([depth.reshape(-1) for depth in depths])
    starts = np.concatenate([[0], np.cumsum([depth.size for depth in depths])])[:-1]
    table = np.stack([camera_row(camera) for camera in cameras])
    confirmed = []
    for own, depth in enumerate(depths):
        agree, through = np.zeros((2, depth.size), np.int32)
        others = partners[own][partners[own] >= 0]
        pool.run(compare, flat, starts, table, own, others, TOLERANCE, near, agree, through,
                 scratch=False)
        confirmed.append(agree.reshape(depth.shape) > 0)
    return confirmed
