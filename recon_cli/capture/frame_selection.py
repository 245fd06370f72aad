"""Which frames of a video are chosen: locally sharp ones, spread evenly over the camera's path.

Frames that are mostly black or blown out count as blurred: they are avoided, but where a whole
stretch is like that, its best frames bridge the gap.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import percentile_filter

from recon_cli.capture.frame_measures import has_content, well_exposed
from recon_cli.capture.selection_record import Reason
from recon_cli.errors import InputError

# A frame is compared with the 75th percentile of the 31 frames around it: a few sharp ones set the
# level, and a dark or bare stretch of the room is measured by its own frames.
GATE_WINDOW, GATE_PERCENTILE = 31, 75
# Path between chosen frames in widths of the image: 94% overlap, so that many of them see a
# point. A 10 s walk through a room (4.5 widths) gives 75 frames.
FRAME_SPACING = 0.06
# Sharp frames further apart than this, 88% overlap, get the least blurred ones between them: a
# fast turn is blurred throughout, and without it the reconstruction falls into two pieces.
MAX_GAP = 0.12
# Beside textured views a plain one fails the test although it is sharp. It is this much sharper
# than blurred frames of the same gap: 5 to 10 times in a rendered room.
MUCH_SHARPER = 2.0
# Frames of a camera that hardly moves, to average out noise.
MIN_AUTOMATIC = 24
# One step counts at most this much: where tracking jumped, a larger one would use up the budget.
MAX_STEP = 0.1
# A shorter path (a third of a pixel in 320) is tracking noise of a camera on a tripod.
NO_MOTION = 0.001
# A shorter path, two steps of the usual spacing, causes a notice: structure from motion starts from
# three frames further apart.
LITTLE_MOTION = 2 * FRAME_SPACING


@dataclass(frozen=True, eq=False)
class Judgement:
    """Which of F frames may be chosen, and why the others may not.

    Attributes:
        usable: [F] bool.
        bridges: [F] bool; usable only because a gap would be too wide without.
        refused: for each frame why it is not usable, None where it is.
    """

    usable: NDArray[np.bool_]
    bridges: NDArray[np.bool_]
    refused: tuple[Reason | None, ...]


def judge_frames(
    lengths: NDArray[np.float64],  # [F]
    sharpness: NDArray[np.float64],  # [F]
    exposures: NDArray[np.float64],  # [F, 3]
    whole: NDArray[np.bool_],  # [F]
    share: float,
) -> Judgement:
    """Returns which frames may be chosen.

    Args:
        lengths: `path_length` up to each frame.
        sharpness: of each frame.
        exposures: rows of `measure_exposure`.
        whole: which frames are undamaged.
        share: of the sharpness around it that a frame must reach.
    """
    sharp, exposed = sharp_frames(sharpness, share), well_exposed(exposures)
    filled = has_content(exposures)
    good, possible = sharp & exposed & filled, whole & filled
    usable = bridge_gaps(lengths, sharpness, good, possible)
    reasons = np.select(
        [usable, ~whole, ~(exposed & filled)],
        ["", Reason.DAMAGED, Reason.CLIPPED], Reason.BLURRED)
    refused = tuple(Reason(reason) if reason else None for reason in reasons.tolist())
    return Judgement(usable, usable & ~good, refused)


def check_motion(
    name: str,
    motion: NDArray[np.float64],  # [F], NaN where unknown
) -> str:
    """Returns a warning where the camera hardly moves, else nothing.

    Args:
        name: of the video, for the message.
        motion: displacement gained with each frame, in widths.

    Raises:
        InputError: the camera does not move at all, as far as its motion is known.
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


def sharp_frames(
    sharpness: NDArray[np.float64],  # [F]
    share: float,
) -> NDArray[np.bool_]:  # [F]
    """Returns which frames reach `share` of the usual sharpness around them."""
    usual = percentile_filter(
        sharpness, GATE_PERCENTILE, size=min(GATE_WINDOW, len(sharpness)), mode="nearest")
    return np.asarray(sharpness >= share * usual)


def bridge_gaps(
    lengths: NDArray[np.float64],  # [F]
    sharpness: NDArray[np.float64],  # [F]
    sharp: NDArray[np.bool_],  # [F]
    whole: NDArray[np.bool_],  # [F]
) -> NDArray[np.bool_]:  # [F]
    """Returns the sharp whole frames and those that are needed to close gaps between them.

    A gap of more than `MAX_GAP` is halved by the sharpest whole frame of its middle half, or by one
    elsewhere in it that is much sharper, until the gaps are closed or hold no more frames.
    """
    usable = sharp & whole
    gaps = list(pairwise(np.flatnonzero(usable).tolist()))
    while gaps:
        first, last = gaps.pop()
        inside = first + 1 + np.flatnonzero(whole[first + 1:last])
        if lengths[last] - lengths[first] <= MAX_GAP or not len(inside):
            continue
        off_centre = np.abs(lengths[inside] - (lengths[first] + lengths[last]) / 2)
        reach = max(off_centre.min(), (lengths[last] - lengths[first]) / 4)
        middle = inside[off_centre <= reach]
        bridge = _sharpest(middle, inside, sharpness)
        usable[bridge] = True
        gaps += [(first, bridge), (bridge, last)]
    return usable


def path_length(
    motion: NDArray[np.float64],  # [F], NaN where unknown
) -> NDArray[np.float64]:  # [F]
    """Returns the path length up to each frame in widths; unknown steps count as the median one.

    Where no step is known (a blank wall throughout) or nothing moves, all steps are equal and tiny,
    so that a choice over the path becomes a choice over time.
    """
    known = motion[~np.isnan(motion)]
    typical = float(np.median(known[1:])) if len(known) > 1 else 0.0
    steps = np.minimum(np.where(np.isnan(motion), typical, motion), MAX_STEP)
    if steps.sum() <= NO_MOTION:
        steps = np.full(len(motion), NO_MOTION / len(motion))
    return np.cumsum(steps)


def automatic_count(lengths: NDArray[np.float64], *, most: int) -> int:
    """Returns how many frames to choose from a path: one each `FRAME_SPACING`, within bounds."""
    return int(min(most, max(MIN_AUTOMATIC, np.ceil(lengths[-1] / FRAME_SPACING))))


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
    together. A run gives one of the `bridges`, usable frames that are blurred or badly exposed,
    only where it holds nothing else: few frames lie so far apart that most gaps need no bridge.
    Then one that is much sharper may lie off the middle.
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
