"""Whether a finished model can be trusted, and everything known about why not.

The share of registered images and the reprojection error do not see the worst failures: two good
halves placed wrongly to each other (`weakest_cut`), two places laid over each other
(`visual_aliasing`), a walk whose scale changes on its way (`scale_drift`, `open_loops`), a text
over bare walls (`still_points`), and a lens that is not what its camera model says (`lens_trial`).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import MOST_NAMED, SfmError, format_count, list_names, name_command
from recon_cli.io.colmap_library import pycolmap
from recon_cli.sfm.features.sphere import is_panorama
from recon_cli.sfm.features.still_points import MAX_STILL, find_still_share
from recon_cli.sfm.limits import FEW_KEYPOINTS, MIN_EXPLAINED, MIN_ONE_POINT, MIN_POSE_INLIERS
from recon_cli.sfm.mapping.lens_trial import BetterLens, find_better_lenses
from recon_cli.sfm.verdict import camera_covariance, view_graph, visual_aliasing
from recon_cli.sfm.verdict.evidence import MatchEvidence, gather_evidence
from recon_cli.sfm.verdict.open_loops import OpenLoop, find_open_loops
from recon_cli.sfm.verdict.scale_drift import (
    ScaleCut,
    describe_scale,
    find_weakest_scale,
    is_scale_known,
)
from recon_cli.sfm.verdict.visual_aliasing import VisualAliasing
from recon_cli.sfm.verdict.weakest_cut import OutlierCamera, WeakestCut, find_weakest_cut
from recon_cli.workspace.json_record import KEY, JsonRecord

# A jump is a step of this multiple of the usual one, the median of those around it. Longest steps
# measured: 1.1 to 2.8 in good models, 9 to 20 where cameras are displaced.
MAX_STEP = 6.0
WINDOW = 15  # steps; a median over fewer follows the jump itself
MIN_STEPS = WINDOW // 3  # fewer say nothing about what is usual
# Longer steps cannot be a cut in a video: displaced cameras gave 9 to 20, a walk's end at rest 6.
MAX_LEAP = 100.0
# Share of the median sharpness below which an image is called blurred, as in IngestConfig.
BLURRED = 0.5
BINS = 10
# Shift of the principal point as a share of the longer side. Measured: 0 to 0.03 in sound models of
# ten and more frames. Where it was held in the middle instead, cameras moved by 1% of the extent at
# shifts of 0.06 and 0.09, but by 10% and 20% at 0.12 and 0.36; 0.11 in a walk torn in two places.
MAX_SHIFT = 0.1

Names = tuple[str, ...]


@dataclass(frozen=True)
class Jump(JsonRecord):
    """A step between two images that follow each other."""

    before: str
    after: str
    ratio: float  # of its length to the usual step around it, gaps in time taken into account


@dataclass(frozen=True)
class Histogram(JsonRecord):
    """How many values fall between edges."""

    edges: tuple[int, ...]  # bin k holds the values from edges[k] up to, but without, edges[k + 1]
    counts: tuple[int, ...]
    median: float  # of all values; zero without any

    @classmethod
    def from_values(cls, values: NDArray[np.int64]) -> Histogram:
        """Returns the histogram of whole numbers, [N], from zero up, in ten bins of one width."""
        top = int(values.max()) if len(values) else 0
        width = top // BINS + 1
        counts = np.bincount(values // width, minlength=BINS)
        return cls(
            tuple(range(0, (BINS + 1) * width, width)), tuple(counts.tolist()),
            float(np.median(values)) if len(values) else 0.0)


@dataclass(frozen=True)
class ModelVerdict(JsonRecord):
    """Whether a model can be trusted, and why not; images by name."""

    images: int  # that were given to the mapper
    registered: int  # images with a camera
    # Cameras that see points in common, directly or through others; the largest first.
    model_parts: tuple[Names, ...]
    # The same of all images and verified matches: what could be mapped together.
    match_parts: tuple[Names, ...]
    weakest_cut: WeakestCut = field(metadata={KEY: "weak_link"})
    aliasing: VisualAliasing = field(metadata={KEY: "fold"})
    outliers: tuple[OutlierCamera, ...] = field(metadata={KEY: "astray"})
    unregistered: Mapping[str, str]  # why each image without a camera has none
    jumps: tuple[Jump, ...]  # far too long steps of the camera; empty unless a video
    keypoints: Histogram  # of each image
    points: Histogram  # of the model that each camera sees
    neighbours: Histogram  # of each camera, those with which it shares MIN_POSE_INLIERS points
    still: float  # share of the points in three or more images that do not move in them
    # Where the relative scale of both sides is known least, of a walk between the stretches of an
    # open loop where there is one; None where nothing tells.
    scale: ScaleCut | None
    open_loops: tuple[OpenLoop, ...]  # the one that most points show first
    problems: tuple[str, ...]  # why the model cannot be trusted, a sentence each
    lenses: tuple[BetterLens, ...] = ()  # cameras that another camera model fits better
    # Of photos: how far the centre of each camera is likely off, as a share of the extent of all.
    camera_errors: camera_covariance.Errors = field(default_factory=dict)
    rough: Names = ()  # those of them that are known badly, though nothing speaks against them

    @property
    def trusted(self) -> bool:
        """Whether nothing speaks against the model."""
        return not self.problems

    def lines(self) -> list[str]:
        """Returns a short text for the terminal."""
        head = "trusted" if self.trusted else "not to be trusted"
        lines = [f"{self.registered} of {format_count(self.images, 'image')} "
                 f"{'has' if self.registered == 1 else 'have'} a camera; the model is {head}."]
        lines += self.problems or self._reassurances()
        lines += camera_covariance.describe_rough(self.camera_errors, self.rough)
        lines += [
            f"Step {jump.ratio:.0f} times as long as usual: {jump.before} to {jump.after}."
            for jump in self.jumps]
        missing = list(self.unregistered.items())
        lines += [f"{name} has no camera: {reason}." for name, reason in missing[:MOST_NAMED]]
        if len(missing) > MOST_NAMED:
            more = len(missing) - MOST_NAMED
            lines.append(f"{more} more {'has' if more == 1 else 'have'} no camera.")
        return lines

    def _reassurances(self) -> Iterator[str]:
        cut, aliasing = self.weakest_cut, self.aliasing
        shares = []
        if cut.share is not None:
            shares.append(f"{cut.share:.0%} of the matches across the weakest cut are triangulated "
                          "to one shared point")
        if cut.explained is not None:
            shares.append(f"the cameras explain {cut.explained:.0%} of the matches")
        if shares:
            yield f"Weakest cut, between {_sides(cut.sides)}: {', and '.join(shares)}."
        if aliasing.share is not None:
            yield (f"Least overlap: two groups of cameras see {aliasing.share:.0%} as much of the "
                   "surfaces that they should share as cameras within one group do.")
        if self.scale is not None:
            yield describe_scale(self.scale)
        if self.camera_errors:
            yield (f"Cameras: known to {camera_covariance.measure_rms(self.camera_errors):.1%} of "
                   "their extent (RMS).")

    def to_json(self) -> dict[str, Any]:
        """Returns JSON values: the fields, and whether the model is trusted."""
        return {**super().to_json(), "trusted": self.trusted}


def examine(
    model: pycolmap.Reconstruction,
    database: Path,  # of COLMAP; Python's SQLite must not have it open
    names: Sequence[str],  # of all images given to the mapper; the database may hold more
    *,
    sharpness: Mapping[str, float | None] | None = None,  # variance of the Laplacian, where known
    times: Mapping[str, float | None] | None = None,  # seconds in the video, where known
    given: bool = False,  # the poses are, so that nothing drifts
    lenses: Collection[int] = (),  # the cameras whose lens is not known
) -> ModelVerdict:
    """Returns the verdict on a finished model, or raises ValueError if its names do not match."""
    evidence = gather_evidence(model, database, names)
    order = find_order(evidence, times or {})
    weakest_cut, outliers = find_weakest_cut(evidence, order)
    loops, scale = ((), None) if given else _find_drift(model, evidence, order)
    overlap = visual_aliasing.measure_overlap(model, evidence)
    aliasing = visual_aliasing.find_aliasing(evidence, overlap)
    rows = evidence.registered
    placed = [name for name, has_camera in zip(names, rows, strict=True) if has_camera]
    model_parts = _parts(placed, evidence.shared[np.ix_(rows, rows)].astype(np.float64))
    match_parts = _parts(names, view_graph.weights(len(names), evidence.pairs, evidence.matches))
    jumps = find_jumps(evidence, times or {})
    still = find_still_share(model)
    better = find_better_lenses(model, lenses)
    points = {name: int(count)
              for name, count in zip(names, evidence.points, strict=True) if count}
    errors = {} if given or times else camera_covariance.estimate_camera_errors(
        model, tuple(points))
    problems = (*_describe_problems(model_parts, weakest_cut, aliasing, outliers, jumps),
                *_describe_drift(loops, scale), *_describe_still(still),
                *camera_covariance.describe_inexact(errors),
                *describe_shifted_centres(model, database),
                *(lens.sentence() for lens in better if lens.is_wrong))
    if not problems:  # without them a broken model would look better than it is
        outliers = tuple(camera_covariance.list_loose(errors, evidence))
        problems = tuple(_describe_outliers(outliers))
    return ModelVerdict(
        images=len(names), registered=int(np.count_nonzero(rows)),
        model_parts=model_parts, match_parts=match_parts,
        weakest_cut=weakest_cut, aliasing=aliasing, outliers=outliers,
        unregistered=explain_unregistered(evidence, sharpness or {}), jumps=jumps,
        keypoints=Histogram.from_values(evidence.keypoints),
        points=Histogram.from_values(evidence.points[rows]),
        neighbours=Histogram.from_values(
            np.count_nonzero(evidence.shared[rows] >= MIN_POSE_INLIERS, axis=1)),
        still=still, scale=scale, open_loops=loops, lenses=better,
        camera_errors=errors, rough=camera_covariance.list_rough(errors, points),
        problems=problems)


def _find_drift(
    model: pycolmap.Reconstruction, evidence: MatchEvidence, order: NDArray[np.int64] | None
) -> tuple[tuple[OpenLoop, ...], ScaleCut | None]:
    """Returns the loops of a walk that are open, and the cut where the scale is known least."""
    loops = () if order is None else find_open_loops(evidence, order)
    ends = (loops[0].first, loops[0].second) if loops else None
    return loops, find_weakest_scale(model, evidence, order, between=ends)


def has_drifted(verdict: ModelVerdict) -> bool:
    """Returns whether the scale or direction of a walk changes on its way, or may do so."""
    return bool(verdict.open_loops) or not is_scale_known(verdict.scale)


def is_broken(cut: WeakestCut) -> bool:
    """Returns whether too few matches across a cut show one point, or fit the cameras."""
    return _is_torn(cut) or (cut.explained is not None and cut.explained < MIN_EXPLAINED)


def _is_torn(cut: WeakestCut) -> bool:
    return cut.share is not None and cut.share < MIN_ONE_POINT


def is_aliased(aliasing: VisualAliasing) -> bool:
    """Returns whether two groups of cameras show too little of what both should show."""
    return aliasing.share is not None and aliasing.share < visual_aliasing.MIN_OVERLAP


def check_weak_link(verdict: ModelVerdict, accept: bool, *, given: bool = False) -> None:
    """Raises SfmError for a model that cannot be trusted, unless `accept` (--accept-weak).

    Cameras that were `given` may leap, need no points in common and may be off by some pixels:
    only points that are two in place of one refute them.
    """
    cut = verdict.weakest_cut
    refuted = [*(_describe_break(cut) if _is_torn(cut) else ()),
               *_describe_aliasing(verdict.aliasing)]
    problems = refuted if given else verdict.problems
    if accept or not problems:
        return
    wrong = [lens for lens in verdict.lenses if lens.is_wrong]
    if len(problems) == len(wrong):  # nothing else speaks against it
        raise SfmError(" ".join(problems), hint=(
            f"Use --camera-model {wrong[0].better}, or keep the model as it is with "
            "--accept-weak."))
    raise SfmError(
        " ".join(problems),
        hint=f"Use more frames between the two parts ({name_command('ingest --frames N')}), match "
        "all of them (--pairs exhaustive), or keep the model as it is with --accept-weak.")


def _parts(names: Sequence[str], weights: view_graph.Weights) -> tuple[Names, ...]:
    return tuple(tuple(names[index] for index in part) for part in view_graph.components(weights))


def _describe_problems(
    parts: Sequence[Names], cut: WeakestCut, aliasing: VisualAliasing,
    outliers: Sequence[OutlierCamera], jumps: Sequence[Jump],
) -> list[str]:
    problems = [*_describe_break(cut), *_describe_aliasing(aliasing)]
    if len(parts) > 1:
        sizes = ", ".join(str(len(part)) for part in parts)
        problems.append(f"The model has {len(parts)} parts, which share no point; cameras in each: "
                        f"{sizes}.")
    problems += _describe_outliers(outliers)
    return problems + [
        f"The camera jumps from {jump.before} to {jump.after}: {jump.ratio:.0f} times as far as "
        f"usual, but at most {MAX_LEAP:.0f} times is possible."
        for jump in jumps if jump.ratio > MAX_LEAP]


def _describe_outliers(outliers: Sequence[OutlierCamera]) -> list[str]:
    return [] if not outliers else [
        "These cameras contradict the matches of their images: "
        f"{list_names([camera.name for camera in outliers])}."]


def _describe_drift(loops: Sequence[OpenLoop], cut: ScaleCut | None) -> list[str]:
    where = f" between {cut.before} and {cut.after}" if cut else ""
    if loops:
        loop = loops[0]
        return [
            f"{loop.first} and {loop.second} show the same place "
            f"({format_count(loop.points, 'point')} in {format_count(loop.pairs, 'pair')} of "
            "images match), but the model contains it twice, with scales "
            f"{abs(loop.scale - 1):.0%} apart and turned by {loop.turn_deg:.0f} degrees: the "
            f"cameras drifted, most likely{where or ' in between'}."]
    return [] if cut is None or is_scale_known(cut) else [describe_scale(cut)]


def _describe_still(share: float) -> list[str]:
    if share <= MAX_STILL:
        return []
    return [
        f"{share:.0%} of the points do not move in the image (an overlay or dirt on the lens), but "
        f"at most {MAX_STILL:.0%} may."]


def _describe_break(cut: WeakestCut) -> list[str]:
    if not is_broken(cut):
        return []
    if _is_torn(cut):
        return [
            f"The model is broken: of the matches between the closest images of "
            f"{_sides(cut.sides)}, only {cut.share:.0%} are triangulated to one shared point, but "
            f"{MIN_ONE_POINT:.0%} are needed."]
    return [
        f"The model is broken: of the matches between the closest images of {_sides(cut.sides)}, "
        f"only {cut.explained:.0%} agree with the cameras, but {MIN_EXPLAINED:.0%} must."]


def _describe_aliasing(aliasing: VisualAliasing) -> list[str]:
    if not is_aliased(aliasing):
        return []
    return [
        f"{_sides(aliasing.sides)} should see the same surfaces, but share only "
        f"{aliasing.share:.0%} as much of them as images within one side do, and "
        f"{visual_aliasing.MIN_OVERLAP:.0%} is needed: the model is broken between them, or two "
        "places that look alike were placed on top of each other."]


def _sides(sides: tuple[Names, Names]) -> str:
    first, second = sides
    named = f"{format_count(len(first), 'camera')} ({list_names(first, most=3)})"
    return f"{named} and the {format_count(len(second), 'other')}"


def find_jumps(evidence: MatchEvidence, times: Mapping[str, float | None]) -> tuple[Jump, ...]:
    """Returns the steps that are far too long; none where the images are not known to be a video.

    A video is known by the times of all its cameras, in seconds, or by names that are all numbers.
    """
    rows = np.flatnonzero(evidence.registered)
    moments = _moments([evidence.names[row] for row in rows], times)
    if moments is None or len(rows) <= MIN_STEPS:
        return ()
    order = np.argsort(moments, kind="stable")
    rows, gaps = rows[order], np.diff(moments[order])
    steps = np.linalg.norm(np.diff(evidence.centers[rows], axis=0), axis=1)
    # A gap of ten frames is allowed ten steps; frames closer than usual are not held to less.
    lengths = steps / np.maximum(gaps / max(float(np.median(gaps)), 1e-9), 1.0)
    jumps = []
    for index, (before, after) in enumerate(pairwise(rows)):
        near = lengths[max(0, min(index - WINDOW // 2, len(lengths) - WINDOW)):][:WINDOW]
        ratio = lengths[index] / max(float(np.median(near)), 1e-12)
        if ratio > MAX_STEP:
            jumps.append(Jump(evidence.names[before], evidence.names[after], float(ratio)))
    return tuple(jumps)


def find_order(
    evidence: MatchEvidence, times: Mapping[str, float | None]
) -> NDArray[np.int64] | None:
    """Returns the images with a camera as they were taken; None where that is not known."""
    rows = np.flatnonzero(evidence.registered)
    moments = _moments([evidence.names[row] for row in rows], times)
    return None if moments is None else rows[np.argsort(moments, kind="stable")]


def _moments(names: Sequence[str], times: Mapping[str, float | None]) -> NDArray[np.float64] | None:
    """Returns when each image was taken, in any unit, [F]; None where that is not known."""
    seconds = [times.get(name) for name in names]
    if all(second is not None for second in seconds):
        return np.array(seconds, np.float64)
    stems = [PurePath(name).stem for name in names]
    if all(stem.isdecimal() for stem in stems):
        return np.array([float(stem) for stem in stems])
    return None


def explain_unregistered(
    evidence: MatchEvidence, sharpness: Mapping[str, float | None]
) -> dict[str, str]:
    """Returns the most likely reason for every image that has no camera."""
    known = [value for value in sharpness.values() if value is not None]
    usual = float(np.median(known)) if known else None
    return {
        evidence.names[index]: _reason(evidence, int(index), sharpness, usual)
        for index in np.flatnonzero(~evidence.registered)}


def _reason(
    evidence: MatchEvidence, index: int, sharpness: Mapping[str, float | None], usual: float | None
) -> str:
    of = (evidence.pairs == index).any(axis=1)
    others = evidence.pairs[of].sum(axis=1) - index
    placed, matches = evidence.registered[others], evidence.matches[of]
    own = sharpness.get(evidence.names[index])
    blur = ""
    if own is not None and usual is not None and own < BLURRED * usual:
        blur = f"sharpness {own:.0f}, {usual:.0f} is usual"
    # A blurred image matches little. One that matches others well may show another room.
    if blur and matches[~placed].sum() <= matches[placed].sum():
        return f"blurred: {blur}"
    if evidence.keypoints[index] < FEW_KEYPOINTS:
        return f"too few features: {format_count(int(evidence.keypoints[index]), 'keypoint')}"
    if not placed.any():
        where = f", only with {len(others)} without one" if len(others) else ""
        also = f"; {blur}" if blur else ""
        return f"no overlap: no verified match with an image that has a camera{where}{also}"
    count, images = int(matches[placed].sum()), int(np.count_nonzero(placed))
    return (f"matched but not placed: {format_count(count, 'match')} to "
            f"{format_count(images, 'image')} with a camera")


def describe_shifted_centres(model: pycolmap.Reconstruction, database: Path) -> list[str]:
    """Returns a sentence for each camera whose principal point moved too far.

    The database holds the cameras before mapping, under the same ids.
    """
    with pycolmap.Database.open(database) as opened:
        initial = {camera.camera_id: camera for camera in opened.read_all_cameras()}
    shifts = {number: _shift(camera, initial[number])
              for number, camera in sorted(model.cameras.items())
              if number in initial and not is_panorama(camera)}
    return [
        f"The principal point of camera {number} moved by {shift:.0%} of the image's longer side, "
        f"at most {MAX_SHIFT:.0%} is usual: parts of the model may be displaced against each other."
        for number, shift in shifts.items() if shift > MAX_SHIFT]


def _shift(camera: pycolmap.Camera, initial: pycolmap.Camera) -> float:
    off = math.hypot(camera.principal_point_x - initial.principal_point_x,
                     camera.principal_point_y - initial.principal_point_y)
    return off / float(max(camera.width, camera.height))
