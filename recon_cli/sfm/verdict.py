"""Whether a finished model can be trusted, and everything known about why not.

The share of registered images and the reprojection error do not see the worst failures: two good
halves set wrongly to each other (`weak_link`), and two places laid over each other (`fold`). Where
only neighbours were matched, neither sees a half that has the wrong size and nothing else wrong.

This only looks; what follows from it, the mapper and the stage decide.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from recon_cli.errors import SfmError
from recon_cli.sfm import (
    checks,
    outlier_cameras,
    view_graph,
    visual_aliasing,
    weakest_cut,
)
from recon_cli.sfm import evidence as facts
from recon_cli.sfm import (
    outlier_cameras as unplaced,
)
from recon_cli.sfm import (
    visual_aliasing as overlap,
)
from recon_cli.sfm.checks import Histogram, listed
from recon_cli.sfm.evidence import Evidence
from recon_cli.sfm.outlier_cameras import Jump
from recon_cli.sfm.visual_aliasing import MIN_OVERLAP, Fold
from recon_cli.sfm.weakest_cut import MIN_MATCHES, MIN_WEAK_LINK, Astray, WeakLink

# Steps this much longer than the usual one are no cut in a video any more: displaced cameras gave 9
# to 20, a walk that ends at rest 6.
MAX_LEAP = 100.0
MOST_LINES = 5  # for images without a camera; all of them are in the verdict

Names = tuple[str, ...]


@dataclass(frozen=True)
class Verdict:
    """What an examination of a model found; images by name.

    Attributes:
        images: how many were given to the mapper.
        registered: how many have a camera.
        model_parts: cameras that see points in common, directly or through others; the largest part
            first. A sound model is one part.
        match_parts: the same of all images and verified matches: what could be mapped together.
        weak_link: the cut whose matches agree least with the poses.
        fold: the groups of cameras that show least of what they should show in common.
        astray: cameras that their own matches contradict; they can be dropped.
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
    weak_link: WeakLink
    fold: Fold
    astray: tuple[Astray, ...]
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
        """Returns the verdict as JSON can hold it, with `trusted` beside the fields."""
        return {**dataclasses.asdict(self), "trusted": self.trusted}

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> Verdict:
        """Returns the verdict that `to_json` gave, also after a way through a file."""
        return cls(
            images=value["images"],
            registered=value["registered"],
            model_parts=_names(value["model_parts"]),
            match_parts=_names(value["match_parts"]),
            weak_link=WeakLink(**{
                **value["weak_link"], "sides": _names(value["weak_link"]["sides"])}),
            fold=Fold(**{**value["fold"], "sides": _names(value["fold"]["sides"])}),
            astray=tuple(Astray(**item) for item in value["astray"]),
            unregistered=dict(value["unregistered"]),
            jumps=tuple(Jump(**item) for item in value["jumps"]),
            keypoints=Histogram.from_json(value["keypoints"]),
            points=Histogram.from_json(value["points"]),
            neighbours=Histogram.from_json(value["neighbours"]),
            problems=tuple(value["problems"]),
        )


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
        model: the reconstruction; it is left as it is.
        database: COLMAP's database with the features and verified matches of the images; no other
            program, nor Python's SQLite in this process, may have it open.
        names: of all images that were given to the mapper; the database may hold more.
        sharpness: variance of the Laplacian of each image, where known.
        times: seconds of each image in the video, where known.

    Raises:
        ValueError: the database lacks an image, or the model holds one that is not in `names`.
    """
    evidence = facts.gather(model, database, names)
    common = overlap.measure(model, evidence)
    link, astray = weakest_cut.find(evidence, common)
    doubled = visual_aliasing.find(evidence, common)
    parts = _model_parts(evidence)
    jumps = outlier_cameras.jumps(evidence, times or {})
    rows = evidence.registered
    return Verdict(
        images=len(names),
        registered=int(np.count_nonzero(rows)),
        model_parts=parts,
        match_parts=_match_parts(evidence),
        weak_link=link,
        fold=doubled,
        astray=astray,
        unregistered=unplaced.reasons(evidence, sharpness or {}),
        jumps=jumps,
        keypoints=Histogram.of(evidence.keypoints),
        points=Histogram.of(evidence.points[rows]),
        neighbours=Histogram.of(np.count_nonzero(evidence.shared[rows] >= MIN_MATCHES, axis=1)),
        problems=(*_problems(parts, link, doubled, astray), *_leaps(jumps),
                  *checks.bent(model, database)),
    )


def check_weak_link(verdict: Verdict, accept: bool) -> None:
    """Raises SfmError when a model is set together wrongly and the user did not accept that.

    Args:
        verdict: on the model that is to be kept.
        accept: pass in any case (--accept-weak).
    """
    sentences = [*_broken(verdict.weak_link), *_folded(verdict.fold)]
    if accept or not sentences:
        return
    raise SfmError(
        " ".join(sentences),
        hint="Use more frames of the way between the two parts (recon ingest --frames N), match "
        "all of them (--pairs exhaustive), or keep the model as it is with --accept-weak.")


def _model_parts(evidence: Evidence) -> tuple[Names, ...]:
    rows = np.flatnonzero(evidence.registered)
    shared = evidence.shared[np.ix_(rows, rows)].astype(np.float64)
    return tuple(
        tuple(evidence.names[rows[index]] for index in part)
        for part in view_graph.components(shared))


def _match_parts(evidence: Evidence) -> tuple[Names, ...]:
    matches = view_graph.weights(len(evidence.names), evidence.pairs, evidence.matches)
    return tuple(
        tuple(evidence.names[index] for index in part) for part in view_graph.components(matches))


def _problems(
    parts: Sequence[Names], link: WeakLink, doubled: Fold, astray: Sequence[Astray]
) -> list[str]:
    problems = [*_broken(link), *_folded(doubled)]
    if len(parts) > 1:
        sizes = ", ".join(str(len(part)) for part in parts)
        problems.append(f"The model is in {len(parts)} parts of {sizes} cameras without a point "
                        "in common.")
    if astray:
        problems.append(
            f"Cameras that contradict the matches of their images: "
            f"{listed([item.name for item in astray])}.")
    return problems


def _leaps(jumps: Sequence[Jump]) -> list[str]:
    return [
        f"The camera leaps from {jump.before} to {jump.after}: {jump.ratio:.0f} times as far as "
        f"usual, at most {MAX_LEAP:.0f} times can be." for jump in jumps if jump.ratio > MAX_LEAP]


def _broken(link: WeakLink) -> list[str]:
    if link.share is None or link.share >= MIN_WEAK_LINK:
        return []
    return [
        f"The model is broken: of the {link.matches} matches between {_sides(link.sides)}, "
        f"{link.share:.0%} agree with the cameras, at least {MIN_WEAK_LINK:.0%} must."]


def _folded(doubled: Fold) -> list[str]:
    if doubled.share is None or doubled.share >= MIN_OVERLAP:
        return []
    return [
        f"{_sides(doubled.sides)} seem to see the same, but only {doubled.share:.0%} of it is "
        f"found in both, at least {MIN_OVERLAP:.0%} must be: the model is broken between them, or "
        "lays two places over each other that look alike."]


def _reassurances(verdict: Verdict) -> list[str]:
    lines = []
    link, doubled = verdict.weak_link, verdict.fold
    if link.share is not None:
        lines.append(
            f"Weakest link: {link.share:.0%} of {link.matches} matches between "
            f"{_sides(link.sides)} agree with the cameras.")
    if doubled.share is not None:
        lines.append(f"Least overlap: {doubled.share:.0%} of what two groups of cameras should "
                     "both show is found in both.")
    return lines


def _sides(sides: tuple[Names, Names]) -> str:
    first, second = sides
    return f"{len(first)} cameras ({listed(first, most=3)}) and the {len(second)} others"


def _names(value: Sequence[Sequence[str]]) -> Any:
    return tuple(tuple(names) for names in value)
