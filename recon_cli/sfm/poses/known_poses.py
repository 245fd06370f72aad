"""Models from the poses of a data set, kept or taken as a start, and checked against the images.

A data set with poses, points and lenses needs no features and takes a second or two. Poses whose
axes follow another convention, or that belong to other images, would pass unnoticed then, so some
pairs of neighbours are matched, and their matches compared with the poses.
"""

from __future__ import annotations

import io
import shutil
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from recon_cli.errors import SfmError
from recon_cli.io.colmap_library import pycolmap
from recon_cli.sfm import database
from recon_cli.sfm.features import features, matching
from recon_cli.sfm.job import MappingJob, Reporter, fresh_folder
from recon_cli.sfm.limits import (
    COARSEST_KEYPOINTS,
    MIN_CONFIRMED,
    MIN_PAIR_EXPLAINED,
    MIN_SPOT_MATCHES,
)
from recon_cli.sfm.mapping import checks, fallbacks, mapper, parts
from recon_cli.sfm.mapping.merge_models import build_posed_model
from recon_cli.sfm.model_arrays import Pair, viewmat_of
from recon_cli.sfm.poses import tracked_poses
from recon_cli.sfm.results import FeaturesResult, MatchesResult, ModelResult
from recon_cli.sfm.verdict.evidence import gather_evidence
from recon_cli.sfm.verdict.verdict import ModelVerdict, check_weak_link, examine
from recon_cli.workspace.records import KnownPoses, read_poses
from recon_cli.workspace.steps import StepFolder
from recon_cli.workspace.summaries import PosesSummary

# Axes further apart share little: the wider side of a phone's picture spans 65 to 80 degrees.
MAX_AXES_DEG = 75.0
PLACES = 4  # of the spot check, spread over the images by name
# Of the cameras nearest to each place: the next one, and one with a baseline that tells more.
NEIGHBOURS = (0, 5)

Poses = NDArray[np.float64]  # [F, 4, 4] world to camera


def find_features(job: MappingJob, report: Reporter) -> FeaturesResult:
    """Fills the database with the features of all frames; see `features.extract_features`.

    Solved poses that are kept are held against some of the images before. SfmError if they do not
    fit.
    """
    known = _read_poses(job)
    if (job.pose_use == "keep" and known.accuracy != "tracked" and known.viewmats
            and not _uncalibrated_cameras(job)):
        _check_some(job, known)
    return features.extract_features(job, report)


def match_known(job: MappingJob, report: Reporter) -> MatchesResult:
    """Matches neighbours in the order of names, and cameras that stand and look alike.

    Of poses that are a start only, what overlaps by them. Where they do not fit the pictures, the
    pairs are those of images without poses; SfmError if `refine` asks for the poses.
    """
    poses = _read_poses(job).viewmats
    if job.pose_use != "keep":
        check = tracked_poses.match_near(job, poses, report)
        if check.fits:
            rest = {name: view for name, view in poses.items() if name not in check.contradicted}
            tracked_poses.match_overlapping(job, rest, report)
            found = matching.count_matches(job)
        elif job.pose_use == "refine":
            raise _misfit(check.share or 0.0, MIN_PAIR_EXPLAINED)
        else:
            found = fallbacks.match_first(job, report)
        return replace(found, poses_share=check.share, poses_contradicted=check.contradicted)
    matching.match_pairs(job, near_pairs(poses) | matching.sequential_pairs(list(poses)), report)
    return matching.count_matches(job)


def near_pairs(
    viewmats: Mapping[str, NDArray[np.float64]],  # [4, 4] world to camera by name
) -> set[Pair]:
    """Returns each image paired with the nearest that look in about the same direction."""
    return {
        (min(name, other), max(name, other))
        for name, others in neighbours(viewmats).items() for other in others[:matching.NEAREST]}


def neighbours(
    viewmats: Mapping[str, NDArray[np.float64]],  # [4, 4] world to camera by name
) -> dict[str, list[str]]:
    """Returns for each image those that look in about the same direction, nearest first."""
    names = sorted(viewmats)
    matrices = np.stack([viewmats[name] for name in names])
    axes, nearest = matrices[:, 2, :3], {}
    tree = KDTree(_centers(matrices))
    for row, center in enumerate(tree.data):
        _, order = tree.query(center, k=len(names))
        nearest[names[row]] = [
            names[other] for other in np.atleast_1d(order).tolist()
            if other != row and axes[row] @ axes[other] >= np.cos(np.radians(MAX_AXES_DEG))]
    return nearest


