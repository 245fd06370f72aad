"""Poses and points that are kept as they were given, held against a few pairs of their images.

A data set that brings everything is taken without features, in a second or two. Poses whose axes
follow another convention, or that belong to other images, would then pass in silence: some pairs of
neighbours are matched, and their matches compared with the poses.
"""

from __future__ import annotations

import io
import shutil
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from recon_cli.errors import SfmError
from recon_cli.io.posed import KnownPoses, read_poses
from recon_cli.sfm import checks, database, evidence, features, mapper, merge_models, pairs, verdict
from recon_cli.sfm.job import VERDICT, Job, Reporter
from recon_cli.sfm.step_log import Result, fresh_folder, publish
from recon_cli.workspace import atomic

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
    checks.check_registered(job.names, list(known.viewmats), 0.0)
    report.phase("mapping", len(job.names))
    moved: dict[str, Any] = {}
    if "features" not in job.steps:
        model, found = _given(job, known), None
        checked = check(job, neighbours(known.viewmats), known.viewmats)
        if not checked.fits:
            raise _misfit(checked.share or 0.0, MIN_SPOT_AGREEING)
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
        job, merge_models.posed(job.database, None, poses), refine_intrinsics=bool(_unknown(job)))


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


PLACES = 4  # spread over the images by name
# Of the cameras nearest to each place: the next one, and one with a baseline that tells more.
NEIGHBOURS = (0, 5)
FEATURES = 1000  # keypoints an image
MIN_MATCHES = 60  # fewer, in all pairs together, say nothing
# Share of the matches that must lie on the epipolar lines of the poses. A room and a desk gave
# .997 and more with their poses; with flipped axes, inverted matrices, poses of other images or of
# those four frames on .07 to .36 (tests/bench/bench_spot_check.py).
MIN_SPOT_AGREEING = 0.5


@dataclass(frozen=True)
class Checked:
    """What the pairs say.

    Attributes:
        matches: verified matches of all pairs.
        share: of them that agree with the poses; None where there are too few to tell.
    """

    matches: int
    share: float | None

    @property
    def fits(self) -> bool:
        """Whether nothing speaks against the poses."""
        return self.share is None or self.share >= MIN_SPOT_AGREEING

    def lines(self) -> list[str]:
        """Returns a sentence for the terminal."""
        if self.share is None:
            return [f"The given poses could not be checked: {self.matches} matches are too few."]
        return [f"{self.share:.0%} of {self.matches} matches between sampled images agree with "
                "the given poses."]


def check(
    job: Job, near: Mapping[str, list[str]], viewmats: Mapping[str, NDArray[np.float64]]
) -> Checked:
    """Returns how far sampled pairs of images bear out the poses.

    Args:
        job: whose groups all have a known lens.
        near: for each image the others that see much in common with it, nearest first.
        viewmats: [4, 4] world to camera by name.

    Raises:
        FormatError: a frame cannot be read.
    """
    names = sorted(viewmats)
    places = {names[int((i + 0.5) * len(names) / PLACES)] for i in range(PLACES)}
    wanted = {
        (min(one, two), max(one, two)) for one in places
        for two in (near[one][k] for k in NEIGHBOURS if k < len(near[one]))}
    sample = _part(job, sorted({name for pair in wanted for name in pair}))
    silent = Reporter(io.BytesIO())
    features.create_database(sample)
    try:
        features.extract(sample, silent)
        pairs.match(sample, wanted, silent)
        found = evidence.gather(_posed(sample, viewmats), sample.database, sample.names)
        matches, agreeing = int(found.matches.sum()), int(found.agreeing.sum())
    except SfmError:  # hardly any texture
        matches, agreeing = 0, 0
    shutil.rmtree(sample.out)
    return Checked(matches, agreeing / matches if matches >= MIN_MATCHES else None)


def _part(job: Job, names: list[str]) -> Job:
    """Returns a job over some of the images, in a folder of its own."""
    groups = tuple(
        replace(group, names=kept) for group in job.groups
        if (kept := tuple(name for name in group.names if name in names)))
    return replace(
        job, out=fresh_folder(job.rungs / "check"), groups=groups, max_features=FEATURES)


def _posed(
    job: Job, viewmats: Mapping[str, NDArray[np.float64]]
) -> pycolmap.Reconstruction:
    poses = {name: pycolmap.Rigid3d(viewmats[name][:3]) for name in job.names}
    return merge_models.posed(job.database, None, poses)
