"""One model from all that a mapper found: parts merged, wrong images taken out.

Two models of one capture hold the same keypoints: in images that are in both, and in verified pairs
of images, one of each. Where both have a point for such a keypoint, the two points are one, and the
similarity between the models follows from many of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.io.colmap_library import pycolmap
from recon_cli.sfm import mapper, verdict
from recon_cli.sfm.checks import MIN_FRAMES
from recon_cli.sfm.job import MappingJob
from recon_cli.sfm.verdict import ModelVerdict

# COLMAP's thresholds for the pose of an image (abs_pose_min_num_inliers, _min_inlier_ratio).
MIN_INLIERS = 30
MIN_INLIER_SHARE = 0.25
# Distance of two equal points, as a share of the median distance of a point from a camera. Depth is
# known to 1 to 3%: up to 4 px of some 1000 px focal length over 7 to 23 degrees between rays.
MAX_ERROR = 0.03
MAX_TRIALS = 10_000
# With a larger share of suspected images the model is wrong; removing them would hide it.
MAX_REJECTED = 0.2


@dataclass(frozen=True, eq=False)
class ModelCandidate:
    """A model that may become the result."""

    model: pycolmap.Reconstruction  # adjusted
    verdict: ModelVerdict
    apart: tuple[tuple[str, ...], ...]  # frames that only other models hold
    rejected: Mapping[str, str]  # why frames were taken out, by name
    others: tuple[pycolmap.Reconstruction, ...] = ()  # the models that hold `apart`


def best_model(
    job: MappingJob, models: Sequence[pycolmap.Reconstruction], *, merging: bool = True
) -> ModelCandidate | None:
    """Returns the largest model, merged with others and without wrong images; None without models.

    The models are adjusted; the result is sharp. A part is merged only where the model is trusted
    no less with it than without it, and not without `merging`.
    """
    if not models:
        return None
    largest, *others = sorted(models, key=mapper.model_size, reverse=True)
    best = drop_outliers(job, mapper.sharpen(largest))
    for other in others if merging else ():
        joined = merge(job, best.model, other)
        if joined is None:
            continue
        merged = drop_outliers(job, mapper.sharpen(joined))
        larger = merged.model.num_reg_images() > best.model.num_reg_images()
        if larger and (merged.verdict.trusted or not best.verdict.trusted):
            best = merged
    apart = _list_apart(best, others)
    return ModelCandidate(
        best.model, best.verdict, tuple(names for names, _ in apart), best.rejected,
        tuple(model for _, model in apart))


def drop_outliers(job: MappingJob, model: pycolmap.Reconstruction) -> ModelCandidate:
    """Takes the images that the verdict suspects out of a model and adjusts the rest again.

    Without them others may stand out, until none does or they are too many.
    """
    rejected: dict[str, str] = {}
    cameras, verdict = model.num_reg_images(), _examine(job, model)
    while verdict.outliers and len(
            rejected) + len(verdict.outliers) <= MAX_REJECTED * cameras:
        for item in verdict.outliers:
            rejected[item.name] = item.reason
            model.deregister_frame(model.find_image_with_name(item.name).frame_id)
        model = mapper.sharpen(model)
        verdict = _examine(job, model)
    return ModelCandidate(model, verdict, (), rejected)


def _examine(job: MappingJob, model: pycolmap.Reconstruction) -> ModelVerdict:
    return verdict.examine(model, job.database, job.names, sharpness=job.sharpness, times=job.times)


def _list_apart(
    best: ModelCandidate, others: Sequence[pycolmap.Reconstruction]
) -> list[tuple[tuple[str, ...], pycolmap.Reconstruction]]:
    """Returns models with three or more frames that no model before them holds, and those."""
    held, parts = {*mapper.list_registered(best.model), *best.rejected}, []
    for other in others:
        new = sorted(set(mapper.list_registered(other)) - held)
        held.update(new)
        if len(new) >= MIN_FRAMES:
            parts.append((tuple(new), other))
    return parts


def merge(
    job: MappingJob, base: pycolmap.Reconstruction, other: pycolmap.Reconstruction
) -> pycolmap.Reconstruction | None:
    """Returns `base` with the images of `other`, adjusted together, or None.

    None if `other` brings fewer than three further images or shares too few points with `base`.
    """
    new = set(mapper.list_registered(other)) - set(mapper.list_registered(base))
    if len(new) < MIN_FRAMES:
        return None
    motion = similarity(*find_shared_points(job.database, other, base), base, seed=job.seed)
    if motion is None:
        return None
    poses = {image.name: image.cam_from_world() for image in _images(base)}
    for image in _images(other):
        if image.name in new:
            poses[image.name] = motion.transform_camera_world(image.cam_from_world())
    joined = mapper.triangulate(job, build_posed_model(job.database, base, poses))
    mapper.adjust(joined)
    return mapper.extend_model(job, joined)


def similarity(
    source: NDArray[np.float64],  # [P, 3]
    target: NDArray[np.float64],  # [P, 3]
    base: pycolmap.Reconstruction,
    *,
    seed: int,
) -> pycolmap.Sim3d | None:
    """Returns the similarity from points to those of `base`, None where too few agree."""
    if len(source) < MIN_INLIERS:
        return None
    points = np.array([point.xyz for point in base.points3D.values()])
    centers = np.array([image.projection_center() for image in _images(base)])
    depths = np.linalg.norm(points - np.median(centers, axis=0), axis=1)
    options = pycolmap.RANSACOptions()
    options.max_error = MAX_ERROR * float(np.median(depths))
    options.max_num_trials = MAX_TRIALS
    options.random_seed = seed
    estimate = pycolmap.estimate_sim3d_robust(source, target, options)
    enough = max(MIN_INLIERS, MIN_INLIER_SHARE * len(source))
    if estimate is None or estimate["num_inliers"] < enough:
        return None
    motion: pycolmap.Sim3d = estimate["tgt_from_src"]
    return motion


def find_shared_points(
    database: Path, source: pycolmap.Reconstruction, target: pycolmap.Reconstruction
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:  # [P, 3], [P, 3]
    """Returns the points that the same or matching keypoints show, in both models."""
    ours, theirs = _points_of_keypoints(source), _points_of_keypoints(target)
    same = {
        (ours[name][row], theirs[name][row])
        for name in ours.keys() & theirs.keys() for row in ours[name].keys() & theirs[name].keys()}
    with pycolmap.Database.open(database) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        geometries = zip(*opened.read_two_view_geometries(), strict=True)
        for pair, geometry in geometries:
            first, second = (names[image] for image in pycolmap.pair_id_to_image_pair(pair))
            rows = geometry.inlier_matches
            same |= _pair_points(ours.get(first, {}), theirs.get(second, {}), rows)
            same |= _pair_points(ours.get(second, {}), theirs.get(first, {}), rows[:, ::-1])
    ordered = sorted(same)
    return (np.array([source.point3D(point).xyz for point, _ in ordered]).reshape(-1, 3),
            np.array([target.point3D(point).xyz for _, point in ordered]).reshape(-1, 3))


def build_posed_model(
    database: Path, cameras: pycolmap.Reconstruction | None, poses: Mapping[str, pycolmap.Rigid3d]
) -> pycolmap.Reconstruction:
    """Returns a model without points: images of a database with poses, world to camera by name.

    The intrinsics are those of `cameras`, under the ids that they have in the database; None takes
    those of the database.
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


def _points_of_keypoints(model: pycolmap.Reconstruction) -> dict[str, dict[int, int]]:
    """Returns the point that each keypoint shows, by name of image and index of the keypoint."""
    return {
        image.name: {row: point.point3D_id for row, point in enumerate(image.points2D)
                     if point.has_point3D()}
        for image in _images(model)}


def _pair_points(
    ours: Mapping[int, int], theirs: Mapping[int, int], rows: NDArray[np.uint32]
) -> set[tuple[int, int]]:
    """Returns the points that matches [M, 2] between two images make one."""
    return {
        (ours[row], theirs[other]) for row, other in rows.tolist()
        if row in ours and other in theirs}
