"""Pinhole views into the images of a camera: one, the faces of a cube, or those of a wide lens.

An undistorted picture without blank corners leaves out more than half of what a fisheye of 155
degrees sees, and its edges are magnified. So where it would lose much, a grid of faces shows the
whole frame, each as fine as the middle of the frame and no larger than what it shows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.io.colmap_library import pycolmap
from recon_cli.scene.camera import Camera
from recon_cli.scene.faces import Face, grid_faces, nearest_face, pixel_rays
from recon_cli.scene.train_view import BORDER
from recon_cli.sfm.features.face_images import PICTURES, cube_warps, cut_face
from recon_cli.sfm.features.sphere import is_panorama, unit_rays

# Share of a frame that one undistorted picture may lose; of more, faces are made.
MOST_LOST = 0.1
# Of a mask, where less of a face is left, as of the floor below a tripod, there is no view.
LEAST_COUNTING = 0.05
MOST_ASIDE_DEG = 50.0  # from the axis of a face to its side
MARGIN = 2 * BORDER  # pixels of a face around its own part of the frame
MOST_FACES = 9
_SAMPLES = 96  # pixels of a frame, along each side, by which faces are laid out
# A ray that does not come back to its pixel lies where the lens model is not one to one, radians;
# COLMAP's fisheyes end at a right angle.
_OFF, _LEAST_DEPTH = 1e-3, 0.02

Cut = Callable[[NDArray[np.uint8]], NDArray[np.uint8]]
Places = NDArray[np.float32]  # [H, W, 2], pixels of a frame for OpenCV: 0, 0 is the first's middle


@dataclass(frozen=True, eq=False)
class FlatView:
    """A pinhole view into the images of a camera."""

    face: Face | None  # of those that show a frame; None where the view has no blank corners
    camera: pycolmap.Camera
    rotation: NDArray[np.float64]  # [3, 3] from the axes of the camera
    cut: Cut  # its picture from that of the frame
    own: NDArray[np.bool_]  # [H, W], the pixels that no other view of the frame is nearer to
    inside: NDArray[np.bool_] | None = None  # [H, W], those that the frame shows; None for all
    cut_linear: Cut | None = None  # by bilinear pixels, for masks; None where `cut` does so

    def cut_mask(self, mask: NDArray[np.uint8] | None) -> NDArray[np.uint8] | None:
        """Returns its mask from that of the frame, [H, W]: 255 where pixels count; None for all."""
        if mask is None:
            return None if self.inside is None else self.inside * np.uint8(255)
        counts = (self.cut_linear or self.cut)(mask) >= 128
        return np.where(counts if self.inside is None else counts & self.inside,
                        np.uint8(255), np.uint8(0))

    def shows(self, mask: NDArray[np.uint8] | None) -> bool:  # [H, W], as `cut_mask`
        """Returns whether a mask leaves enough for a view."""
        if mask is None or self.face is None:
            return True
        left = np.count_nonzero(mask[self.own])
        return bool(left >= LEAST_COUNTING * np.count_nonzero(self.own))


def find_views(
    camera: pycolmap.Camera,
    counting: Callable[[], NDArray[np.bool_] | None] = lambda: None,
) -> list[FlatView]:
    """Returns the views into the images of a camera; they have its id.

    `counting` returns the pixels [H, W] of its frames that some mask leaves, None for all: what
    none leaves, as the border around a round picture, need not be shown.
    """
    if is_panorama(camera):
        return _cube_views(camera)
    flat, warp = flatten(camera)
    if 1 - covered_share(warp, camera.width, camera.height) > MOST_LOST and (
            faces := _wide_views(camera, counting())):
        return faces
    own = np.ones((flat.height, flat.width), np.bool_)
    return [FlatView(None, flat, np.eye(3), partial(resample, places=warp), own)]


def has_faces(camera: pycolmap.Camera) -> bool:
    """Returns whether the views into the images of a camera are faces."""
    return is_panorama(camera) or find_views(camera)[0].face is not None


def flatten(camera: pycolmap.Camera) -> tuple[pycolmap.Camera, Places]:
    """Returns the camera of the one undistorted picture, and where its pixels lie in a frame."""
    flat = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
    flat.camera_id = camera.camera_id
    return flat, places_in(camera, flat)


def places_in(camera: pycolmap.Camera, flat: pycolmap.Camera) -> Places:
    """Returns where the pixels of an undistorted picture lie in a frame."""
    x, y = np.meshgrid(np.arange(flat.width) + 0.5, np.arange(flat.height) + 0.5)
    rays = np.asarray(flat.cam_from_img(np.stack([x.ravel(), y.ravel()], axis=1)))
    places = np.asarray(camera.img_from_cam(np.column_stack([rays, np.ones(len(rays))])))
    return (places - 0.5).reshape(flat.height, flat.width, 2).astype(np.float32)


def covered_share(places: Places, width: int, height: int) -> float:
    """Returns the share of a frame that an undistorted picture shows, by where its pixels lie."""
    border = np.concatenate([places[0], places[:, -1], places[-1, ::-1], places[::-1, 0]])
    # through the middles of the outer pixels, half a pixel inside
    return float(cv2.contourArea(border)) / ((width - 1) * (height - 1))


def resample(image: NDArray[np.uint8], places: Places) -> NDArray[np.uint8]:
    """Returns the picture of the pixels at `places`; what lies outside repeats the edge."""
    return np.asarray(cv2.remap(
        image, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8)


def _cube_views(camera: pycolmap.Camera) -> list[FlatView]:
    views = []
    for face, warp in cube_warps(camera.width, camera.height):
        flat = pycolmap.Camera(
            camera_id=camera.camera_id, model="PINHOLE", width=warp.side, height=warp.side,
            params=(warp.focal, warp.focal, warp.side / 2, warp.side / 2))
        views.append(FlatView(
            face, flat, face.rotation, partial(cut_face, warp=warp, interpolation=PICTURES),
            warp.own.astype(np.bool_), cut_linear=partial(cut_face, warp=warp)))
    return views


def _wide_views(
    camera: pycolmap.Camera, counting: NDArray[np.bool_] | None
) -> list[FlatView]:
    """Returns the faces of a wide lens, the fewest that show all; none where no grid does."""
    rays = _seen_rays(camera, counting)
    if not len(rays):
        return []
    x, y, z = rays.T
    across, upward = (_span(angles) for angles in (
        np.arctan2(x, z), np.arctan2(-y, np.hypot(x, z))))
    for columns, rows in _grids():
        faces = grid_faces(across, upward, columns, rows)
        nearest = nearest_face(rays, [face.rotation for face in faces])
        bounds = [_bounds(rays[nearest == place] @ face.rotation.T)
                  for place, face in enumerate(faces)]
        if all(each is not None for each in bounds):
            return [_wide_view(camera, faces, place, each)
                    for place, each in enumerate(bounds) if each is not None and len(each)]
    return []


def _span(radians: NDArray[np.float64]) -> tuple[float, float]:
    """Returns the least and the greatest angle, degrees."""
    return float(np.degrees(radians.min())), float(np.degrees(radians.max()))


def _grids() -> Iterator[tuple[int, int]]:
    """Yields columns and rows, the fewest faces first, and of those the wider grid."""
    sizes = [(columns, rows) for columns in range(1, 5) for rows in range(1, 5)]
    yield from sorted(((columns, rows) for columns, rows in sizes
                       if columns * rows <= MOST_FACES),
                      key=lambda size: (size[0] * size[1], -size[0]))


def _seen_rays(
    camera: pycolmap.Camera, counting: NDArray[np.bool_] | None
) -> NDArray[np.float64]:  # [K, 3]
    """Returns unit vectors through pixels of a frame that count, to its very edges."""
    shares = np.linspace(0, 1, _SAMPLES)
    across, down = np.meshgrid(shares * camera.width, shares * camera.height)
    pixels = np.stack([across.ravel(), down.ravel()], axis=1)
    if counting is not None:
        x, y = np.minimum(pixels.astype(int), [camera.width - 1, camera.height - 1]).T
        pixels = pixels[counting[y, x]]
    rays = unit_rays(camera, pixels)
    ahead = np.isfinite(rays).all(axis=1) & (rays[:, 2] > _LEAST_DEPTH)
    back = np.full_like(pixels, np.inf)
    back[ahead] = camera.img_from_cam(rays[ahead])
    off = np.linalg.norm(back - pixels, axis=1)
    return np.asarray(rays[off < _OFF * camera.mean_focal_length()])


def _bounds(rays: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Returns the corners [2, 2] around rays on the plane of a face; None where it is too wide.

    Empty where it has none.
    """
    if not len(rays):
        return np.zeros((0, 2))
    if rays[:, 2].min() <= 0:
        return None
    plane = rays[:, :2] / rays[:, 2:]
    if np.abs(plane).max() > np.tan(np.radians(MOST_ASIDE_DEG)):
        return None
    return np.array([plane.min(axis=0), plane.max(axis=0)])


