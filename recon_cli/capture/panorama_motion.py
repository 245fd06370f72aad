"""How far the camera of a 360-degree video moves: the motion that is left once it is turned back.

A turn moves everything in a panorama and shows nothing new. So the rotation that best explains the
tracks of corners is taken away, and the angles by which they still move are those of parallax.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recon_cli.io.tracks import Tracks
from recon_cli.scene.statistics import OUTLIER_SIGMAS

# Degrees that count as the width of an ordinary picture, by which frames are spaced.
WIDTH_DEG = 65.0
REACH = 0.05  # widths; so far from an anchor, the next frame becomes one
LEAST_CORNERS = 12
ROUNDS = 3  # of the fit, without what lies far off it


def measure_parallax(tracks: Tracks) -> NDArray[np.float64]:  # [F]
    """Returns how much further each frame is from an anchor than any before it, in widths.

    0 for the first frame and those that move back; NaN where too few corners are followed.
    """
    motion = np.zeros(len(tracks.names))
    anchor, reached = 0, 0.0
    for index in range(1, len(motion)):
        ours, theirs = tracks.matches(anchor, index)
        if len(ours) < LEAST_CORNERS:
            motion[index] = np.nan
            anchor, reached = index, 0.0
            continue
        angle = _parallax(_rays(tracks.xy[ours]), _rays(tracks.xy[theirs])) / WIDTH_DEG
        motion[index] = max(0.0, angle - reached)
        reached = max(reached, angle)
        if reached >= REACH:
            anchor, reached = index, 0.0
    return motion


def _parallax(before: NDArray[np.float64], after: NDArray[np.float64]) -> float:
    """Returns the median angle in degrees between rays [K, 3] once a common turn is taken away."""
    near = np.ones(len(before), np.bool_)
    angles = np.zeros(len(before))
    for _ in range(ROUNDS):
        turn, _ = Rotation.align_vectors(after[near], before[near])
        cosines = (turn.apply(before) * after).sum(axis=1)
        angles = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
        near = angles <= max(OUTLIER_SIGMAS * float(np.median(angles)), 1e-6)
        if np.count_nonzero(near) < LEAST_CORNERS:
            break
    return float(np.median(angles))


def _rays(xy: NDArray[np.float32]) -> NDArray[np.float64]:
    """Returns the unit vectors [K, 3] of places [K, 2] in a panorama, shares of its size."""
    longitude, latitude = (xy[:, 0] - 0.5) * 2.0 * np.pi, (0.5 - xy[:, 1]) * np.pi
    return np.stack([np.cos(latitude) * np.sin(longitude), -np.sin(latitude),
                     np.cos(latitude) * np.cos(longitude)], axis=1).astype(np.float64)
