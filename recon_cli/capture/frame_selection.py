"""Which frames of a video or photos of a folder are chosen, and the record of the choice.

From a video: locally sharp frames, spread evenly over the camera's path, one of those that show the
same picture. Frames that are mostly black or blown out count as blurred; the best of them bridge
gaps. Photos are all kept, except those that show nothing or the same view as another, maybe in
another exposure: where one of two equal views is held out, a model is tested on its own training
data.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import percentile_filter

from recon_cli.capture.frame_measures import (
    check_exposure,
    has_content,
    well_exposed,
)
from recon_cli.capture.same_view import (
    PhotoMeasures,
    compare_brightness,
    find_repeats,
    is_same_view,
)
from recon_cli.errors import InputError, list_names
from recon_cli.workspace import atomic
from recon_cli.workspace.records import MIN_FRAMES

CHOICE = "choice.json"
# A frame is compared with the 75th percentile of the 31 around it: a few sharp ones set the level.
GATE_WINDOW, GATE_PERCENTILE = 31, 75
# Path between chosen frames in widths of the image: 94% overlap; 75 frames of a 10 s walk.
FRAME_SPACING = 0.06
# Sharp frames further apart (88% overlap), as in a fast turn, get the least blurred ones between.
MAX_GAP = 2 * FRAME_SPACING
# A plain sharp view fails that test, but is 5 to 10 times sharper than blurred frames of its gap.
MUCH_SHARPER = 2.0
# Frames of a camera that hardly moves, to average out noise.
MIN_AUTOMATIC = 24
# One step counts at most this much: where tracking jumped, a larger one would use up the budget.
MAX_STEP = 0.1
# A shorter path (a third of a pixel in 320) is tracking noise of a camera on a tripod.
NO_MOTION = 0.001
# A shorter path causes a notice.
LITTLE_MOTION = MAX_GAP


class Reason(StrEnum):
    """The decision on a frame."""

    KEPT = "kept"
    DAMAGED = "damaged"
    CLIPPED = "clipped"
    BLURRED = "blurred"
    DUPLICATE = "duplicate"
    EXPOSURE = "exposure"
    CLOSE = "close"


MEANINGS = {
    Reason.KEPT: "kept",
    Reason.DAMAGED: "damaged or unreadable",
    Reason.CLIPPED: "mostly black, blown out or flat",
    Reason.BLURRED: "less sharp than those around it",
    Reason.DUPLICATE: "same view as a kept one",
    Reason.EXPOSURE: "same view as a kept one, in another exposure",
    Reason.CLOSE: "too close to a kept one"}


@dataclass(frozen=True)
class FrameCandidate:
    """One frame of a capture."""

    source: str  # file name
    index: int  # in that video, or among the photos of that folder
    reason: Reason
    sharpness: float | None  # None where it could not be read
    name: str | None = None  # of the stored frame, None where it was not kept
    like: int | None = None  # the kept frame that a duplicate equals, or nearest to one too close


def count_reasons(candidates: Sequence[FrameCandidate]) -> dict[str, int]:
    """Returns how many candidates each reason has, in the order of `Reason`, without zeros."""
    numbers = Counter(candidate.reason for candidate in candidates)
    return {reason.value: numbers[reason] for reason in Reason if numbers[reason]}


def write_choice(path: Path, candidates: Sequence[FrameCandidate]) -> None:
    """Writes the record of a selection as JSON."""
    atomic.write_json(path, {
        "counts": count_reasons(candidates),
        "meanings": {reason.value: text for reason, text in MEANINGS.items()},
        "candidates": [dataclasses.asdict(candidate) for candidate in candidates]})


@dataclass(frozen=True, eq=False)
class Judgement:
    """Which of F frames may be chosen, and why the others may not."""

    usable: NDArray[np.bool_]  # [F]
    bridges: NDArray[np.bool_]  # [F], usable only because a gap would be too wide without
    refused: tuple[Reason | None, ...]  # [F], why a frame is not usable; None where it is


def judge_frames(
    lengths: NDArray[np.float64],  # [F], `path_length`
    sharpness: NDArray[np.float64],  # [F]
    exposures: NDArray[np.float64],  # [F, 3], rows of `measure_exposure`
    intact: NDArray[np.bool_],  # [F], False for damaged frames
    share: float,
    least: int = 0,
) -> Judgement:
    """Returns which frames may be chosen: those that reach `share` of the sharpness around them.

    Blurred ones are used to close gaps, and where there are fewer than `least` otherwise.
    """
    sharp, exposed = sharp_frames(sharpness, share), well_exposed(exposures)
    filled = has_content(exposures)
    good, possible = sharp & exposed & filled, intact & filled
    usable = bridge_gaps(lengths, sharpness, good, possible)
    blurred = np.flatnonzero(possible & exposed & ~usable)
    sharpest = np.argsort(-sharpness[blurred], kind="stable")
    usable[blurred[sharpest[:max(0, least - int(usable.sum()))]]] = True
    reasons = np.select(
        [usable, ~intact, ~(exposed & filled)], ["", Reason.DAMAGED, Reason.CLIPPED],
        Reason.BLURRED)
    refused = tuple(Reason(reason) if reason else None for reason in reasons.tolist())
    return Judgement(usable, usable & ~good, refused)


def check_motion(name: str, motion: NDArray[np.float64]) -> str:
    """Returns a warning where the camera of the video `name` hardly moves, else nothing.

    `motion` [F] is the displacement gained with each frame, in widths, NaN where unknown.
    InputError if the camera does not move at all.
    """
    steps = motion[1:]
    known = steps[~np.isnan(steps)]
    if 2 * len(known) <= len(steps):
        return ""
    length = float(known.sum())
    if length <= NO_MOTION:
        raise InputError(
            f"The camera of {name} does not move: all {len(motion)} frames show one view, but "
            "depth needs several.",
            hint="Record again while you walk sideways through the room.")
    if length < LITTLE_MOTION:
        return (
            f"The camera of {name} hardly moves: its view shifts by {length:.1%} of its width. "
            "Depth will be poor; record a longer walk.")
    return ""


def sharp_frames(sharpness: NDArray[np.float64], share: float) -> NDArray[np.bool_]:  # [F]
    """Returns which frames reach `share` of the usual sharpness [F] around them."""
    usual = percentile_filter(
        sharpness, GATE_PERCENTILE, size=min(GATE_WINDOW, len(sharpness)), mode="nearest")
    return np.asarray(sharpness >= share * usual)


def bridge_gaps(
    lengths: NDArray[np.float64],  # [F]
    sharpness: NDArray[np.float64],  # [F]
    sharp: NDArray[np.bool_],  # [F]
    intact: NDArray[np.bool_],  # [F]
) -> NDArray[np.bool_]:  # [F]
    """Returns the sharp intact frames and those that are needed to close gaps between them.

    A gap of more than `MAX_GAP` is halved by the sharpest intact frame of its middle half, or by a
    elsewhere in it that is much sharper, until the gaps are closed or hold no more frames.
    """
    usable = sharp & intact
    gaps = list(pairwise(np.flatnonzero(usable).tolist()))
    while gaps:
        first, last = gaps.pop()
        inside = first + 1 + np.flatnonzero(intact[first + 1:last])
        if lengths[last] - lengths[first] <= MAX_GAP or not len(inside):
            continue
        off_centre = np.abs(lengths[inside] - (lengths[first] + lengths[last]) / 2)
        reach = max(off_centre.min(), (lengths[last] - lengths[first]) / 4)
        middle = inside[off_centre <= reach]
        bridge = _sharpest(middle, inside, sharpness)
        usable[bridge] = True
        gaps += [(first, bridge), (bridge, last)]
    return usable


def path_length(motion: NDArray[np.float64]) -> NDArray[np.float64]:  # [F]
    """Returns the path length up to each frame in widths; unknown steps count as the median one.

    `motion` [F] is NaN where unknown. Where no step is known (a blank wall throughout) or nothing
    moves, all steps are equal and tiny, so that a choice over the path becomes one over time.
    """
    known = motion[~np.isnan(motion)]
    typical = float(np.median(known[1:])) if len(known) > 1 else 0.0
    steps = np.minimum(np.where(np.isnan(motion), typical, motion), MAX_STEP)
    if steps.sum() <= NO_MOTION:
        steps = np.full(len(motion), NO_MOTION / len(motion))
    return np.cumsum(steps)


def automatic_count(
    lengths: NDArray[np.float64], *, most: int, least: int = MIN_AUTOMATIC
) -> int:
    """Returns how many frames to choose from a path: one each `FRAME_SPACING`, within bounds."""
    return int(min(most, max(least, np.ceil(lengths[-1] / FRAME_SPACING))))


def choose_frames(
    lengths: NDArray[np.float64],  # [F]
    sharpness: NDArray[np.float64],  # [F]
    usable: NDArray[np.bool_],  # [F]
    count: int,
    *,
    bridges: NDArray[np.bool_] | None = None,  # [F]
) -> NDArray[np.int64]:
    """Returns the ascending indices of min(count, usable frames) frames.

    The usable frames are cut into `count` runs of equal path length, none of them empty. Each run
    gives the sharpest frame of its middle two thirds, so that sharpness cannot push neighbours
    together. `bridges` are usable frames that are blurred or badly exposed: a run gives one, maybe
    off the middle, only where it holds nothing else.
    """
    candidates = np.flatnonzero(usable)
    if len(candidates) <= count:
        return candidates
    place = lengths[candidates]
    start, step = place[0], (place[-1] - place[0]) / count
    cuts = _fill_runs(np.searchsorted(place, start + step * np.arange(count)), len(candidates))
    better = ~bridges[candidates] if bridges is not None else np.ones(len(candidates), np.bool_)
    chosen = []
    for run, (first, end) in enumerate(zip(cuts, [*cuts[1:], len(candidates)], strict=True)):
        members = first + np.flatnonzero(better[first:end])
        if not len(members):
            members = np.arange(first, end)
        distance = np.abs(place[members] - (start + (run + 0.5) * step))
        near = candidates[members[distance <= max(step / 3, distance.min())]]
        blurred = not better[members[0]]
        chosen.append(_sharpest(near, candidates[members] if blurred else near, sharpness))
    return np.array(chosen, np.int64)


def _sharpest(
    near: NDArray[np.int64], others: NDArray[np.int64], sharpness: NDArray[np.float64]
) -> int:
    """Returns the sharpest near frame, or another one that is much sharper."""
    close, best = near[np.argmax(sharpness[near])], others[np.argmax(sharpness[others])]
    return int(best if sharpness[best] > MUCH_SHARPER * sharpness[close] else close)


def _fill_runs(cuts: NDArray[np.int64], total: int) -> NDArray[np.int64]:
    """Returns the starts of runs, moved as little as needed for each to hold an element."""
    order = np.arange(len(cuts))
    forward = np.maximum.accumulate(cuts - order) + order
    return np.minimum(forward, total - len(cuts) + order)


def video_candidates(
    source: str,
    sharpness: NDArray[np.float64],  # [F]
    refused: Sequence[Reason | None],  # [F], see `Judgement`
    lengths: NDArray[np.float64],  # [F], `path_length`
    names: dict[int, str],  # of the stored frames by index; at least one
    *,
    standing: NDArray[np.int64] | None = None,  # [F], see `pick_representatives`
) -> tuple[FrameCandidate, ...]:
    """Returns the record of a selection among the frames of the video `source`."""
    chosen = np.array(sorted(names))
    candidates = []
    for index, reason in enumerate(refused):
        like = None
        if index in names:
            reason = Reason.KEPT
        elif reason is None:
            like = index if standing is None else int(standing[index])
            repeated = like in names
            if not repeated:
                like = int(chosen[np.argmin(np.abs(lengths[chosen] - lengths[index]))])
            still = repeated or abs(lengths[like] - lengths[index]) <= NO_MOTION
            reason = Reason.DUPLICATE if still else Reason.CLOSE
        candidates.append(FrameCandidate(
            source, index, reason, round(float(sharpness[index]), 2), names.get(index), like))
    return tuple(candidates)


def choose_photos(
    folder: str, sources: Sequence[str], names: Sequence[str],
    measures: Sequence[PhotoMeasures | None],
) -> tuple[FrameCandidate, ...]:
    """Returns which photos of a folder are kept, and why the others are not.

    Left out are those that cannot be read (their measures are None), show nothing, or show what
    another shows. InputError if fewer than `MIN_FRAMES` different views remain.
    """
    readable = {index: photo for index, photo in enumerate(measures) if photo is not None}
    exposures = np.array([photo.exposure for photo in readable.values()], np.float64).reshape(-1, 3)
    check_exposure(folder, exposures, least=min(MIN_FRAMES, max(1, len(readable))), unit="photos")
    usable = [index for index, fine in zip(readable, has_content(exposures), strict=True) if fine]
    redundant = find_repeats([readable[index] for index in usable])
    like = {usable[place]: usable[original] for place, original in redundant.items()}
    views = len(usable) - len(like)
    if like and views < MIN_FRAMES:
        raise InputError(
            f"{folder} holds {len(usable)} photos but only {views} different "
            f"view{'s' * (views != 1)}, and at least {MIN_FRAMES} are needed: the others are "
            "copies or were taken from the same place.",
            hint="Add photos from other places in the room, a step apart.")
    candidates = []
    for index, photo in enumerate(measures):
        reason = (
            Reason.DAMAGED if photo is None else Reason.CLIPPED if index not in usable
            else _repeat_reason(photo, readable[like[index]]) if index in like
            else Reason.KEPT)
        candidates.append(FrameCandidate(
            sources[index], index, reason, None if photo is None else round(photo.sharpness, 2),
            names[index] if reason is Reason.KEPT else None, like.get(index)))
    return tuple(candidates)


def choose_beside(
    chosen: Mapping[int, PhotoMeasures | None], beside: Mapping[int, PhotoMeasures | None],
    sources: Sequence[str], names: Sequence[str],
) -> dict[int, FrameCandidate]:
    """Returns, by place, the decision on photos that lie beside the chosen ones of a sequence.

    They are kept, except those that cannot be read, show nothing, or show what a kept one shows.
    """
    kept = {place: photo for place, photo in chosen.items() if photo is not None}
    candidates = {}
    for place, photo in beside.items():
        reason, like = Reason.KEPT, None
        if photo is None:
            reason = Reason.DAMAGED
        elif not has_content(np.array([photo.exposure]))[0]:
            reason = Reason.CLIPPED
        else:
            like = next((other for other, known in kept.items()
                         if is_same_view(photo, known)), None)
            reason = Reason.KEPT if like is None else _repeat_reason(photo, kept[like])
        if photo is not None and reason is Reason.KEPT:
            kept[place] = photo
        candidates[place] = FrameCandidate(
            sources[place], place, reason, None if photo is None else round(photo.sharpness, 2),
            names[place] if reason is Reason.KEPT else None, like)
    return candidates


def _repeat_reason(photo: PhotoMeasures, kept: PhotoMeasures) -> Reason:
    return Reason.EXPOSURE if compare_brightness(photo, kept) else Reason.DUPLICATE


def describe_dropped(
    candidates: Sequence[FrameCandidate], among: Sequence[FrameCandidate] | None = None
) -> list[str]:
    """Returns notices about photos, of all or `among` some, that could be read but are left out."""
    dropped = candidates if among is None else among
    source_of = {candidate.index: candidate.source for candidate in candidates}
    reasons = {
        Reason.DUPLICATE: "others show the same",
        Reason.EXPOSURE: "others show the same in another exposure, of a bracket the middle one",
        Reason.CLIPPED: "they are black, blown out or flat"}
    names = {reason: [
        photo.source if photo.like is None else f"{photo.source} (like {source_of[photo.like]})"
        for photo in dropped if photo.reason is reason] for reason in reasons}
    return [
        f"{len(names[reason])} photos are left out because {text}: "
        f"{list_names(names[reason])}." for reason, text in reasons.items()
        if names[reason]]
