"""Dense stereo: depth from the images themselves, beside that of the Gaussians.

Training fits colours. Where a wall has little texture, Gaussians at many depths give the same
images, and the depth of their surface is wrong by decimetres. Images of neighbours still differ
there by their shading: summed over windows and made smooth along paths of pixels, that tells the
depth (`stereo_kernels.match`). A pixel counts where another view finds the same surface.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.export.mesh.depth_maps import DepthMaps, camera_row, weigh
from recon_cli.export.mesh.kernels import compare
from recon_cli.export.mesh.stereo_kernels import match
from recon_cli.export.mesh.volume import pixel_rays
from recon_cli.progress import Progress
from recon_cli.render.numba.thread_pool import pool
from recon_cli.scene.camera import Camera
from recon_cli.scene.covisibility import observe_points
from recon_cli.scene.train_view import TrainView
from recon_cli.train.task import reduce_view

_SIDE = 600  # pixels of the longer side at most
_MOST_VIEWS = 150  # that get a depth map, evenly spread; 1.6 CPU seconds each
_LEAST_SIDE = 8  # pixels of any side; windows have 5
_NEIGHBOURS = 20  # views that each is compared with; more of them find more of blank walls
# Weight of a neighbour: the points seen by both, each by the angle between the rays to it. Below
# the best angle depth is uncertain, far beyond it surfaces look different.
_ANGLE, _NARROWER, _WIDER = 5.0, 1.5, 8.0  # degrees: the best, and standard deviations
_LEAST_ANGLE = 1.0  # degrees; below it all depths look alike
_SAMPLES = 3000  # points looked at
_LEAST_SHARED = 20  # of them
# The first search, at half the size: inverse depths evenly spread, over more than the surface spans
_HYPOTHESES, _RADIUS = 64, 1
_TAIL, _NEARER, _FARTHER = 0.01, 0.7, 1.4
# The second one, about what the first found: a window then follows slanted surfaces.
_REFINED, _FINER, _REFINED_RADIUS = 9, 4, 2
_EDGE = 0.03  # of an inverse depth; larger steps between pixels are edges of things
_TOLERANCE = 0.015  # of a depth, within which another view confirms it
_AGREE = 1  # views
_RENDERED = 0.3  # weight of the Gaussians' depth, that of stereo being 1


def with_stereo(
    maps: DepthMaps, box: tuple[NDArray[np.float64], NDArray[np.float64]],
    progress: Progress,
) -> DepthMaps:
    """Returns the depth maps and, after them, those of up to 150 of the views by stereo.

    Args:
        maps: of the Gaussians' surface. They say where to search, count less, and not at all in
            pixels where stereo finds another depth.
        box: least and greatest corner [3] of the scene; what lies outside was cut off.
    """
    rows = np.unique(np.linspace(
        0, len(maps.views) - 1, min(len(maps.views), _MOST_VIEWS)).round().astype(int))
    views = [_reduced(maps.views[row]) for row in rows]
    searched = DepthMaps([maps.views[row] for row in rows], [maps.cameras[row] for row in rows],
                         [maps.depths[row] for row in rows], [], maps.median)
    with progress.bar("stereo", 2 * len(views), unit="view") as bar:
        depths = stereo_depths(searched, views, bar.advance)
    rendered, weights = list(maps.depths), [_RENDERED * gain for gain in maps.gains]
    used = []
    for row, view, depth in zip(rows, views, depths, strict=True):
        camera = view.camera
        places = camera.center + pixel_rays(camera) @ camera.viewmat[:3, :3] * depth[..., None]
        there = (depth > maps.near) & (places >= box[0]).all(-1) & (places <= box[1]).all(-1)
        if view.mask is not None:
            there &= view.mask
        depth[~there] = 0
        used.append(there.astype(np.float32))
        own = rendered[row]
        full = cv2.resize(depth, own.shape[::-1], interpolation=cv2.INTER_NEAREST)
        differs = (full > 0) & (np.abs(own - full) > _TOLERANCE * full)
        rendered[row] = np.where(differs, 0, own).astype(np.float32)
        weights[row] = np.where(differs, 0, weights[row]).astype(np.float32)
    found = weigh(views, [view.camera for view in views], depths, used)
    return DepthMaps(
        [*maps.views, *views], [*maps.cameras, *found.cameras], [*rendered, *found.depths],
        [*weights, *found.gains], maps.median)


def _reduced(view: TrainView) -> TrainView:
    """Returns a view of at most 600 pixels."""
    return reduce_view(view, max(1.0, max(view.camera.width, view.camera.height) / _SIDE))


def stereo_depths(
    maps: DepthMaps, views: Sequence[TrainView], on_view: Callable[[], None] = lambda: None
) -> list[NDArray[np.float32]]:
    """Returns a depth map [H, W] in world units of each view, 0 where there is none.

    How far and how near is searched, and which views see the same, follows from the depths of
    `maps`, which may be larger than the views.
    """
    full = [(_grey(view), view.camera) for view in views]
    half = [_halved(*image) for image in full]
    others = find_partners(maps)
    ranges = np.stack([_inverse_range(depth, maps) for depth in maps.depths])
    steps = (ranges[:, 1] - ranges[:, 0]) / (_HYPOTHESES - 1)
    lowest = [np.full(image.shape, low, np.float32)
              for (image, _), low in zip(half, ranges[:, 0], strict=True)]
    coarse = _search(half, others, lowest, steps, _HYPOTHESES, _RADIUS, on_view)
    fine = steps / _FINER
    priors = [_enlarged(_smoothed(found), image.shape)
              for (image, _), found in zip(full, coarse, strict=True)]
    lowest = [(prior - step * (_REFINED // 2)).astype(np.float32)
              for prior, step in zip(priors, fine, strict=True)]
    refined = _search(full, others, lowest, fine, _REFINED, _REFINED_RADIUS, on_view)
    depths = [np.where((prior > 0) & (inverse > 0), 1 / np.maximum(inverse, 1e-12), 0).astype(
        np.float32) for prior, inverse in zip(priors, refined, strict=True)]
    return _confirmed(depths, [camera for _, camera in full], others, maps.near)


def _grey(view: TrainView) -> NDArray[np.float32]:
    grey = cv2.cvtColor(np.ascontiguousarray(view.image), cv2.COLOR_RGB2GRAY)
    return np.asarray(grey, np.float32)


def _halved(image: NDArray[np.float32], camera: Camera) -> tuple[NDArray[np.float32], Camera]:
    width, height = (max(_LEAST_SIDE, round(side / 2)) for side in (camera.width, camera.height))
    small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.float32), camera.resized(width, height)


def _inverse_range(depth: NDArray[np.float32], maps: DepthMaps) -> NDArray[np.float64]:
    """Returns the least and greatest inverse depth that is searched in a view."""
    some = depth[depth > 0]
    if len(some) < _LEAST_SHARED:
        some = np.concatenate([other[::8, ::8][other[::8, ::8] > 0] for other in maps.depths])
    near, far = np.quantile(some, [_TAIL, 1 - _TAIL])
    return 1 / np.array([_FARTHER * far, max(_NEARER * near, maps.near)])


def _search(
    images: Sequence[tuple[NDArray[np.float32], Camera]], others: NDArray[np.int64],
    lowest: Sequence[NDArray[np.float32]], steps: NDArray[np.float64], hypotheses: int, radius: int,
    on_view: Callable[[], None],
) -> list[NDArray[np.float32]]:
    """Returns the inverse depths [H, W] that `match` finds, 0 where it finds none."""
    sizes = [image.size for image, _ in images]
    starts = np.concatenate([[0], np.cumsum(sizes)])
    inverse = np.zeros(starts[-1], np.float32)
    arguments = (
        np.concatenate([image.reshape(-1) for image, _ in images]), starts[:-1],
        np.stack([camera_row(camera) for _, camera in images]), others, radius,
        np.concatenate([part.reshape(-1) for part in lowest]), steps, hypotheses, inverse)
    for first in range(0, len(images), pool.size):
        rows = np.arange(first, min(first + pool.size, len(images)))
        pool.run(match, rows, *arguments, scratch=False)
        for _ in rows:
            on_view()
    return [inverse[start:start + size].reshape(image.shape)
            for start, size, (image, _) in zip(starts, sizes, images, strict=False)]


def _smoothed(inverse: NDArray[np.float32]) -> NDArray[np.float32]:
    """Returns inverse depths without the bumps of walls, which the second search would keep."""
    return np.asarray(cv2.medianBlur(cv2.medianBlur(np.ascontiguousarray(inverse), 5), 5))


def _enlarged(inverse: NDArray[np.float32], shape: tuple[int, int]) -> NDArray[np.float32]:
    """Returns inverse depths in another size; edges stay sharp."""
    size = shape[1], shape[0]
    nearest, linear = (cv2.resize(inverse, size, interpolation=way)
                       for way in (cv2.INTER_NEAREST, cv2.INTER_LINEAR))
    return np.asarray(np.where(np.abs(linear - nearest) < _EDGE * nearest, linear, nearest))


def surface_points(
    cameras: Sequence[Camera], depths: Sequence[NDArray[np.float32]], count: int
) -> NDArray[np.float64]:
    """Returns up to `count` places of each depth map, evenly spread, [P, 3] in world units."""
    places = [np.empty((0, 3))]
    for camera, depth in zip(cameras, depths, strict=True):
        at = np.flatnonzero(depth > 0)
        at = at[np.linspace(0, len(at) - 1, min(count, len(at))).astype(int)]
        line, column = np.divmod(at, depth.shape[1])
        rays = np.stack([(column + 0.5 - camera.cx) / camera.fx,
                         (line + 0.5 - camera.cy) / camera.fy, np.ones(len(at))], axis=1)
        local = rays * depth.reshape(-1)[at, None] - camera.viewmat[:3, 3]
        places.append(local @ camera.viewmat[:3, :3])
    return np.concatenate(places)


def find_partners(maps: DepthMaps) -> NDArray[np.int64]:
    """Returns the views [V, 20] that each view is compared with, best first, -1 for none."""
    cameras = maps.cameras
    points = surface_points(cameras, maps.depths, max(1, _SAMPLES // len(cameras)))
    seen = observe_points(points, cameras).matrix.toarray() > 0
    rays = points - np.stack([camera.center for camera in cameras])[:, None]
    rays /= np.maximum(np.linalg.norm(rays, axis=2, keepdims=True), 1e-12)
    partners = np.full((len(cameras), _NEIGHBOURS), -1, np.int64)
    for own in range(len(cameras)):
        mine = np.flatnonzero(seen[own])
        angles = np.degrees(np.arccos(np.clip((rays[:, mine] * rays[own, mine]).sum(2), -1, 1)))
        spread = np.where(angles < _ANGLE, _NARROWER, _WIDER)
        both = seen[:, mine] & (angles >= _LEAST_ANGLE)
        worth = (both * np.exp(-0.5 * ((angles - _ANGLE) / spread) ** 2)).sum(axis=1)
        worth[both.sum(axis=1) < _LEAST_SHARED] = 0
        worth[own] = 0
        best = np.argsort(-worth, kind="stable")[:_NEIGHBOURS]
        best = best[worth[best] > 0]
        partners[own, :len(best)] = best
    return partners


def _confirmed(
    depths: Sequence[NDArray[np.float32]], cameras: Sequence[Camera], others: NDArray[np.int64],
    near: float,
) -> list[NDArray[np.float32]]:
    """Returns the depths without those that no other view agrees with."""
    flat = np.concatenate([depth.reshape(-1) for depth in depths])
    starts = np.concatenate([[0], np.cumsum([depth.size for depth in depths])])[:-1]
    table = np.stack([camera_row(camera) for camera in cameras])
    kept = []
    for own, depth in enumerate(depths):
        agree, through = np.zeros((2, depth.size), np.int32)
        pool.run(compare, flat, starts, table, own, others[own][others[own] >= 0], _TOLERANCE, near,
                 agree, through, scratch=False)
        kept.append(np.where(agree.reshape(depth.shape) >= _AGREE, depth, 0).astype(np.float32))
    return kept
