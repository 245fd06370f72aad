"""One model from all that a mapper found: parts merged, wrong images taken out.

Two models of one capture are brought together by the points that both have; see `shared_points`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import pdist

from recon_cli.io.colmap_library import pycolmap
from recon_cli.scene.similarity import Similarity
from recon_cli.sfm.features import matching
from recon_cli.sfm.job import MappingJob
from recon_cli.sfm.limits import (
    MAX_ERROR_PX,
    MAX_POINT_ERROR,
    MAX_REJECTED,
    MIN_FRAMES,
    MIN_POSE_INLIERS,
    MIN_POSE_SHARE,
)
from recon_cli.sfm.mapping import mapper
from recon_cli.sfm.model_arrays import registered_images
from recon_cli.sfm.segments.shared_points import (
    describe_segment,
    estimate_similarity,
    find_shared_points,
    to_sim3d,
)
from recon_cli.sfm.verdict import verdict
from recon_cli.sfm.verdict.scale_drift import MAX_SCALE_ERROR
from recon_cli.sfm.verdict.verdict import ModelVerdict


@dataclass(frozen=True, eq=False)
class ModelCandidate:
    """A model that may become the result."""

    model: pycolmap.Reconstruction  # adjusted
    verdict: ModelVerdict
    apart: tuple[tuple[str, ...], ...]  # frames that only other models hold
    rejected: Mapping[str, str]  # why frames were taken out, by name
    others: tuple[pycolmap.Reconstruction, ...] = ()  # the models that hold `apart`


def best_model(
    job: MappingJob, models: Sequence[pycolmap.Reconstruction], *, merging: bool = True,
    both_ways: bool = False,
) -> ModelCandidate | None:
    """Returns the largest model, merged with others and without wrong images; None without models.

    The models are adjusted; the result is sharp. A part is merged only where the model is trusted
    no less with it than without it, and not without `merging`; with `both_ways` only where images
    of either, placed by the points of the other, show the same scale.
    """
    if not models:
        return None
    largest, *others = sorted(models, key=mapper.model_size, reverse=True)
    best = drop_outliers(job, mapper.sharpen(largest))
    for other in others if merging else ():
        joined = merge(job, best.model, other, both_ways=both_ways)
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
    return verdict.examine(model, job.database, job.names, sharpness=job.sharpness,
                           times=job.times, lenses=job.unknown_lenses)


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
    job: MappingJob, base: pycolmap.Reconstruction, other: pycolmap.Reconstruction, *,
    both_ways: bool = False,
) -> pycolmap.Reconstruction | None:
    """Returns `base` with the images of `other`, adjusted together, or None.

    None if `other` brings fewer than three further images or shares too few points with `base`;
    for `both_ways` see `best_model`.
    """
    new = set(mapper.list_registered(other)) - set(mapper.list_registered(base))
    if len(new) < MIN_FRAMES:
        return None
    motion = find_similarity(job, other, base)
    if motion is None or (both_ways and not (
            _shows_scale(job, other, base, motion.scale)
            and _shows_scale(job, base, other, 1 / motion.scale))):
        return None
    moved = to_sim3d(motion)
    poses = {image.name: image.cam_from_world() for image in registered_images(base)}
    for image in registered_images(other):
        if image.name in new:
            poses[image.name] = moved.transform_camera_world(image.cam_from_world())
    joined = mapper.triangulate(job, build_posed_model(job.database, base, poses))
    mapper.adjust(joined)
    return mapper.extend_model(job, joined)


def find_similarity(
    job: MappingJob, source: pycolmap.Reconstruction, target: pycolmap.Reconstruction
) -> Similarity | None:
    """Returns the similarity between two models of one database; None where too few points agree.
    """
    both = [describe_segment(index, model) for index, model in enumerate((source, target))]
    found = find_shared_points(both, matching.read_verified(job.database))
    if not found:
        return None
    # Each two points once, however many images show them.
    points = np.unique(np.column_stack([found[0].ours, found[0].theirs]), axis=0)
    places = np.array([point.xyz for point in target.points3D.values()])
    depths = np.linalg.norm(places - np.median(both[1].cameras.centers, axis=0), axis=1)
    agreed = estimate_similarity(
        points[:, :3], points[:, 3:], max_error=MAX_POINT_ERROR * float(np.median(depths)),
        min_share=MIN_POSE_SHARE, seed=job.seed)
    return None if agreed is None else agreed.motion


def _shows_scale(
    job: MappingJob, source: pycolmap.Reconstruction, target: pycolmap.Reconstruction, scale: float
) -> bool:
    """Returns whether images of `source`, placed by points of `target`, are `scale` times as far.

    Three are needed. Placed one way alone, parts came out 1.5% right and 2.4 times wrong.
    """
    holders = {image.name: image for image in registered_images(target)}
    new = {image.name: image for image in registered_images(source) if image.name not in holders}
    spots: dict[str, list[tuple[NDArray[np.float64], NDArray[np.float64]]]] = {}
    for pair, geometry in matching.read_verified(job.database).items():
        for name, other, rows in zip(
                pair, pair[::-1], (geometry.inlier_matches, geometry.inlier_matches[:, ::-1]),
                strict=True):
            if name in new and other in holders:
                ours, theirs = new[name].points2D, holders[other].points2D
                spots.setdefault(name, []).extend(
                    (ours[row].xy, target.point3D(theirs[column].point3D_id).xyz)
                    for row, column in rows if theirs[column].has_point3D())
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error, options.ransac.random_seed = MAX_ERROR_PX, job.seed
    centers = []
    for name, found in sorted(spots.items()):
        if len(found) < MIN_POSE_INLIERS:
            continue
        placed = pycolmap.estimate_and_refine_absolute_pose(
            *map(np.array, zip(*found, strict=True)), new[name].camera, options)
        if placed is not None and placed["num_inliers"] >= max(
                MIN_POSE_INLIERS, MIN_POSE_SHARE * len(found)):
            there = placed["cam_from_world"].inverse().translation
            centers.append(np.stack([new[name].projection_center(), there]))
    if len(centers) < MIN_FRAMES:
        return False
    own, other = pdist(np.array(centers)[:, 0]), pdist(np.array(centers)[:, 1])
    far = own >= np.median(own)  # the longer half: short ones are all error
    return bool(abs(np.log(np.median(other[far] / own[far]) / scale)) < MAX_SCALE_ERROR)


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
