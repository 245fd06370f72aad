"""Models of known poses: the points are given too or triangulated, the poses kept or refined.

Nothing here looks for cameras. What a data set says of its poses is believed, then checked against
the matches.
"""

from __future__ import annotations

import shutil
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from recon_cli import atomic
from recon_cli.errors import SfmError
from recon_cli.io.poses import KnownPoses, read_poses
from recon_cli.mapping import database, doctor, mapper, merge, pairs, spot_check, verdict
from recon_cli.mapping.job import VERDICT, Job
from recon_cli.mapping.ledger import Result, fresh_folder, publish
from recon_cli.mapping.protocol import Reporter

NEAREST = 20  # cameras that each one is matched with, as many as look alike (see `retrieval`)
# Axes that differ by more leave little in common: the wider side of a phone's picture spans 65 to
# 80 degrees.
MAX_TURN_DEG = 75.0
# Share of the verified matches that the points must bear out. Nine rendered frames gave 0.76
# with their true poses and at most 0.06 with axes of another convention or the names swapped.
MIN_AGREEING = 0.2

Poses = NDArray[np.float64]  # [F, 4, 4] world to camera


def match(job: Job, report: Reporter) -> Result:
    """Matches neighbours in the order of names, and cameras that stand and look alike."""
    poses = _poses(job).viewmats
    pairs.match(job, near(poses) | pairs.sequential(list(poses)), report)
    return pairs.counted(job)


def near(viewmats: Mapping[str, NDArray[np.float64]]) -> set[pairs.Pair]:
    """Returns each image paired with the nearest that look in about the same direction.

    Args:
        viewmats: [4, 4] world to camera by name.
    """
    return {
        (min(one, two), max(one, two))
        for one, others in neighbours(viewmats).items() for two in others[:NEAREST]}


def neighbours(viewmats: Mapping[str, NDArray[np.float64]]) -> dict[str, list[str]]:
    """Returns for each image those that look in about the same direction, nearest first.

    Args:
        viewmats: [4, 4] world to camera by name.
    """
    names = sorted(viewmats)
    matrices = np.stack([viewmats[name] for name in names])
    axes, found = matrices[:, 2, :3], {}
    tree = KDTree(_centers(matrices))
    for one, center in enumerate(tree.data):
        _, order = tree.query(center, k=len(names))
        found[names[one]] = [
            names[two] for two in np.atleast_1d(order).tolist()
            if two != one and axes[one] @ axes[two] >= np.cos(np.radians(MAX_TURN_DEG))]
    return found


def build(job: Job, report: Reporter) -> Result:
    """Writes the model of the given cameras into out/model and returns what it holds.

    Raises:
        SfmError: too few frames have a pose, or the poses do not fit the images.
    """
    known = _poses(job)
    doctor.check_registered(job.names, list(known.viewmats), 0.0)
    report.phase("mapping", len(job.names))
    moved: dict[str, Any] = {}
    if "features" not in job.steps:
        model, found = _given(job, known), None
        checked = spot_check.check(job, neighbours(known.viewmats), known.viewmats)
        if not checked.fits:
            raise _misfit(checked.share or 0.0, spot_check.MIN_AGREEING)
        lines = checked.lines()
    else:
        model = _triangulated(job, known)
        if job.pose_use == "refine":
            moved = _refine(job, model, known)
        _check_fit(job, model)
        found = verdict.examine(
            model, job.database, sorted(known.viewmats), sharpness=job.sharpness, times=job.times)
        verdict.check_weak_link(found, job.accept_weak)
        atomic.write_json(job.out / VERDICT, found.to_json())
        lines = found.lines()
    folder = fresh_folder(job.out / "model.partial")
    model.write(folder)
    publish(folder, job.model)
    shutil.rmtree(job.rungs, ignore_errors=True)
    return {
        **mapper.described(model), "models": [model.num_reg_images()], "apart": [], "rejected": {},
        "rungs": [], "verdict": found.to_json() if found else None,
        "lines": lines,
        "poses": {"use": job.pose_use, "metric": known.metric, **moved}}


def _poses(job: Job) -> KnownPoses:
    """Returns the poses of the frames that there are."""
    assert job.poses is not None
    known, names = read_poses(job.poses), set(job.names)
    viewmats = {name: matrix for name, matrix in known.viewmats.items() if name in names}
    return KnownPoses(viewmats, known.metric, known.points, known.colors)


