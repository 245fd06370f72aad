"""Cameras from the poses that a phone or headset tracked: a start, and not the truth.

Tracking drifts by centimetres and a degree over a room. Only pairs of frames are matched that
overlap by the poses, or look alike; the cameras are adjusted to the matches, with the tracked
positions as priors. A frame whose own matches contradict its pose is placed by its matches alone.
Where the pictures show too little, as before a bare wall, the tracking holds: such a frame moves
with the frames before and after it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from recon_cli.errors import format_count
from recon_cli.io.colmap_library import pycolmap
from recon_cli.sfm.features import matching
from recon_cli.sfm.job import MappingJob, Reporter
from recon_cli.sfm.limits import (
    LOOP_CANDIDATES,
    MAX_ERROR_PX,
    MIN_PAIR_EXPLAINED,
    MIN_POSE_INLIERS,
    MIN_SPOT_MATCHES,
)
from recon_cli.sfm.mapping import mapper
from recon_cli.sfm.mapping.merge_models import build_posed_model
from recon_cli.sfm.mapping.prior_adjustment import (
    adjust_with_priors,
    make_points,
    measure_deviation,
)
from recon_cli.sfm.model_arrays import Pair, registered_images, viewmat_of
from recon_cli.sfm.segments.loop_closure import optimize_model
from recon_cli.sfm.segments.view_overlap import WIDEST, overlapping_pairs
from recon_cli.sfm.verdict.evidence import explained_matches

Viewmats = Mapping[str, NDArray[np.float64]]  # [4, 4] world to camera by name

# Pairs that are matched first, to see whether the poses fit: frames that follow each other by
# name at these distances.
STEPS = (1, 2)
# Degrees that rays to a point may be off in each adjustment, to points made anew: the tracking
# drifts by a degree, which is 5 pixels in a small picture and 25 in a large one. At least
# `limits.MAX_ERROR_PX`.
ROUNDS_DEG = (1.5, 0.0)
# Standard deviation of a tracked position before it is measured, and the least one, as shares of
# the size of the path.
DEVIATIONS = (0.02, 0.001)


@dataclass(frozen=True, eq=False)
class PosesCheck:
    """How far the matches of near frames agree with given poses."""

    matches: int
    share: float | None  # of them that agree; None where there are too few
    contradicted: tuple[str, ...]  # frames whose own matches mostly do not agree

    @property
    def fits(self) -> bool:
        """Whether the poses may be a start."""
        return self.share is None or self.share >= MIN_PAIR_EXPLAINED


@dataclass(frozen=True, eq=False)
class TrackedModel:
    """A model in the frame of the tracked poses."""

    model: pycolmap.Reconstruction  # of the frames that matches place
    held: tuple[str, ...]  # frames that only tracking can place
    replaced: tuple[str, ...]  # frames that were placed by their matches alone
    error_before: float  # mean reprojection error with the tracked poses, pixels


def near_pairs(names: Collection[str]) -> set[Pair]:
    """Returns the pairs of frames that follow each other closely by name."""
    ordered = sorted(names)
    return {pair for step in STEPS for pair in zip(ordered, ordered[step:], strict=False)}


def match_near(job: MappingJob, viewmats: Viewmats, report: Reporter) -> PosesCheck:
    """Matches frames that follow each other, and returns how well the poses fit them.

    Between others the poses may have drifted.
    """
    near = near_pairs(job.names)
    matching.match_pairs(job, near, report)
    model = _posed(job, viewmats)
    images = {image.name: image for image in model.images.values() if image.has_pose}
    offset = _widest(model, ROUNDS_DEG[0])
    matches, agreeing = Counter[str](), Counter[str]()
    for pair, ours, theirs in matching.read_matched_pixels(
            job.database, matching.read_verified(job.database)):
        if pair not in near or not set(pair) <= images.keys():
            continue
        count = int(np.count_nonzero(explained_matches(
            images[pair[0]], ours, images[pair[1]], theirs, 0.0, offset)))
        for name in pair:
            matches[name] += len(ours)
            agreeing[name] += count
    total = matches.total() // 2
    share = agreeing.total() / matches.total() if total >= MIN_SPOT_MATCHES else None
    return PosesCheck(total, share, tuple(
        name for name in sorted(matches) if matches[name] >= MIN_SPOT_MATCHES
        and agreeing[name] < MIN_PAIR_EXPLAINED * matches[name]))


def match_overlapping(
    job: MappingJob, viewmats: Viewmats, report: Reporter
) -> None:
    """Matches frames that overlap by poses which `match_near` found to fit, and some that look
    alike without overlapping, as where the tracking lost its place.
    """
    model = _posed(job, viewmats)
    make_points(model, _cache(job), job.seed)
    pairs = overlapping_pairs(model)
    known = pairs | near_pairs(job.names)
    alike = matching.similar_pairs(
        job.database, job.names, seed=job.seed, nearest=LOOP_CANDIDATES, besides=known)
    matching.match_pairs(
        job, known | (alike - overlapping_pairs(model, WIDEST)), report)


def adjust_tracked(
    job: MappingJob, viewmats: Viewmats, constant: Collection[int]
) -> TrackedModel:
    """Returns the cameras that the matches and the tracked `viewmats` give together.

    Frames of the job without a viewmat are placed by their matches. The intrinsics of the cameras
    `constant` stay as they are.
    """
    model, cache = _posed(job, viewmats), _cache(job)
    priors = {name: _center(viewmat) for name, viewmat in viewmats.items()}
    size = float(np.linalg.norm(np.ptp(np.array(list(priors.values())), axis=0))) or 1.0
    deviation, before = DEVIATIONS[0] * size, 0.0
    for number, angle in enumerate(ROUNDS_DEG):
        off = _widest(model, angle)
        if number:
            closed = optimize_model(model, matching.read_verified(job.database), seed=job.seed)
            model = closed or model
            _place(model, _follow(model, viewmats))
        make_points(model, cache, job.seed, off)
        if not number:
            before = model.compute_mean_reprojection_error()
        take_out(model, {name for name, count in _points(model).items()
                          if count < MIN_POSE_INLIERS})
        adjust_with_priors(
            model, priors, deviation, constant=constant, seed=job.seed, max_error=off)
        deviation = max(measure_deviation(model, priors), DEVIATIONS[1] * size)
        if set(job.names) - set(viewmats):
            mapper.resect(job, model)
    placed = set(mapper.list_registered(model))
    return TrackedModel(
        model, tuple(sorted(set(viewmats) - placed)), tuple(sorted(placed - set(viewmats))),
        before)


def add_prior_poses(
    model: pycolmap.Reconstruction, held: Collection[str], viewmats: Viewmats
) -> None:
    """Adds frames to a model, in place, where the tracking has them beside the others."""
    followed = _follow(model, viewmats)
    _place(model, {name: followed[name] for name in held})


def describe_tracked(found: TrackedModel, parts: int) -> tuple[str, ...]:
    """Returns sentences on what tracking and what matches hold."""
    sentences = []
    if found.held:
        sentences.append(
            f"{format_count(len(found.held), 'frame')} show too little to be placed by "
            "matches: the tracked poses place them between the others.")
    if parts > 1:
        sentences.append(
            f"The pictures fall into {parts} groups that share no point: the tracked poses hold "
            "them together.")
    if found.replaced:
        sentences.append(
            f"{format_count(len(found.replaced), 'frame')} had no pose, or one that the "
            "pictures contradict: matches place them.")
    return tuple(sentences)


def _widest(model: pycolmap.Reconstruction, degrees: float) -> float:
    """Returns the pixels of an angle in the cameras of a model, at least MAX_ERROR_PX."""
    focal = float(np.median([camera.mean_focal_length() for camera in model.cameras.values()]))
    return max(MAX_ERROR_PX, focal * float(np.tan(np.radians(degrees))))


def _posed(job: MappingJob, viewmats: Viewmats) -> pycolmap.Reconstruction:
    """Returns a model of all frames of a job, of which those with a viewmat have a camera."""
    poses = {name: pycolmap.Rigid3d(viewmats[name][:3]) if name in viewmats else pycolmap.Rigid3d()
             for name in job.names}
    model = build_posed_model(job.database, None, poses)
    take_out(model, set(job.names) - set(viewmats))
    return model


def _cache(job: MappingJob) -> pycolmap.DatabaseCache:
    options = pycolmap.DatabaseCacheOptions()
    options.load_all_images = True
    with pycolmap.Database.open(job.database) as opened:
        return pycolmap.DatabaseCache.create(opened, options)


def take_out(model: pycolmap.Reconstruction, names: Collection[str]) -> None:
    """Takes the cameras of frames out of a model, in place."""
    for image in list(model.images.values()):
        if image.name in names and image.has_pose:
            model.deregister_frame(image.frame_id)


def _place(model: pycolmap.Reconstruction, viewmats: Viewmats) -> None:
    """Gives frames without a camera one."""
    for image in list(model.images.values()):
        if image.name in viewmats and not image.has_pose:
            model.frame(image.frame_id).set_cam_from_world(
                image.camera_id, pycolmap.Rigid3d(viewmats[image.name][:3]))
            model.register_frame(image.frame_id)


def _points(model: pycolmap.Reconstruction) -> dict[str, int]:
    """Returns how many points each camera of a model sees."""
    images = registered_images(model)
    return {image.name: image.num_points3D for image in images}


def _follow(model: pycolmap.Reconstruction, viewmats: Viewmats) -> dict[str, NDArray[np.float64]]:
    """Returns where frames with a tracked pose go that a model lacks, world to camera.

    Each keeps its tracked motion from the nearest frames of the model before and after it by name;
    between the two places that follow, it lies by its order.
    """
    placed = [name for name in mapper.list_registered(model) if name in viewmats]
    order = {name: place for place, name in enumerate(sorted(viewmats))}
    at = np.array([order[name] for name in placed])
    found: dict[str, NDArray[np.float64]] = {}
    for name in set(viewmats) - set(placed):
        after = int(np.searchsorted(at, order[name]))
        nearest = [placed[i] for i in (after - 1, after) if 0 <= i < len(placed)]
        moved = [_carry(model, viewmats, other, name) for other in nearest]
        if not moved:
            found[name] = np.asarray(viewmats[name])
        elif len(moved) == 1:
            found[name] = moved[0]
        else:
            first, last = (order[other] for other in nearest)
            found[name] = _between(
                moved[0], moved[1], (order[name] - first) / (last - first))
    return found


def _carry(
    model: pycolmap.Reconstruction, viewmats: Viewmats, start: str, name: str
) -> NDArray[np.float64]:
    """Returns the viewmat of a frame by the tracked motion from another one that has a camera."""
    known = viewmat_of(model.find_image_with_name(start))
    return np.asarray(viewmats[name] @ np.linalg.inv(viewmats[start]) @ known)


def _between(
    first: NDArray[np.float64], second: NDArray[np.float64], share: float
) -> NDArray[np.float64]:
    """Returns the viewmat at a share of the way between two."""
    turns = Rotation.from_matrix([first[:3, :3], second[:3, :3]])
    center = (1 - share) * _center(first) + share * _center(second)
    result = np.eye(4)
    result[:3, :3] = Slerp([0.0, 1.0], turns)([share])[0].as_matrix()
    result[:3, 3] = -result[:3, :3] @ center
    return result


def _center(viewmat: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(-viewmat[:3, :3].T @ viewmat[:3, 3])
