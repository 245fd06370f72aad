"""Trust as a property of each Gaussian in a .ply: one number for all directions."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from recon_cli.scene.splats import Splats
from recon_cli.scene.statistics import ROUNDING
from recon_cli.trust.scene_trust import Trust
from recon_cli.trust.support import ViewingGeometry

PLY_PROPERTY = "expected_error"


def expected_errors(splats: Splats, trust: Trust) -> NDArray[np.float32]:
    """Returns the expected error [N], 0 to 1, of Gaussians as seen from where a view showed them.

    Those that no view shows are as if seen from the opposite side.
    """
    unseen = trust.support.count == 0
    angle = torch.where(unseen, torch.pi, 0.0).to(splats.means.dtype)
    sight = ViewingGeometry(angle.to(trust.support.residual.device),
                  torch.zeros_like(trust.support.residual))
    return trust.expect_gaussians(sight)


def match_rows(means: Tensor, originals: NDArray[np.float64]) -> NDArray[np.int64]:
    """Returns for each of `means` [K, 3] the row of the original [N, 3] in its place, [K].

    Export removes and orders them, which leaves the rest in place; -1 for one that it moves, as
    what lies outside the room.
    """
    places = means.detach().cpu().double().numpy()
    apart, rows = cKDTree(originals).query(places)
    return np.where(apart <= ROUNDING * np.abs(places).max(initial=1.0), rows, -1)
