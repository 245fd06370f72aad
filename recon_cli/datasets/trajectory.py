"""Poses of a camera by time, which are given at the times of frames or near them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

# Seconds. A pose of a frame's own time, which lists round to milliseconds, is that of the frame;
# beyond the gaps below, one that is a third of a video's frame away is taken as it is.
_SAME, _NEAR = 1e-3, 5e-3
# A gap longer than this many usual ones is where the camera was lost. What is far below the first
# bound in seconds moves no camera; over more than the second a hand that turns round at 2 rad/s^2
# leaves a straight motion by a degree.
_USUAL_GAPS, _GAP = 2.5, (0.1, 0.25)


class Trajectory:
    """Camera-to-world poses over time, between which others are interpolated."""

    def __init__(
        self, times: NDArray[np.float64], turns: Rotation, centers: NDArray[np.float64]
    ) -> None:
        """Orders N poses by their times [N] in seconds; of equal times the first counts.

        `turns` are N rotations camera to world, and `centers` [N, 3] the places. ValueError if
        there is none.
        """
        if not len(times):
            raise ValueError("no poses")
        self._times, order = np.unique(times, return_index=True)
        self._turns, self._centers = turns[order], centers[order]
        self._slerp = Slerp(self._times, self._turns) if len(self._times) > 1 else None
        usual = float(np.median(np.diff(self._times))) if len(self._times) > 1 else 0.0
        self._gap = min(max(_USUAL_GAPS * usual, _GAP[0]), _GAP[1])

    def viewmat(self, time: float) -> NDArray[np.float64] | None:
        """Returns [4, 4] world to camera at a time, None where no pose is near."""
        at = int(np.clip(np.searchsorted(self._times, time), 1, max(len(self._times) - 1, 1)))
        before, after = self._times[at - 1], self._times[min(at, len(self._times) - 1)]
        within = before <= time <= after and after - before <= self._gap
        nearest = int(np.argmin(np.abs(self._times - time)))
        if abs(self._times[nearest] - time) <= (_SAME if within else _NEAR):
            turn, center = self._turns[nearest], self._centers[nearest]
        elif within and self._slerp is not None:
            share = (time - before) / (after - before)
            turn = self._slerp(time)
            center = (1 - share) * self._centers[at - 1] + share * self._centers[at]
        else:
            return None
        viewmat = np.eye(4)
        viewmat[:3, :3] = turn.as_matrix().T
        viewmat[:3, 3] = -viewmat[:3, :3] @ center
        return viewmat
