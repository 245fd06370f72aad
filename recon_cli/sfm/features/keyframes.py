"""The frames of a long video that its tracks show to be needed.

Neighbours that show nearly the same add nothing. A skeleton is built from frames
that keep a good part of the tracks of the one before, and matches are sought between these; all
others are placed by what they share with the two beside them.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence

import numpy as np

from recon_cli.io.tracks import Tracks
from recon_cli.scene.statistics import at_least
from recon_cli.sfm.limits import FEW_FRAMES
from recon_cli.sfm.model_arrays import Pair

SHARED = (60, 0.5)  # tracks that a keyframe shares with the next one: at least, and of its own
LONGEST = 6  # frames from one to the next
# Tracks from which on two frames are worth matching: of 774 pairs with fewer, five to ten keyframes
# apart, 58 were verified, of 285 with more, 122.
FEW_TRACKS = 5


def choose_keyframes(tracks: Tracks) -> tuple[int, ...]:
    """Returns the rows of the keyframes of a video in order; the first and the last are two."""
    count = len(tracks.names)
    if count <= FEW_FRAMES:
        return tuple(range(count))
    seen = np.bincount(tracks.image, minlength=count)
    rows = [0]
    while rows[-1] < count - 1:
        last = rows[-1]
        enough = at_least(SHARED, seen[last])
        step = 1
        while (step < LONGEST and last + step < count - 1
               and len(tracks.matches(last, last + step + 1)[0]) >= enough):
            step += 1
        rows.append(last + step)
    return tuple(rows)


def name_keyframes(tracks: Tracks) -> tuple[str, ...]:
    """Returns the names of the keyframes."""
    return tuple(tracks.names[row] for row in choose_keyframes(tracks))


def side_rows(rows: Sequence[int]) -> Iterable[tuple[int, int]]:
    """Yields each frame between two keyframes, given in order, with either of them."""
    for before, after in itertools.pairwise(rows):
        for row in range(before + 1, after):
            yield before, row
            yield row, after


def track_rows(rows: Sequence[int], steps: Sequence[int]) -> list[tuple[int, int]]:
    """Returns pairs of rows whose tracks tie them: keyframes so many steps apart, and others."""
    between = [pair for step in steps for pair in zip(rows, rows[step:], strict=False)]
    return [*between, *side_rows(rows)]


def share_tracks(tracks: Tracks, pairs: Iterable[Pair]) -> set[Pair]:
    """Returns the pairs of frames that have FEW_TRACKS tracks or more in common."""
    row = {name: index for index, name in enumerate(tracks.names)}
    return {(first, second) for first, second in pairs
            if len(tracks.matches(row[first], row[second])[0]) >= FEW_TRACKS}


def side_pairs(tracks: Tracks) -> set[Pair]:
    """Returns each frame that is not a keyframe with the two keyframes beside it, by names."""
    return {(tracks.names[first], tracks.names[second])
            for first, second in side_rows(choose_keyframes(tracks))}