def build_known_model(job: MappingJob, report: Reporter) -> ModelResult:
    """Writes the model of the given cameras into out/model and returns what it holds.

    Where poses are a start that the pictures refute, the model of the pictures alone, unless
    `refine` asks for the poses. SfmError if too few frames have a pose, or the poses do not fit the
    images.
    """
    known = _read_poses(job)
    if job.pose_use == "keep":
        return _keep(job, known, report)
    matched = StepFolder(job.out).find("matches", MatchesResult)
    assert matched is not None, "matches come before the model"
    share = matched.poses_share
    if share is None or share >= MIN_PAIR_EXPLAINED:
        checks.check_registered(job.names, list(known.viewmats), 0.0)
        report.phase("mapping", len(job.names))
        try:
            return _start_from(job, known, matched.poses_contradicted)
        except SfmError as error:
            if job.pose_use == "refine":
                raise
            reason = error.message
        matching_again = fallbacks.list_fallbacks(job)[0].choose_pairs(job, report)
        matching.match_pairs(job, matching_again, report)
    else:
        reason = _misfit(share, MIN_PAIR_EXPLAINED).message
    found = fallbacks.build_model(job, report)
    return replace(
        found, notes=(f"{reason} The cameras were found from the pictures alone.", *found.notes),
        poses=PosesSummary(use="refuted", metric=known.metric))


def _keep(job: MappingJob, known: KnownPoses, report: Reporter) -> ModelResult:
    """Writes the model of the cameras as they are given."""
    checks.check_registered(job.names, list(known.viewmats), 0.0)
    report.phase("mapping", len(job.names))
    if "features" not in job.steps:
        model, verdict = _build_given_model(job, known), None
        notes = [_check_some(job, known).describe()]
    else:
        posed = build_posed_model(job.database, None, _rigid(known.viewmats, known.viewmats))
        model = mapper.triangulate(job, posed, refine_intrinsics=bool(_uncalibrated_cameras(job)))
        _check_confirmed(job, model)
        verdict = examine(
            model, job.database, sorted(known.viewmats), sharpness=job.sharpness, times=job.times,
            given=True)
        check_weak_link(verdict, job.accept_weak, given=True)
        notes = []
    return _write(job, model, verdict, notes, PosesSummary(use="keep", metric=known.metric))


def _start_from(
    job: MappingJob, known: KnownPoses, contradicted: Collection[str]
) -> ModelResult:
    """Writes the model that the matches and the given cameras give together."""
    start = {name: view for name, view in known.viewmats.items() if name not in contradicted}
    fixed = set(range(1, len(job.groups) + 1)) - _uncalibrated_cameras(job)
    found = tracked_poses.adjust_tracked(job, start, fixed)
    model, names = found.model, mapper.list_registered(found.model)
    _check_confirmed(job, model)
    verdict = examine(
        model, job.database, names, sharpness=job.sharpness, times=job.times, given=True)
    check_weak_link(verdict, job.accept_weak, given=True)
    notes = tracked_poses.describe_tracked(found, len(verdict.model_parts))
    tracked_poses.add_prior_poses(model, found.held, start)
    both = [name for name in mapper.list_registered(model) if name in start]
    given = np.stack([start[name] for name in both])
    model.transform(align_to_given(_viewmats(model, both), given))
    model.extract_colors_for_all_images(job.frames, job.threads)  # which only mappers do
    moved = measure_movement(_viewmats(model, both), given)
    return _write(job, model, verdict, notes, PosesSummary(
        use=job.pose_use, metric=known.metric, held=len(found.held),
        reprojection_error_px_before=found.error_before, **moved))


def _check_some(job: MappingJob, known: KnownPoses) -> SpotCheck:
    """Returns how well sampled images agree with the poses; SfmError if they do not."""
    check = spot_check(job, known.viewmats)
    if not check.fits:
        raise _misfit(check.share or 0.0, MIN_PAIR_EXPLAINED)
    return check


def _check_confirmed(job: MappingJob, model: pycolmap.Reconstruction) -> None:
    """Raises SfmError where the points confirm too few of the verified matches."""
    matches = sum(count for _, count, _ in database.count_inliers(job.database))
    lengths = np.array([point.track.length() for point in model.points3D.values()])
    share = float((lengths * (lengths - 1) / 2).sum()) / max(1, matches)
    if share < MIN_CONFIRMED:
        raise _misfit(share, MIN_CONFIRMED)


def _write(
    job: MappingJob, model: pycolmap.Reconstruction, verdict: ModelVerdict | None,
    notes: Sequence[str], poses: PosesSummary,
) -> ModelResult:
    parts.write_parts(job, [(model, verdict)])
    shutil.rmtree(job.attempts, ignore_errors=True)
    return ModelResult(
        parts=(parts.list_part(model),), notes=tuple(notes),
        models=(model.num_reg_images(),), poses=poses, apart=(), attempts=())


def _read_poses(job: MappingJob) -> KnownPoses:
    """Returns the poses of the job's frames."""
    assert job.poses is not None
    known, names = read_poses(job.poses), set(job.names)
    viewmats = {name: matrix for name, matrix in known.viewmats.items() if name in names}
    return replace(known, viewmats=viewmats)


def _build_given_model(job: MappingJob, known: KnownPoses) -> pycolmap.Reconstruction:
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