def _given(job: Job, known: KnownPoses) -> pycolmap.Reconstruction:
    """Returns the given cameras and points; no image says which points it sees."""
    model, number = pycolmap.Reconstruction(), 0
    for camera, group in enumerate(job.groups, start=1):
        lens = group.lens
        assert lens is not None  # or `Job.steps` would ask for features
        model.add_camera_with_trivial_rig(pycolmap.Camera(
            camera_id=camera, model=lens.model, width=lens.width, height=lens.height,
            params=lens.params))
        for name in group.names:
            number += 1
            if name in known.viewmats:
                model.add_image_with_trivial_frame(
                    pycolmap.Image(image_id=number, name=name, camera_id=camera),
                    pycolmap.Rigid3d(known.viewmats[name][:3]))
    assert known.points is not None
    assert known.colors is not None
    for point, color in zip(known.points, known.colors, strict=True):
        model.add_point3D(point, pycolmap.Track(), color)
    return model


def _triangulated(job: Job, known: KnownPoses) -> pycolmap.Reconstruction:
    """Returns the given cameras with the points that the matches give."""
    poses = {name: pycolmap.Rigid3d(matrix[:3]) for name, matrix in known.viewmats.items()}
    return mapper.triangulated(
        job, merge.posed(job.database, None, poses), refine_intrinsics=bool(_unknown(job)))


def _check_fit(job: Job, model: pycolmap.Reconstruction) -> None:
    """Raises SfmError when hardly any verified match is borne out by a point of the model."""
    _, matches, _ = database.inlier_counts(job.database)
    lengths = np.array([point.track.length() for point in model.points3D.values()])
    share = float((lengths * (lengths - 1) / 2).sum()) / max(1, matches)
    if share < MIN_AGREEING:
        raise _misfit(share, MIN_AGREEING)


def _misfit(share: float, least: float) -> SfmError:
    return SfmError(
        f"The given poses do not fit the images: {share:.0%} of the matches agree with them, "
        f"at least {least:.0%} should.",
        hint="Check which way the axes of the poses point, or find the cameras anew with "
        "--poses ignore.")


def _refine(job: Job, model: pycolmap.Reconstruction, known: KnownPoses) -> dict[str, Any]:
    """Adjusts poses and points in place, moves the result back to where the poses were given.

    Returns:
        How far that moved the cameras: of the centres, median and maximum as a share of the size
        of the path; of the rotations, in degrees; the reprojection error before and after.
    """
    before = model.compute_mean_reprojection_error()
    fixed = set(model.cameras) - _unknown(job)
    for _ in range(2):  # points that the given poses had spoilt go before the second
        mapper.adjust(model, constant=fixed)
    names = mapper.names(model)
    given = np.stack([known.viewmats[name] for name in names])
    model.transform(back(_viewmats(model, names), given))
    model.update_point_3d_errors()
    return {**movement(_viewmats(model, names), given), "reprojection_error_px_before": before}


def back(found: Poses, given: Poses) -> pycolmap.Sim3d:
    """Returns the similarity that brings cameras closest to where they were given.

    The rotation is the mean over the cameras, so that centres on one line determine it, too; scale
    and translation are least squares over the centres. The given unit of length is kept.
    """
    turns = Rotation.from_matrix(given[:, :3, :3].transpose(0, 2, 1) @ found[:, :3, :3])
    turn = turns.mean()
    ours, theirs = turn.apply(_centers(found)), _centers(given)
    spread, aim = ours - ours.mean(axis=0), theirs - theirs.mean(axis=0)
    size = float((spread**2).sum())
    scale = float((spread * aim).sum()) / size if size > 0 else 1.0
    return pycolmap.Sim3d(
        scale, pycolmap.Rotation3d(turn.as_quat()),
        theirs.mean(axis=0) - scale * ours.mean(axis=0))


def movement(found: Poses, given: Poses) -> dict[str, float]:
    """Returns how far cameras lie from where they were given, see `_refine`."""
    centers = _centers(given)
    size = float(np.linalg.norm(np.ptp(centers, axis=0))) or 1.0
    steps = np.linalg.norm(_centers(found) - centers, axis=1) / size
    turns = Rotation.from_matrix(
        given[:, :3, :3].transpose(0, 2, 1) @ found[:, :3, :3]).magnitude()
    return {
        "moved_median": float(np.median(steps)), "moved_max": float(steps.max()),
        "turned_median_deg": float(np.degrees(np.median(turns))),
        "turned_max_deg": float(np.degrees(turns.max()))}


def _unknown(job: Job) -> set[int]:
    """Returns the ids of the cameras whose intrinsics are not known."""
    return {camera for camera, group in enumerate(job.groups, start=1) if group.lens is None}


def _viewmats(model: pycolmap.Reconstruction, names: Collection[str]) -> Poses:
    matrices = np.tile(np.eye(4), (len(names), 1, 1))
    for matrix, name in zip(matrices, names, strict=True):
        matrix[:3] = model.find_image_with_name(name).cam_from_world().matrix()
    return matrices


def _centers(viewmats: Poses) -> NDArray[np.float64]:
    centers: NDArray[np.float64] = -np.einsum(
        "fji,fj->fi", viewmats[:, :3, :3], viewmats[:, :3, 3])
    return centers
