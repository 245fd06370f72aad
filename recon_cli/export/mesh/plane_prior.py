"""Pulls the depth of walls without texture onto their planes.

Where the pictures say nothing, Gaussians lie anywhere within some centimetres of a wall. A plane
that the surface shows and triangulated points confirm says more. The pull ends where a picture has
texture, and for what stands further off the plane than its surface scatters.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.export.mesh.depth_maps import DepthMaps
from recon_cli.export.mesh.volume import extract, fuse, pixel_rays
from recon_cli.scene.planes import Plane, confirm_all, find_planes

_COARSE = 2.0  # voxels; a side of those that planes are looked for in
_TEXTURE = 4.0  # mean gradient in gray levels a pixel at which the pull has fallen to 1/e
_WINDOW = 11  # pixels around, over which texture is looked for
_GATE = 3.0  # spreads of the surface about the plane, beyond which nothing is pulled
_LEAST_SPREAD = 0.3  # bands
_LEAST_COSINE = 0.08  # between ray and plane


def surface_planes(
    maps: DepthMaps, voxel: float, farthest: float, points: NDArray[np.float64]
) -> list[tuple[Plane, Plane | None]]:
    """Returns the large planes of the surface, each with what triangulated points make of it."""
    band = _COARSE * voxel
    vertices, faces = extract(fuse(maps, band, farthest))
    centers, normals, areas = face_geometry(vertices, faces)
    planes = find_planes(centers, normals, areas, band)
    return list(zip(planes, confirm_all(planes, centers, points, band), strict=True))


def pull_onto_planes(
    maps: DepthMaps, planes: list[tuple[Plane, Plane | None]], voxel: float
) -> None:
    """Moves the depths near planes that points confirm."""
    known = [(plane, confirmed) for plane, confirmed in planes if confirmed is not None]
    for number, (view, camera, depth) in enumerate(
            zip(maps.views, maps.cameras, maps.depths, strict=True) if known else ()):
        texture = _texture(view.image)
        rays = pixel_rays(camera) @ camera.viewmat[:3, :3]
        places = camera.center + rays * depth[..., None]
        steepness = np.linalg.norm(rays, axis=-1)
        moved, nearest = depth.astype(np.float64), np.full(depth.shape, np.inf)
        for plane, confirmed in known:
            height = np.abs(places @ plane.normal - plane.offset)
            gate = _GATE * max(plane.spread, _LEAST_SPREAD * _COARSE * voxel)
            cosine = rays @ confirmed.normal
            pulled = (depth > 0) & (height < np.minimum(gate, nearest)) & (
                -cosine > _LEAST_COSINE * steepness)
            target = (confirmed.offset - camera.center @ confirmed.normal) / np.where(
                pulled, cosine, -1)
            weight = np.exp(-(texture / _TEXTURE) ** 2) * np.clip(3 * (1 - height / gate), 0, 1)
            moved = np.where(pulled, depth + weight * (target - depth), moved)
            nearest = np.where(pulled, height, nearest)
        maps.depths[number] = np.maximum(moved, 0).astype(np.float32)


def face_geometry(
    vertices: NDArray[np.float64], faces: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Returns centres [F, 3], unit normals [F, 3] and areas [F] of the triangles that have one."""
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    there = lengths > 0
    return (corners[there].mean(axis=1), normals[there] / lengths[there, None], lengths[there] / 2)


def _texture(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Returns the mean gradient around each pixel in gray levels a pixel, [H, W]."""
    gray = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY).astype(np.float32)
    across, down = (cv2.Sobel(gray, cv2.CV_32F, *order, scale=0.125) for order in ((1, 0), (0, 1)))
    return np.asarray(cv2.blur(np.hypot(across, down), (_WINDOW, _WINDOW)))
