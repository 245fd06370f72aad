"""How well each camera of a model is known: the covariance of the adjustment.

A few photos far apart may be fitted to a quarter of a pixel and still be off by a tenth of their
extent: what ties a camera to the others is then a handful of points that lie close together. The
normal equations of the adjustment say so, with every camera, every point and the lenses free
(Triggs et al. 2000, sections 6.1 and 9). Position, turn and scale of the whole model are nobody's
error: they are taken off, as a similarity that fits the centres takes them off.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from recon_cli.io.colmap_library import pycolmap
from recon_cli.sfm.scale_drift import _POSE, _factorise, _Observations

MAX_CAMERA_ERROR = 0.02  # of the extent: a camera that is known less well is rough
_FREEDOMS = 7  # of a similarity


def estimate_camera_errors(
    model: pycolmap.Reconstruction, names: Sequence[str]
) -> dict[str, float]:
    """Returns by how much the centre of each camera is likely off, as a share of the extent.

    One standard deviation, of all three axes together; the extent is the diagonal of the box around
    the centres. `names` are of images with points.
    """
    seen = _Observations(model, names)
    factor, variance = _factorise(seen)
    across = _without_similarity(seen.centers)
    changes = np.zeros((factor.shape[0], len(across)))
    for axis in range(3):
        changes[_POSE * np.arange(len(names)) + 3 + axis] = across[axis::3]
    spread = variance * np.einsum("uc,uc->c", changes, factor.solve(changes))
    extent = float(np.linalg.norm(np.ptp(seen.centers, axis=0)))
    off = np.sqrt(np.maximum(spread, 0.0).reshape(-1, 3).sum(axis=1)) / max(extent, 1e-300)
    return dict(zip(names, off.tolist(), strict=True))


def _without_similarity(centers: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns what takes the best similarity off a change of the centres [F, 3], [3 F, 3 F]."""
    arms = centers - centers.mean(axis=0)
    turns = np.cross(np.eye(3)[:, None], arms[None])  # [3, F, 3]
    shifts = np.tile(np.eye(3)[:, None], (1, len(centers), 1))
    free = np.concatenate([shifts, turns, arms[None]]).reshape(_FREEDOMS, -1)
    basis = np.linalg.svd(free, full_matrices=False)[2]
    return np.eye(centers.size) - basis.T @ basis
