"""Gives a scene that was trained with gains the brightness as filmed.

With a gain for each image all images agree, and the scene has their mean exposure. Where a camera's
exposure follows the place, a walk through the scene then looks unlike the film. A Gaussian gets the
mean of the gains of the images that show it: what it has in them.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon_cli.render import render
from recon_cli.scene.splats import SH_C0
from recon_cli.train.state import TrainState
from recon_cli.train.task import Task

_REDUCED = 2  # images are reduced by this: weights of Gaussians hardly change


@torch.no_grad()
def restore_brightness(state: TrainState, task: Task) -> None:
    """Multiplies the colour of each Gaussian by the mean gain of the images that show it.

    Means are of log-gains, weighted by how much of an image a Gaussian is. One that no image shows
    keeps its colour.
    """
    if state.photometry is None or state.photometry.exposure is None:
        return
    factors = _mean_gains(state, task, state.photometry.exposure.log_gains)
    splats = state.splats
    splats.sh_dc.copy_(((0.5 + SH_C0 * splats.sh_dc) * factors - 0.5) / SH_C0)
    splats.sh_rest.mul_(factors[:len(splats.sh_rest), None])


def _mean_gains(state: TrainState, task: Task, log_gains: NDArray[np.float64]) -> Tensor:
    """Returns the factors of the channels of each Gaussian, [N, 3]."""
    splats = state.splats
    weights = splats.means.new_zeros(len(splats))
    sums = splats.means.new_zeros(len(splats), 3)
    degree = task.schedule.sh_degree(max(1, state.iteration))
    for index, log_gain in enumerate(torch.from_numpy(log_gains).to(splats.means)):
        view = task.pyramid.view(index, _REDUCED)
        weight = render(
            splats, view.camera, splats.background, degree, backend=task.backend, scores=True,
            mask=view.counting(splats.means.device)).statistics.blend_sum
        weights += weight
        sums += weight[:, None] * log_gain
    return (sums / weights.clamp_min(1e-9)[:, None]).exp()
