"""Cheaper rules than the contract's, on single Gaussians and layers, where the answer is known."""

import math

import pytest
import torch
from scenes import camera_at, joined, one_splat, random_splats

from recon_cli.render.contract import Approximation
from recon_cli.render.numba.backend import render

BLACK = torch.zeros(3)
CAMERA = camera_at(120, 90, focal=100.0)


def alpha_of(splats, approximation):
    return render(splats, CAMERA, BLACK, 0, False, None, approximation).alpha


@pytest.fixture(params=range(40))
def single(request):
    """One of forty Gaussians, every seventh of them a needle."""
    splats = random_splats(40, seed=12, dtype=torch.float32)
    splats.means[:, 2] = splats.means[:, 2].abs() + 1.0
    splats.log_scales[::7, 0] += 2.0
    return splats.select(torch.tensor([request.param]))


def test_the_square_drops_only_what_lies_beyond_three_deviations(single):
    exact, square = alpha_of(single, Approximation()), alpha_of(single, Approximation(square=True))
    dropped = exact - square
    assert ((dropped == 0) | (square == 0)).all()  # whole tiles of a Gaussian, or nothing
    assert dropped.max() <= single.opacities.item() * math.exp(-4.5) * (1 + 1e-3)


@pytest.mark.parametrize("least", [1 / 510, 2 / 255, 0.1])
def test_another_alpha_threshold_keeps_what_reaches_it(single, least):
    full = alpha_of(single, Approximation(alpha_min=1 / 2550))
    kept = alpha_of(single, Approximation(alpha_min=least))
    sure = (full / least - 1).abs() > 1e-3
    expected = torch.where(full >= least, full, 0.0)
    assert torch.allclose(kept[sure], expected[sure], atol=1e-6)


def test_without_an_early_stop_every_layer_counts():
    layers = joined(*[
        one_splat((0.0, 0.0, 2.0 + 0.01 * i), scale=9.0, opacity=0.9, color=(0.5, 0.5, 0.5),
                  dtype=torch.float32) for i in range(12)])
    camera = camera_at(8, 8)
    for least, seen in ((0.0, 12), (2e-2, 1), (0.9e-2, 2)):
        rule = Approximation(transmittance_min=least)
        hits = render(layers, camera, BLACK, 0, True, None, rule).statistics.hits
        assert (hits > 0).sum() == seen
