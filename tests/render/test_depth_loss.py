"""The loss against sensor depth: its values in closed form, its gradients by autograd."""

import math

import pytest
import torch

from recon_cli.render.depth_loss import LEAST_COVERAGE, depth_loss, depth_loss_gradient

NOISE, FACTOR = 0.02, 0.3


def doubles(*values):
    return torch.tensor(values, dtype=torch.float64)


def test_a_depth_that_is_off_by_the_noise_counts_root_two_less_one():
    # expected depth 2.04 at coverage .8, measured 2.0 to 2%: off by one standard deviation
    loss = depth_loss(doubles(0.8 * 2.04), doubles(0.8), doubles(2.0), NOISE, FACTOR)
    assert loss.item() == pytest.approx(FACTOR * (math.sqrt(2) - 1), rel=1e-12)
    assert depth_loss(doubles(1.6), doubles(0.8), doubles(2.0), NOISE, FACTOR).item() == 0


def test_far_off_a_pixel_pulls_by_one_over_the_noise_however_far():
    for z in (4.0, 8.0):
        _, slope, _ = depth_loss_gradient(doubles(z), doubles(1.0), doubles(2.0), NOISE, FACTOR)
        assert slope.item() == pytest.approx(FACTOR / (NOISE * 2.0), rel=1e-3)


def test_what_is_not_known_or_hardly_covered_counts_nothing():
    depth, alpha = doubles(1.0, 0.4, 0.0), doubles(1.0, LEAST_COVERAGE, 0.0)
    truth = doubles(0.0, 9.0, 9.0)
    loss, by_depth, by_alpha = depth_loss_gradient(depth, alpha, truth, NOISE, FACTOR)
    assert loss == 0
    assert not by_depth.any()
    assert not by_alpha.any()


def test_the_gradients_in_closed_form_are_those_of_autograd_and_of_differences():
    generator = torch.Generator().manual_seed(0)
    alpha = torch.rand(50, generator=generator, dtype=torch.float64)
    depth = alpha * (1 + torch.rand(50, generator=generator, dtype=torch.float64))
    truth = 1 + torch.rand(50, generator=generator, dtype=torch.float64)
    truth[::7] = 0
    leaves = depth.requires_grad_(), alpha.requires_grad_()
    loss = depth_loss(*leaves, truth, NOISE, FACTOR)
    by_autograd = torch.autograd.grad(loss, leaves)
    value, *closed = depth_loss_gradient(*(leaf.detach() for leaf in leaves), truth, NOISE, FACTOR)
    assert value.item() == pytest.approx(loss.item(), rel=1e-12)
    for ours, theirs in zip(closed, by_autograd, strict=True):
        assert theirs.abs().max() > 0
        torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=0)
    away = (alpha - LEAST_COVERAGE).abs() > 1e-3  # where there is no step
    assert torch.autograd.gradcheck(
        lambda d, a: depth_loss(d, a, truth[away], NOISE, FACTOR),
        tuple(leaf.detach()[away].requires_grad_() for leaf in leaves))
