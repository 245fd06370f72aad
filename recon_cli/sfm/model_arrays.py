"""A COLMAP model as plain arrays, read once: cameras, points, and which images show which points.

Asking pycolmap for the observations one by one takes a second for each million.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from recon_cli.io.colmap_library import pycolmap
from recon_cli.sfm.features.sphere import is_panorama

Pair = tuple[str, str]  # file names of two images, in order


def registered_images(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    """Returns the images of a model that have a camera, as COLMAP lists them."""
    return [model.image(number) for number in model.reg_image_ids()]


def viewmat_of(image: pycolmap.Image) -> NDArray[np.float64]:
    """Returns the pose of an image, world to camera, [4, 4]."""
    return np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])


@dataclass(frozen=True, eq=False)
class ModelArrays:
    """F images with a camera, P points, and O observations, image by image."""

    images: tuple[pycolmap.Image, ...]  # F
    points: NDArray[np.float64]  # [P, 3], in the order of their numbers
    image: NDArray[np.int64]  # [O], ascending
    keypoint: NDArray[np.int64]  # [O], of the image, ascending within it
    point: NDArray[np.int64]  # [O]
    xy: NDArray[np.float64]  # [O, 2] pixels

    @classmethod
    def from_model(
        cls, model: pycolmap.Reconstruction, names: Sequence[str] | None = None
    ) -> ModelArrays:
        """Returns a model with these images, which have a camera; all, by name, without any."""
        images = sorted(registered_images(model), key=lambda image: image.name) if (
            names is None) else [model.find_image_with_name(name) for name in names]
        numbers = np.array(sorted(model.points3D), np.int64)
        points = np.array([model.point3D(number).xyz for number in numbers.tolist()])
        seen = [image.get_observation_points2D() for image in images]
        return cls(
            tuple(images), points.reshape(-1, 3),
            np.repeat(np.arange(len(images)), [len(spots) for spots in seen]),
            np.array([row for image in images for row in image.get_observation_point2D_idxs()],
                     np.int64),
            np.searchsorted(numbers, np.array(
                [spot.point3D_id for spots in seen for spot in spots], np.int64)),
            np.array([spot.xy for spots in seen for spot in spots]).reshape(-1, 2))

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The names of the images, F."""
        return tuple(image.name for image in self.images)

    @cached_property
    def centers(self) -> NDArray[np.float64]:
        """The optical centres, [F, 3]."""
        return np.array([image.projection_center() for image in self.images]).reshape(-1, 3)

    @cached_property
    def viewmats(self) -> NDArray[np.float64]:
        """World to camera, [F, 4, 4]."""
        return np.array([viewmat_of(image) for image in self.images]).reshape(-1, 4, 4)

    def observed(self, row: int) -> slice:
        """Returns where the observations of an image stand."""
        return slice(*np.searchsorted(self.image, [row, row + 1]).tolist())

    def depths(self, row: int) -> NDArray[np.float64]:
        """Returns the depths of the points that an image shows; in a panorama, the distances."""
        image = self.images[row]
        local = np.asarray(
            image.cam_from_world() * self.points[self.point[self.observed(row)]]).reshape(-1, 3)
        return np.asarray(np.linalg.norm(local, axis=1) if is_panorama(image.camera)
                          else local[:, 2])
