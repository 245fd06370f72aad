"""How well each camera of a photo model is known: the covariance of the adjustment.

A few photos far apart may fit to a quarter of a pixel and still be off by a tenth of their extent:
what ties a camera to the others is then a handful of points that lie close together. The normal
equations of the adjustment say so, with every camera, every point and the lenses free (Triggs et
al. 2000, sections 6.1 and 9). The position, turn and scale of the whole model are free and no
error: they are taken off, as the similarity that fits the centres best takes them off.

Walks are left to `scale_drift`: along one errors add up without a camera being wrong to the next.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import list_names
from recon_cli.io.colmap_library import pycolmap
from recon_cli.sfm.features.sphere import is_panorama
from recon_cli.sfm.limits import MIN_FRAMES, MIN_POSE_INLIERS
from recon_cli.sfm.mapping.prior_adjustment import LEAST_ERROR_PX
from recon_cli.sfm.verdict.evidence import MatchEvidence
from recon_cli.sfm.verdict.scale_drift import (
    MIN_SURE_EXPLAINED,
    POSE,
    Observations,
    factorise,
)
from recon_cli.sfm.verdict.weakest_cut import OutlierCamera

# Of the extent: a camera that is known less well is rough, and a model whose cameras are by and
# large (RMS) known less well cannot be trusted.
MAX_CAMERA_ERROR, MAX_MODEL_ERROR = 0.02, 0.03
# Errors of matches and of the lens are shared by observations, and do not average out as those of
# independent ones: three quarters of the cameras of living and fox were off by up to 5.3 times what
# these would leave, and of office by up to 6.2 (`tests/bench/bench_thinned.py`).
SHARED_ERRORS = 5.0
MOST_CAMERAS = 300  # of more it takes longer than seconds
Errors = Mapping[str, float]  # by the name of an image, as a share of the extent


def estimate_camera_errors(model: pycolmap.Reconstruction, names: Sequence[str]) -> Errors:
    """Returns how far the centre of each camera is likely off, as a share of the extent.

    One standard deviation of all three axes together, and at most 1; the extent is the diagonal of
    the box around the centres. `names` are images with points. Empty for fewer than three of them,
    for more than MOST_CAMERAS, and for panoramas, which `scale_drift` judges.
    """
    if not MIN_FRAMES <= len(names) <= MOST_CAMERAS or any(
            map(is_panorama, model.cameras.values())):
        return {}
    seen = Observations(model, names)
    factor, variance = factorise(seen)
    across = _without_similarity(seen.centers)
    changes = np.zeros((factor.shape[0], len(across)))
    rows = POSE * np.arange(len(names))[:, None] + np.arange(3, POSE)
    changes[rows.ravel()] = across
    spread = np.einsum("uc,uc->c", changes, factor.solve(changes)).reshape(-1, 3).sum(axis=1)
    # Few observations may fit too well: what they miss counts as the usual error, which weighs as
    # many of them as the cameras have unknowns.
    unknowns, free = len(changes), max(2 * len(seen.image) - len(changes) - 3 * seen.points, 0)
    variance = (unknowns * LEAST_ERROR_PX**2 + free * variance) / (unknowns + free)
    deviation = SHARED_ERRORS * np.sqrt(variance * np.maximum(spread, 0.0))
    extent = max(float(np.linalg.norm(np.ptp(seen.centers, axis=0))), 1e-300)
    return dict(zip(names, np.minimum(deviation / extent, 1.0).tolist(), strict=True))


def list_rough(errors: Errors, points: Mapping[str, int]) -> tuple[str, ...]:
    """Returns the cameras that are known badly: by their errors, or as they see too few points."""
    return tuple(sorted(name for name, error in errors.items()
                        if error > MAX_CAMERA_ERROR or points[name] < MIN_POSE_INLIERS))


def list_loose(errors: Errors, evidence: MatchEvidence) -> Iterator[OutlierCamera]:
    """Yields the cameras that see too few points and do not explain enough of their matches.

    Each point fits so few, whatever is wrong: one with 22 points was off by a tenth of the extent.
    """
    for row, name in enumerate(evidence.names):
        own = (evidence.pairs == row).any(axis=1) & evidence.placed
        matches = int(evidence.matches[own].sum())
        share = float(evidence.explained[own].sum()) / max(matches, 1)
        if (name in errors and share < MIN_SURE_EXPLAINED
                and evidence.points[row] < MIN_POSE_INLIERS):
            yield OutlierCamera(name, share, matches, "", None)


def describe_rough(errors: Errors, rough: Sequence[str]) -> Iterator[str]:
    """Yields a sentence on the cameras that are rough, if any are."""
    if rough:
        yield (f"{len(rough)} of {len(errors)} cameras are rough, known to no better than "
               f"{MAX_CAMERA_ERROR:.0%} of the extent of all or by fewer than {MIN_POSE_INLIERS} "
               f"points: {list_names([f'{name} ({errors[name]:.1%})' for name in rough])}. Photos "
               "between them and the others would tell more.")


def describe_inexact(errors: Errors) -> Iterator[str]:
    """Yields why a model cannot be trusted by its cameras' errors, if it cannot."""
    if (error := measure_rms(errors)) > MAX_MODEL_ERROR:
        yield (f"The cameras are known to {error:.0%} of their extent only (RMS), but "
               f"{MAX_MODEL_ERROR:.0%} is needed: the photos have too few points in common.")


def measure_rms(errors: Errors) -> float:
    """Returns the root of the mean squared error; 0 without any."""
    return float(np.sqrt(np.mean(np.square(list(errors.values()))))) if errors else 0.0


def _without_similarity(centers: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns what takes the best similarity off a change of the centres [F, 3], [3 F, 3 F]."""
    arms = centers - centers.mean(axis=0)
    turns = np.cross(np.eye(3)[:, None], arms)  # [3, F, 3]
    shifts = np.broadcast_to(np.eye(3)[:, None], turns.shape)
    free = np.concatenate([shifts, turns, arms[None]]).reshape(7, -1)
    basis = np.linalg.svd(free, full_matrices=False)[2]
    return np.asarray(np.eye(centers.size) - basis.T @ basis, np.float64)
