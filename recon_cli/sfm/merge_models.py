"""Models that fell apart, put together where the points that both hold say how they lie.

Two models of one capture hold the same keypoints: in images that are in both, and in pairs of
images, one of each, that were verified as showing the same. Where both have a point for such a
keypoint, the two points are one, and the similarity follows from many of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from recon_cli.sfm import mapper
from recon_cli.sfm.checks import MIN_FRAMES
from recon_cli.sfm.job import Job

# COLMAP's own demands on the pose of an image (abs_pose_min_num_inliers, _min_inlier_ratio): a
# model is placed by its points just as an image is.
MIN_INLIERS = 30
MIN_INLIER_SHARE = 0.25
# Distance of two points that are one, as a share of the median distance of a point from a camera.
# A depth is known to the reprojection error (up to 4 px of some 1000 px focal length) over the
# angle between two rays (7 to 23 degrees in real captures): 1 to 3%.
MAX_ERROR = 0.03
MAX_TRIALS = 10_000


@dataclass(frozen=True)
class Shared:
    """Points that two models have in common.

    Attributes:
        source: in the one model, [P, 3].
        target: the same points in the other, [P, 3].
    """

    source: NDArray[np.float64]
    target: NDArray[np.float64]


def added(job: Job, base: pycolmap.Reconstruction, other: pycolmap.Reconstruction
          ) -> pycolmap.Reconstruction | None:
    """Returns `base` with the images of `other`, adjusted together, or None.

    That is None where `other` brings fewer than three further images, or where too few points say
    how the two lie. Whether the result can be trusted is for the caller to judge.
    """
    new = set(mapper.names(other)) - set(mapper.names(base))
    if len(new) < MIN_FRAMES:
        return None
    motion = similarity(shared_points(job.database, other, base), base, seed=job.seed)
    if motion is None:
        return None
    poses = {image.name: image.cam_from_world() for image in _images(base)}
    for image in _images(other):
        if image.name in new:
            poses[image.name] = motion.transform_camera_world(image.cam_from_world())
    joined = mapper.triangulated(job, posed(job.database, base, poses))
    mapper.adjust(joined)
    return mapper.extended(job, joined)


def similarity(
    shared: Shared, base: pycolmap.Reconstruction, *, seed: int
) -> pycolmap.Sim3d | None:
    """Returns the similarity that takes one model into the other, None where too little says so."""
    if len(shared.source) < MIN_INLIERS:
        return None
    options = pycolmap.RANSACOptions()
    options.max_error = MAX_ERROR * _depth(base)
    options.max_num_trials = MAX_TRIALS
    options.random_seed = seed
    found = pycolmap.estimate_sim3d_robust(shared.source, shared.target, options)
    enough = max(MIN_INLIERS, MIN_INLIER_SHARE * len(shared.source))
    if found is None or found["num_inliers"] < enough:
        return None
    motion: pycolmap.Sim3d = found["tgt_from_src"]
    return motion


def shared_points(
    database: Path, source: pycolmap.Reconstruction, target: pycolmap.Reconstruction
) -> Shared:
    """Returns the points of two models that the same or matching keypoints show."""
    ours, theirs = _seen(source), _seen(target)
    same = {
        (ours[name][row], theirs[name][row])
        for name in ours.keys() & theirs.keys() for row in ours[name].keys() & theirs[name].keys()}
    with pycolmap.Database.open(database) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        geometries = zip(*opened.read_two_view_geometries(), strict=True)
        for pair, geometry in geometries:
            first, second = (names[image] for image in pycolmap.pair_id_to_image_pair(pair))
            rows = geometry.inlier_matches
            same |= _paired(ours.get(first), theirs.get(second), rows)
            same |= _paired(ours.get(second), theirs.get(first), rows[:, ::-1])
    ordered = sorted(same)
    return Shared(
        np.array([source.point3D(one).xyz for one, _ in ordered]).reshape(-1, 3),
        np.array([target.point3D(two).xyz for _, two in ordered]).reshape(-1, 3))


def posed(
    database: Path, cameras: pycolmap.Reconstruction | None, poses: Mapping[str, pycolmap.Rigid3d]
) -> pycolmap.Reconstruction:
    """Returns a model without points: the images of a database with these poses.

    Args:
        database: gives the images and their keypoints.
        cameras: gives the intrinsics, under the ids that they have in the database; None takes
            those of the database.
        poses: world to camera by name of image.
    """
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as opened:
        options = pycolmap.DatabaseCacheOptions()
        options.load_all_images = True
        options.image_names = set(poses)
        model.load(pycolmap.DatabaseCache.create(opened, options))
    for camera, known in cameras.cameras.items() if cameras else ():
        if camera in model.cameras:
            model.camera(camera).params = known.params
    for image in model.images.values():
        frame = model.frame(image.frame_id)
        frame.set_cam_from_world(image.camera_id, poses[image.name])
        model.register_frame(image.frame_id)
    return model


def _images(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    return [model.image(i) for i in sorted(model.reg_image_ids())]


def _seen(model: pycolmap.Reconstruction) -> dict[str, dict[int, int]]:
    """Returns the point that each keypoint shows, by name of image and index of the keypoint."""
    return {
        image.name: {
            row: point.point3D_id for row, point in enumerate(image.points2D)
            if point.has_point3D()}
        for image in _images(model)}


def _paired(
    ours: Mapping[int, int] | None, theirs: Mapping[int, int] | None, rows: NDArray[np.uint32]
) -> set[tuple[int, int]]:
    """Returns the points that matches [M, 2] between two images make one."""
    if ours is None or theirs is None:
        return set()
    return {
        (ours[one], theirs[two]) for one, two in rows.tolist() if one in ours and two in theirs}


def _depth(model: pycolmap.Reconstruction) -> float:
    """Returns the median distance of a point from the cameras that see it."""
    points = np.array([point.xyz for point in model.points3D.values()])
    centers = np.array([image.projection_center() for image in _images(model)])
    return float(np.median(np.linalg.norm(points - np.median(centers, axis=0), axis=1)))
