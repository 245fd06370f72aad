"""Which frames of a video show one picture: repeats of converted frame rates, a camera at rest.

A codec changes a repeated picture from frame to frame, so equal pixels are not asked for, but that
the corners that two frames share lie in the same places.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recon_cli.capture.limits import MIN_TRACKS
from recon_cli.io.tracks import Tracks

# Shift between two frames as a share of the longer side, a third of a pixel at the tracker's size.
# Repeats of 11 captures in 5 codecs at usual rates stay below .25 pixels
# (tests/bench/bench_capture_bounds.py); at a third of those rates codecs move them by up to .7. A
# camera that is walked through a room moves .4 to 20 pixels from frame to frame.
SAME_PICTURE = 0.0005
FEW = 0.1  # of the corners, those that move unlike the others: lost ones, and people


def find_stills(tracks: Tracks, width: int, height: int) -> NDArray[np.int64]:
    """Returns a number [F] for each image of the tracks: that of the picture that it shows.

    A picture lasts while the view stays where it was in its first image. Equal views that come back
    later count as different.
    """
    sides = np.array([width, height]) / max(width, height)
    stills = np.zeros(len(tracks.names), np.int64)
    first = 0
    for image in range(1, len(stills)):
        before, now = tracks.matches(first, image)
        start, end = tracks.xy[before] * sides, tracks.xy[now] * sides
        same = len(now) >= MIN_TRACKS and measure_shift(start, end) < SAME_PICTURE
        stills[image] = stills[image - 1] + (not same)
        if not same:
            first = image
    return stills


def measure_shift(
    start: NDArray[np.float64],  # [K, 2]
    end: NDArray[np.float64],  # [K, 2]
) -> float:
    """Returns the root mean square of the corners' common motion, by an affine map.

    What they move on their own is the noise of following them, which adds up over a long rest.
    """
    moves = end - start
    unlike = np.linalg.norm(moves - np.median(moves, axis=0), axis=1)
    near = unlike <= np.quantile(unlike, 1 - FEW)
    places = np.column_stack([start - start.mean(axis=0), np.ones(len(start))])
    shared = places @ np.linalg.lstsq(places[near], moves[near], rcond=None)[0]
    return float(np.sqrt((shared**2).sum(axis=1).mean()))


def pick_representatives(
    stills: NDArray[np.int64],  # [F], `find_stills`
    sharpness: NDArray[np.float64],  # [F]
    usable: NDArray[np.bool_],  # [F]
    bridges: NDArray[np.bool_],  # [F], usable, but blurred or badly exposed
) -> NDArray[np.int64]:  # [F]
    """Returns for each frame the usable one that stands for its picture; itself if none does.

    That is the sharpest, one that is not a bridge before those that are.
    """
    standing = np.arange(len(stills))
    for members in np.split(standing, np.flatnonzero(np.diff(stills)) + 1):
        able = members[usable[members]]
        if len(able):
            order = np.lexsort((-sharpness[able], bridges[able]))
            standing[members] = able[order[0]]
    return standing
