"""One Gaussian before one camera, whose image is known in closed form."""

from __future__ import annotations

import numpy as np

from recon_cli.api import Camera, Splats, make_camera

FOCAL, SIDE, DISTANCE, SCALE, OPACITY = 40.0, 33, 4.0, 0.2, 0.6
RED = [[1.0, 0.25, 0.0]]


def one_gaussian(**changes: object) -> Splats:
    """A round Gaussian at the origin, of one colour from everywhere."""
    values = {"means": [[0.0, 0, 0]], "quats": [[1.0, 0, 0, 0]], "scales": [[SCALE] * 3],
              "opacities": [OPACITY], "sh": RED}
    return Splats.from_arrays(**{**values, **changes})


def facing_camera() -> Camera:
    """A camera on the z axis that has the origin in the middle of its middle pixel."""
    middle = SIDE / 2
    viewmat = np.eye(4)
    viewmat[2, 3] = DISTANCE
    return make_camera([[FOCAL, 0, middle], [0, FOCAL, middle], [0, 0, 1]], SIDE, SIDE,
                       viewmat=viewmat)
