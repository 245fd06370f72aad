"""Whether a finished model can be trusted, and everything known about why not.

The share of registered images and the reprojection error do not see the worst failures: two good
halves placed wrongly to each other (`weakest_cut`), and two places laid over each other
(`visual_aliasing`). Where only neighbours were matched, neither sees a half whose only fault is its
scale.

Nothing is changed here; the mapper and the stage decide what follows.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from recon_cli.errors import SfmError
from recon_cli.sfm import checks, view_graph
from recon_cli.sfm.checks import list_names
from recon_cli.sfm.evidence import MatchEvidence, gather_evidence
from recon_cli.sfm.visual_aliasing import (
    MIN_OVERLAP,
    VisualAliasing,
    find_aliasing,
    measure_overlap,
)
from recon_cli.sfm.weakest_cut import (
    MIN_AGREEING,
    MIN_MATCHES,
    OutlierCamera,
    WeakestCut,
    find_weakest_cut,
)

# A step is a jump from this multiple of the usual step on, the median of those around it: a camera
# goes slower along a shelf than across the room. Longest steps measured: 1.1 to 2.8 in good models,
# 9 to 20 where cameras are displaced.
MAX_STEP = 6.0
WINDOW = 15  # steps; a median over fewer follows the jump itself
MIN_STEPS = 5  # fewer say nothing about what is usual
# Steps this much longer than the usual one cannot be a cut in a video: displaced cameras gave 9 to
# 20, a walk that ends at rest 6.
MAX_LEAP = 100.0
# COLMAP gives an image a camera from 30 inliers on, and in six of eight captures 19 of 20 images
# had a fifth of their keypoints or more in the model. The fewest of any image with a camera: 450.
MIN_KEYPOINTS = 150
# Share of the median sharpness below which an image is called blurred: the bound of `recon ingest`
# (IngestConfig.sharpness).
BLURRED = 0.5
MOST_LINES = 5  # for images without a camera; all of them are in the verdict
BINS = 10

Names = tuple[str, ...]
_JSON_KEYS = {"weakest_cut": "weak_link", "aliasing": "fold", "outliers": "astray"}


@dataclass(frozen=True)
class Jump:
    """A step between two images that follow each other."""

    before: str
    after: str
    ratio: float  # of its length to the usual step around it, gaps in time taken into account


@dataclass(frozen=True)
class Histogram:
    """How many values fall between edges."""

    edges: tuple[int, ...]  # bin k holds the values from edges[k] up to, but without, edges[k + 1]
    counts: tuple[int, ...]
    median: float  # of all values; zero without any

    @classmethod
    def of(cls, values: NDArray[np.int64]) -> Histogram:
        """Returns the histogram of whole numbers, [N], from zero up, in ten bins of one width."""
        top = int(values.max()) if len(values) else 0
        width = top // BINS + 1
        counts = np.bincount(values // width, minlength=BINS)
        return cls(
            tuple(range(0, (BINS + 1) * width, width)),
            tuple(int(count) for count in counts),
            float(np.median(values)) if len(values) else 0.0)


@dataclass(frozen=True)
class Verdict:
    """What was found about a model; images by name.

    Attributes:
        images: that were given to the mapper.
        registered: images with a camera.
        model_parts: cameras that see points in common, directly or through others; the largest part
            first. A sound model is one part.
        match_parts: the same of all images and verified matches: what could be mapped together.
        unregistered: why each image without a camera has none.
        jumps: steps of the camera that are far too long; empty unless the images are a video.
        keypoints: of each image.
        points: of the model that each camera sees.
        neighbours: of each camera, those with which it shares MIN_MATCHES points.
        problems: why the model cannot be trusted, a sentence each.
    """

    images: int
    registered: int
    model_parts: tuple[Names, ...]
    match_parts: tuple[Names, ...]
    weakest_cut: WeakestCut
    aliasing: VisualAliasing
    outliers: tuple[OutlierCamera, ...]
    unregistered: Mapping[str, str]
    jumps: tuple[Jump, ...]
    keypoints: Histogram
    points: Histogram
    neighbours: Histogram
    problems: tuple[str, ...]

    @property
    def trusted(self) -> bool:
        """Whether nothing speaks against the model."""
        return not self.problems

    def lines(self) -> list[str]:
        """Returns a short text for the terminal."""
        head = "trusted" if self.trusted else "not to be trusted"
        lines = [f"{self.registered} of {self.images} images have a camera; the model is {head}."]
        lines += self.problems or _reassurances(self)
        lines += [
            f"Step {jump.ratio:.0f} times as long as usual: {jump.before} to {jump.after}."
            for jump in self.jumps]
        missing = list(self.unregistered.items())
        lines += [f"{name} has no camera: {reason}." for name, reason in missing[:MOST_LINES]]
        if len(missing) > MOST_LINES:
            lines.append(f"{len(missing) - MOST_LINES} more have no camera.")
        return lines

    def to_json(self) -> dict[str, Any]:
        """Returns JSON values: the fields, some under their older keys, and `trusted`."""
        values = {_JSON_KEYS.get(name, name): value
                  for name, value in dataclasses.asdict(self).items()}
        return {**values, "trusted": self.trusted}


def examine(
    model: pycolmap.Reconstruction,
    database: Path,
    names: Sequence[str],
    *,
    sharpness: Mapping[str, float | None] | None = None,
    times: Mapping[str, float | None] | None = None,
) -> Verdict:
    """Returns what a finished model and the matches that it came from say about it.

    Args:
        model: the reconstruction; it is not changed.
        database: COLMAP's database of the images; Python's SQLite must not have it open.
        names: of all images that were given to the mapper; the database may hold more.
        sharpness: variance of the Laplacian of each image, where known.
        times: seconds of each image in the video, where known.

    Raises:
        ValueError: the database lacks an image, or the model holds one that is not in `names`.
    """
    evidence = gather_evidence(model, database, names)
    overlap = measure_overlap(model, evidence)
    weakest_cut, outliers = find_weakest_cut(evidence, overlap)
    aliasing = find_aliasing(evidence, overlap)
    parts = _model_parts(evidence)
    jumps = find_jumps(evidence, times or {})
    rows = evidence.registered
    return Verdict(
        images=len(names),
        registered=int(np.count_nonzero(rows)),
        model_parts=parts,
        match_parts=_match_parts(evidence),
        weakest_cut=weakest_cut,
        aliasing=aliasing,
        outliers=outliers,
        unregistered=unregistered_reasons(evidence, sharpness or {}),
        jumps=jumps,
        keypoints=Histogram.of(evidence.keypoints),
        points=Histogram.of(evidence.points[rows]),
        neighbours=Histogram.of(np.count_nonzero(evidence.shared[rows] >= MIN_MATCHES, axis=1)),
        problems=(*_problems(parts, weakest_cut, aliasing, outliers), *_leaps(jumps),
                  *checks.describe_shifted_centres(model, database)),
    )


def check_weak_link(verdict: Verdict, accept: bool) -> None:
    """Raises SfmError for a model that is put together wrongly, unless `accept` (--accept-weak)."""
    sentences = [*_describe_break(verdict.weakest_cut), *_describe_aliasing(verdict.aliasing)]
    if accept or not sentences:
        return
    raise SfmError(
        " ".join(sentences),
        hint="Use more frames between the two parts (recon ingest --frames N), match all of them "
        "(--pairs exhaustive), or keep the model as it is with --accept-weak.")


def _model_parts(evidence: MatchEvidence) -> tuple[Names, ...]:
    rows = np.flatnonzero(evidence.registered)
    shared = evidence.shared[np.ix_(rows, rows)].astype(np.float64)
    return tuple(
        tuple(evidence.names[rows[index]] for index in part)
        for part in view_graph.components(shared))


def _match_parts(evidence: MatchEvidence) -> tuple[Names, ...]:
    matches = view_graph.weights(len(evidence.names), evidence.pairs, evidence.matches)
    return tuple(
        tuple(evidence.names[index] for index in part) for part in view_graph.components(matches))


def _problems(
    parts: Sequence[Names], cut: WeakestCut, aliasing: VisualAliasing,
    outliers: Sequence[OutlierCamera],
) -> list[str]:
    problems = [*_describe_break(cut), *_describe_aliasing(aliasing)]
    if len(parts) > 1:
        sizes = ", ".join(str(len(part)) for part in parts)
        problems.append(f"The model has {len(parts)} parts, of {sizes} cameras, without a point in "
                        "common.")
    if outliers:
        problems.append("These cameras contradict the matches of their images: "
                        f"{list_names([camera.name for camera in outliers])}.")
    return problems


def _leaps(jumps: Sequence[Jump]) -> list[str]:
    return [
        f"The camera leaps from {jump.before} to {jump.after}: {jump.ratio:.0f} times as far as "
        f"usual, but at most {MAX_LEAP:.0f} times is possible."
        for jump in jumps if jump.ratio > MAX_LEAP]


def _describe_break(cut: WeakestCut) -> list[str]:
    if cut.share is None or cut.share >= MIN_AGREEING:
        return []
    return [
        f"The model is broken: only {cut.share:.0%} of the {cut.matches} matches between "
        f"{_sides(cut.sides)} agree with the cameras, but {MIN_AGREEING:.0%} are needed."]


def _describe_aliasing(aliasing: VisualAliasing) -> list[str]:
    if aliasing.share is None or aliasing.share >= MIN_OVERLAP:
        return []
    return [
        f"{_sides(aliasing.sides)} should see the same surfaces, but only {aliasing.share:.0%} of "
        f"them are found in both and {MIN_OVERLAP:.0%} are needed: the model is broken between "
        "them, or two places that look alike lie over each other."]


def _reassurances(verdict: Verdict) -> list[str]:
    lines = []
    cut, aliasing = verdict.weakest_cut, verdict.aliasing
    if cut.share is not None:
        lines.append(f"Weakest link: {cut.share:.0%} of {cut.matches} matches between "
                     f"{_sides(cut.sides)} agree with the cameras.")
    if aliasing.share is not None:
        lines.append(f"Least overlap: {aliasing.share:.0%} of what two groups of cameras should "
                     "both show is found in both.")
    return lines


def _sides(sides: tuple[Names, Names]) -> str:
    first, second = sides
    return f"{len(first)} cameras ({list_names(first, most=3)}) and the {len(second)} others"


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


def _moments(names: Sequence[str], times: Mapping[str, float | None]) -> NDArray[np.float64] | None:
    """Returns when each image was taken, in any unit, [F]; None where that is not known."""
    seconds = [times.get(name) for name in names]
    if all(second is not None for second in seconds):
        return np.array(seconds, np.float64)
    stems = [PurePath(name).stem for name in names]
    if all(stem.isdecimal() for stem in stems):
        return np.array([float(stem) for stem in stems])
    return None


def unregistered_reasons(
    evidence: MatchEvidence, sharpness: Mapping[str, float | None]
) -> dict[str, str]:
    """Returns the most likely reason for every image that has no camera."""
    known = [value for value in sharpness.values() if value is not None]
    usual = float(np.median(known)) if known else None
    return {
        evidence.names[index]: _reason(evidence, int(index), sharpness, usual)
        for index in np.flatnonzero(~evidence.registered)
    }


def _reason(
    evidence: MatchEvidence, index: int, sharpness: Mapping[str, float | None], usual: float | None
) -> str:
    of = (evidence.pairs == index).any(axis=1)
    others = evidence.pairs[of].sum(axis=1) - index
    placed, matches = evidence.registered[others], evidence.matches[of]
    blur = _blur(sharpness.get(evidence.names[index]), usual)
    # A blurred image matches little. One that matches others well may show another room.
    if blur and matches[~placed].sum() <= matches[placed].sum():
        return f"blurred: {blur}"
    if evidence.keypoints[index] < MIN_KEYPOINTS:
        return f"too few features: {evidence.keypoints[index]} keypoints"
    if not placed.any():
        where = f", only with {len(others)} that have none" if len(others) else ""
        also = f"; {blur}" if blur else ""
        return f"no overlap: no verified match with an image that has a camera{where}{also}"
    return (f"matched but not placed: {matches[placed].sum()} matches to "
            f"{np.count_nonzero(placed)} images that have a camera")


def _blur(own: float | None, usual: float | None) -> str:
    """Returns how sharp an image is that is far less sharp than usual; empty for others."""
    if own is None or usual is None or own >= BLURRED * usual:
        return ""
    return f"sharpness {own:.0f}, {usual:.0f} is usual"
