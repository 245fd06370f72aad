"""Which views of a model should see the same, by its points and cameras."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from recon_cli.io.colmap_library import pycolmap
from recon_cli.sfm.model_arrays import Pair, registered_images

# Pairs that the skeleton shows to overlap, per image, spread over the WIDEST from most to least
# overlap: the closest tell little about depth. Errors of the cameras of two rooms with 10, 8 and 6
# of them, in cm: .17 and .09, .17 and .10, .20 and .10.
OVERLAPPING, WIDEST = 8, 60
# Two views overlap as far as a point of one lies in the other, at a like angle and distance.
MAX_VIEW_ANGLE_DEG, MAX_DISTANCE_RATIO, MIN_VIEW_OVERLAP = 30.0, 2.0, 0.2
SAMPLED_POINTS = 150  # points per image


def overlapping_pairs(model: pycolmap.Reconstruction, most: int = OVERLAPPING) -> set[Pair]:
    """Returns each image of a model with `most` ones whose views have something in common."""
    images = registered_images(model)
    return overlapping_images(images, [model] * len(images), most=most)


def overlapping_images(
    images: Sequence[pycolmap.Image],
    models: Sequence[pycolmap.Reconstruction],  # that hold the points of each image
    held: Mapping[str, Collection[int]] | None = None,
    *, most: int = OVERLAPPING, besides: Collection[Pair] = (),
) -> set[Pair]:
    """Returns each image with `most` whose views have something in common, fewer by known pairs.

    Where `held` names the segments that hold each image, only pairs of different ones. Pairs in
    `besides` are known, by names in order; they are not returned.
    """
    order = sorted(range(len(images)), key=lambda index: images[index].name)
    images = [images[index] for index in order]
    share = _overlap(images, [
        _sample_points(image, models[index]) for image, index in zip(images, order, strict=True)])
    mutual = np.minimum(share, share.T)
    names, pairs = [image.name for image in images], set()
    for row, shares in enumerate(mutual):
        others = [other for other in np.argsort(-shares, kind="stable").tolist()
                  if shares[other] > MIN_VIEW_OVERLAP and (
                      held is None or set(held[names[row]]).isdisjoint(held[names[other]]))]
        both = [(names[min(row, other)], names[max(row, other)]) for other in others]
        new = [pair for pair in both if pair not in besides]
        count = min(max(0, most - (len(both) - len(new))), len(new[:WIDEST]))
        for place in np.linspace(0, max(len(new[:WIDEST]) - 1, 0), count):
            pairs.add(new[round(place)])
    return pairs


def _sample_points(
    image: pycolmap.Image, model: pycolmap.Reconstruction
) -> NDArray[np.float64]:  # [S, 3]
    spots = image.get_observation_points2D()
    step = max(1, len(spots) // SAMPLED_POINTS)
    return np.array([model.point3D(spot.point3D_id).xyz for spot in spots[::step]]).reshape(-1, 3)


def _overlap(
    images: Sequence[pycolmap.Image], seen: Sequence[NDArray[np.float64]]  # [S, 3] each
) -> NDArray[np.float64]:  # [N, N]
    """Returns the share of the points of each image that another one should show, too."""
    owner = np.repeat(np.arange(len(images)), [len(points) for points in seen])
    points = np.concatenate([np.zeros((0, 3)), *seen])
    centers = np.array([image.projection_center() for image in images]).reshape(-1, 3)
    rays = points - centers[owner]
    near = np.linalg.norm(rays, axis=1)
    share = np.zeros((len(images), len(images)))
    for column, image in enumerate(images):
        camera = image.camera
        local = np.asarray(image.cam_from_world() * points)
        bounds = np.array([camera.width / camera.focal_length_x,
                           camera.height / camera.focal_length_y]) / 2
        inside = (local[:, 2] > 0) & (np.abs(local[:, :2]) < bounds * local[:, 2:]).all(axis=1)
        rows = np.flatnonzero(inside)  # few of many: a walk leaves most behind
        others = points[rows] - centers[column]
        far = np.linalg.norm(others, axis=1)
        cosines = (rays[rows] * others).sum(axis=1)
        alike = (cosines > np.cos(np.radians(MAX_VIEW_ANGLE_DEG)) * near[rows] * far) & (
            near[rows] < MAX_DISTANCE_RATIO * far) & (far < MAX_DISTANCE_RATIO * near[rows])
        share[:, column] = np.bincount(owner[rows[alike]], minlength=len(images))
    np.fill_diagonal(share, 0)
    return np.asarray(share / np.maximum(np.bincount(owner, minlength=len(images)), 1)[:, None])
