"""Depth by dense stereo in the depth maps of a mesh, beside that of the Gaussians."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.io.depth_maps import LEAST_POINTS
from recon_cli.io.images import reduce_view
from recon_cli.progress import Progress
from recon_cli.room.depth_maps import DepthMaps, weigh
from recon_cli.scene.camera import Camera
from recon_cli.scene.covisibility import observe_points
from recon_cli.scene.faces import pixel_rays
from recon_cli.scene.gravity import find_gravity
from recon_cli.stereo.depths import (
    TOLERANCE,
    Levels,
    StereoView,
    find_depths,
    find_partners,
    spanned,
    unproject,
)

_SIDE = 600  # pixels of the longer side at most
_MOST_VIEWS = 150  # that get a depth map, evenly spread; about 2 CPU seconds each
_NEIGHBOURS = 20  # views that each is compared with; more of them find more of blank walls
_SAMPLES = 3000  # points looked at to find them
_RENDERED = 0.3  # weight of the Gaussians' depth, that of stereo being 1


def with_stereo(
    maps: DepthMaps, box: tuple[NDArray[np.float64], NDArray[np.float64]],
    progress: Progress,
) -> DepthMaps:
    """Returns the depth maps and, after them, those of up to 150 of the views by stereo.

    Args:
        maps: of the Gaussians' surface. They say where to search, count less, and not at all in
            pixels where stereo finds another depth.
        box: least and greatest corner [3] of the scene; everything outside was cut off.
    """
    rows = np.unique(np.linspace(
        0, len(maps.views) - 1, min(len(maps.views), _MOST_VIEWS)).round().astype(int))
    cameras, depths = [maps.cameras[row] for row in rows], [maps.depths[row] for row in rows]
    photos = _photos(DepthMaps([maps.views[row] for row in rows], cameras, depths, [], maps.median))
    points = surface_points(cameras, depths, max(1, _SAMPLES // len(rows)))
    seen = observe_points(points, cameras).matrix.toarray() > 0
    partners = find_partners(cameras, points, seen, _NEIGHBOURS)
    up = find_gravity(points, np.stack([camera.viewmat for camera in cameras])).up
    levels = None if up is None else Levels(up, maps.median)
    with progress.bar("stereo", (3 if levels else 2) * len(photos), unit="view") as bar:
        found = find_depths(photos, partners, maps.near, bar.advance, levels=levels)
    views = [photo.view for photo in photos]
    rendered, weights = list(maps.depths), [_RENDERED * gain for gain in maps.gains]
    used = []
    for row, view, depth in zip(rows, views, found, strict=True):
        camera = view.camera
        where = camera.center + pixel_rays(camera) @ camera.viewmat[:3, :3] * depth[..., None]
        there = (depth > maps.near) & (where >= box[0]).all(-1) & (where <= box[1]).all(-1)
        depth[~there] = 0
        used.append(there.astype(np.float32))
        own = rendered[row]
        full = cv2.resize(depth, own.shape[::-1], interpolation=cv2.INTER_NEAREST)
        differs = (full > 0) & (np.abs(own - full) > TOLERANCE * full)
        rendered[row] = np.where(differs, 0, own).astype(np.float32)
        weights[row] = np.where(differs, 0, weights[row]).astype(np.float32)
    added = weigh(views, [view.camera for view in views], found, used)
    return DepthMaps(
        [*maps.views, *views], [*maps.cameras, *added.cameras], [*rendered, *added.depths],
        [*weights, *added.gains], maps.median)


def _photos(maps: DepthMaps) -> list[StereoView]:
    """Returns the views at 600 pixels at most, to be searched about the depths of `maps`."""
    photos = []
    for view, depth in zip(maps.views, maps.depths, strict=True):
        some = depth[depth > 0]
        if len(some) < LEAST_POINTS:
            some = np.concatenate([other[::8, ::8][other[::8, ::8] > 0] for other in maps.depths])
        longest = max(view.camera.width, view.camera.height)
        photos.append(StereoView(reduce_view(view, max(1.0, longest / _SIDE)), *spanned(some)))
    return photos


def surface_points(
    cameras: Sequence[Camera], depths: Sequence[NDArray[np.float32]], count: int
) -> NDArray[np.float64]:
    """Returns up to `count` places of each depth map, evenly spread, [P, 3] in world units."""
    found = [np.empty((0, 3))]
    for camera, depth in zip(cameras, depths, strict=True):
        at = np.flatnonzero(depth > 0)
        at = at[np.linspace(0, len(at) - 1, min(count, len(at))).astype(int)]
        found.append(unproject(camera, depth, at))
    return np.concatenate(found)
