"""The first Gaussians: one at each sparse point."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from recon_cli.errors import TrainingError
from recon_cli.scene.splats import SH_C0, TERMS, Splats

_OPACITY = 0.1  # initial opacity of the reference implementation
_NEIGHBOURS = 3
_MIN_SCALE = 1e-7  # world units; coincident points would otherwise start at scale 0


def splats_from_points(
    points: NDArray[np.float64],  # [P, 3]
    colors: NDArray[np.uint8],  # [P, 3]
    *,
    most: int,
    seed: int,
    sh_degree: int,
) -> Splats:
    """Returns one round Gaussian a point, as large as the mean distance to its 3 nearest.

    (Kerbl et al. 2023, section 5.2.) Of more than `most` points a seeded draw is taken. Colours
    have room for spherical harmonics up to `sh_degree`.

    Raises:
        TrainingError: there are fewer than 4 points.
    """
    if len(points) <= _NEIGHBOURS:
        raise TrainingError(
            f"The reconstruction has {len(points)} points; at least 4 are needed to start.",
            hint="Film slower with more overlap, then run `recon ingest` again.")
    if len(points) > most:
        chosen = np.sort(np.random.default_rng(seed).permutation(len(points))[:most])
        points, colors = points[chosen], colors[chosen]
    neighbours = min(_NEIGHBOURS, len(points) - 1)
    distances, _ = cKDTree(points).query(points, k=neighbours + 1)
    scales = np.maximum(distances[:, 1:].mean(axis=1), _MIN_SCALE)
    n = len(points)
    return Splats(
        means=torch.tensor(points, dtype=torch.float32),
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        log_scales=torch.tensor(np.log(scales), dtype=torch.float32)[:, None].repeat(1, 3),
        logit_opacities=torch.logit(torch.full((n,), _OPACITY)),
        sh_dc=(torch.tensor(colors, dtype=torch.float32) / 255 - 0.5) / SH_C0,
        sh_rest=torch.zeros(n, TERMS[sh_degree], 3),
    )