def _rigid(
    viewmats: Mapping[str, NDArray[np.float64]], names: Collection[str]
) -> dict[str, pycolmap.Rigid3d]:
    return {name: pycolmap.Rigid3d(viewmats[name][:3]) for name in names}


def _misfit(share: float, least: float) -> SfmError:
    return SfmError(
        f"The given poses do not fit the images: {share:.0%} of the matches agree with them, but "
        f"at least {least:.0%} should.",
        hint="Check the axes convention of the poses, or let recon find the cameras with "
        "--poses ignore.")


def align_to_given(refined: Poses, given: Poses) -> pycolmap.Sim3d:
    """Returns the similarity that brings cameras closest to the given ones.

    The rotation is the mean over the cameras, so that it is determined even if the centres lie on
    one line; scale and translation are least squares over the centres.
    """
    turns = Rotation.from_matrix(given[:, :3, :3].transpose(0, 2, 1) @ refined[:, :3, :3])
    turn = turns.mean()
    ours, theirs = turn.apply(_centers(refined)), _centers(given)
    spread, aim = ours - ours.mean(axis=0), theirs - theirs.mean(axis=0)
    size = float((spread**2).sum())
    scale = float((spread * aim).sum()) / size if size > 0 else 1.0
    return pycolmap.Sim3d(
        scale, pycolmap.Rotation3d(turn.as_quat()), theirs.mean(axis=0) - scale * ours.mean(axis=0))


def measure_movement(refined: Poses, given: Poses) -> dict[str, float]:
    """Returns how far cameras lie from where they were given; see `PosesSummary`."""
    centers = _centers(given)
    size = float(np.linalg.norm(np.ptp(centers, axis=0))) or 1.0
    steps = np.linalg.norm(_centers(refined) - centers, axis=1) / size
    turns = Rotation.from_matrix(
        given[:, :3, :3].transpose(0, 2, 1) @ refined[:, :3, :3]).magnitude()
    return {
        "moved_median": float(np.median(steps)), "moved_max": float(steps.max()),
        "turned_median_deg": float(np.degrees(np.median(turns))),
        "turned_max_deg": float(np.degrees(turns.max()))}


def _uncalibrated_cameras(job: MappingJob) -> set[int]:
    """Returns the ids of the cameras whose intrinsics are not known."""
    return {camera for camera, group in enumerate(job.groups, start=1) if group.lens is None}


def _viewmats(model: pycolmap.Reconstruction, names: Collection[str]) -> Poses:
    return np.array([viewmat_of(model.find_image_with_name(name)) for name in names])


def _centers(viewmats: Poses) -> NDArray[np.float64]:
    return np.asarray(-np.einsum("fji,fj->fi", viewmats[:, :3, :3], viewmats[:, :3, 3]))


@dataclass(frozen=True)
class SpotCheck:
    """How well sampled pairs of images agree with given poses."""

    matches: int  # verified, of all pairs
    share: float | None  # of them that agree with the poses; None where there are too few

    @property
    def fits(self) -> bool:
        """Whether the poses can be used."""
        return self.share is None or self.share >= MIN_PAIR_EXPLAINED

    def describe(self) -> str:
        """Returns a sentence for the terminal."""
        if self.share is None:
            return f"The given poses could not be checked: too few matches ({self.matches})."
        return (f"{self.share:.0%} of {self.matches} matches between sampled images agree with the "
                "given poses.")


def spot_check(
    job: MappingJob,
    viewmats: Mapping[str, NDArray[np.float64]],  # [4, 4] world to camera by name
) -> SpotCheck:
    """Returns how well sampled pairs of images agree with the poses; every lens is known."""
    names, near = sorted(viewmats), neighbours(viewmats)
    places = {names[int((i + 0.5) * len(names) / PLACES)] for i in range(PLACES)}
    wanted = {
        (min(name, other), max(name, other)) for name in places
        for other in (near[name][k] for k in NEIGHBOURS if k < len(near[name]))}
    sampled = {name for pair in wanted for name in pair}
    groups = tuple(
        replace(group, names=chosen) for group in job.groups
        if (chosen := tuple(name for name in group.names if name in sampled)))
    sample = replace(
        job, out=fresh_folder(job.attempts / "check"), groups=groups,
        max_features=COARSEST_KEYPOINTS)
    silent = Reporter(io.BytesIO())
    matching.create_database(sample)
    try:
        features.extract_features(sample, silent)
        matching.match_pairs(sample, wanted, silent)
        evidence = gather_evidence(
            build_posed_model(sample.database, None, _rigid(viewmats, sample.names)),
            sample.database, sample.names)
        matches, agreeing = int(evidence.matches.sum()), int(evidence.agreeing.sum())
    except SfmError:  # hardly any texture
        matches, agreeing = 0, 0
    shutil.rmtree(sample.out)
    return SpotCheck(matches, agreeing / matches if matches >= MIN_SPOT_MATCHES else None)