def _wide_view(
    camera: pycolmap.Camera, faces: tuple[Face, ...], place: int, bounds: NDArray[np.float64]
) -> FlatView:
    """Returns the view of a face, which reaches `bounds` on its plane and a margin more."""
    focal, face = camera.mean_focal_length(), faces[place]
    left, top = (np.floor(bounds[0] * focal) - MARGIN).tolist()
    right, bottom = (np.ceil(bounds[1] * focal) + MARGIN).tolist()
    width, height = round(right - left), round(bottom - top)
    flat = pycolmap.Camera(
        camera_id=camera.camera_id, model="PINHOLE", width=width, height=height,
        params=(focal, focal, -left, -top))
    rays = pixel_rays(
        Camera(width, height, focal, focal, -left, -top, np.eye(4))) @ face.rotation
    places = _project(camera, rays)
    inside = np.asarray(((places > 0) & (places < [camera.width, camera.height])).all(axis=2))
    warp = (np.where(inside[..., None], places, -1e4) - 0.5).astype(np.float32)
    near = cv2.dilate(inside.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    # the edge continues a little, so that a window of pixels at it is not torn
    warp[near] = (places[near] - 0.5).astype(np.float32)
    own = inside & (nearest_face(rays, [each.rotation for each in faces]) == place)
    return FlatView(
        face, flat, face.rotation, partial(resample, places=np.nan_to_num(warp, nan=-1e4)), own,
        None if inside.all() else inside)


def _project(camera: pycolmap.Camera, rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the pixels [..., 2] of rays [..., 3]; NaN where the lens model has none."""
    flat = rays.reshape(-1, 3)
    unit = flat / np.linalg.norm(flat, axis=1, keepdims=True)
    pixels = np.full((len(flat), 2), np.nan)
    ahead = unit[:, 2] > _LEAST_DEPTH
    pixels[ahead] = camera.img_from_cam(flat[ahead])
    known = np.isfinite(pixels).all(axis=1)
    back = np.full_like(flat, np.nan)
    back[known] = unit_rays(camera, pixels[known])
    with np.errstate(invalid="ignore"):
        pixels[~(np.linalg.norm(back - unit, axis=1) < _OFF)] = np.nan
    return pixels.reshape(*rays.shape[:-1], 2)
