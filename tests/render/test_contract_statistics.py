"""Statistics of the passes, each against its definition, computed by brute force."""

from __future__ import annotations

import math
from functools import cache

import pytest
import torch
from backends import BLACK, GREENISH, MARGIN, every_backend
from facts import raises
from oracle import Nudges, composited
from scenes import camera_at, joined, leaves, one_splat, random_splats

pytestmark = every_backend

# Sums over a Gaussian's pixels, relative to the greatest of all Gaussians. float32: the gradients'
# tolerance, twice where a square doubles the error.
SUM_TOLERANCE = {torch.float32: 1e-4, torch.float64: 1e-11}
SQUARE_TOLERANCE = {torch.float32: 2e-4, torch.float64: 1e-11}


@cache
def scene(seed: int, count: int = 24):
    """A scene in which no fragment is a lottery in float32, so that counts can be exact."""
    camera = camera_at(33, 20)
    splats = random_splats(count, seed=seed, dtype=torch.float32).map(torch.Tensor.double)
    margin = composited(splats, camera, BLACK, 0).margin.min()
    assert margin > MARGIN[torch.float32], "choose another seed"
    return splats, camera


@cache
def changes(seed: int, degree: int):
    """The squares [N, H, W] of what leaving out each Gaussian of a scene changes, over channels."""
    splats, camera = scene(seed)
    whole = composited(splats, camera, GREENISH, degree).rgb
    others = (splats.select(torch.arange(len(splats)) != i) for i in range(len(splats)))
    return torch.stack([
        (composited(rest, camera, GREENISH, degree).rgb - whole).square().sum(-1)
        for rest in others])


def target_loss(image):
    """A loss whose slope differs from pixel to pixel: squares against a gradient of grey."""
    columns = torch.linspace(0, 1, image.shape[1], dtype=image.dtype, device=image.device)
    return (image - columns[None, :, None]).square().sum()


def close(ours, truth, limit):
    """The greatest error relative to the greatest truth is within the limit."""
    return (ours.cpu().double() - truth).abs().max() <= limit * truth.abs().max()


def test_radii_are_three_standard_deviations_of_the_longer_axis(case):
    camera = camera_at(64, 48, focal=60.0)
    splats = one_splat((0.2, 0.1, 3.0), scale=0.1, opacity=0.6, color=(0.9, 0.5, 0.1))
    behind = one_splat((0.0, 0.0, -3.0), scale=0.1, opacity=0.6, color=(0.9, 0.5, 0.1))
    radii = case.render(joined(splats, behind), camera).statistics.radii
    x, y, z = camera.viewmat[:3, :3] @ [0.2, 0.1, 3.0] + camera.viewmat[:3, 3]
    J = torch.tensor([[camera.fx / z, 0, -camera.fx * x / z**2],
                      [0, camera.fy / z, -camera.fy * y / z**2]])
    cov = 0.01 * J.double() @ J.double().T + 0.3 * torch.eye(2, dtype=torch.float64)
    expected = 3 * math.sqrt(torch.linalg.eigvalsh(cov)[-1])
    assert radii[0].item() == pytest.approx(expected, rel=1e-6)
    assert radii[1].item() == 0


def test_hits_and_blend_weights_match_their_definition(case):
    splats, camera = scene(seed=6)
    statistics = case.render(splats, camera, scores=True).statistics
    weights = composited(splats, camera, BLACK, 0).weights
    assert torch.equal(statistics.hits.cpu(), (weights > 0).sum((1, 2)))
    assert close(statistics.blend_sum, weights.sum((1, 2)), SUM_TOLERANCE[case.dtype])
    expected = weights.amax((1, 2))
    assert close(statistics.blend_max, expected, SUM_TOLERANCE[case.dtype])
    assert (expected == 0).any()  # some Gaussians are not seen, and count as such
    assert statistics.blend_max[(expected == 0).to(case.device)].abs().sum() == 0


@pytest.mark.integration
def test_scores_are_zero_unless_they_are_asked_for(case):
    splats, camera = scene(seed=6)
    out = case.render(case.leaves(splats), camera)
    target_loss(out.rgb).backward()
    assert out.statistics.hits.sum() == 0
    assert out.statistics.blend_sum.sum() == 0
    assert out.statistics.blend_max.sum() == 0
    assert out.statistics.loo.sum() == 0
    assert out.statistics.means2d_grad.abs().max() > 0


@pytest.mark.integration
def test_gradients_of_pixels_add_up_to_their_definitions(case):
    splats, camera = scene(seed=6)
    nudges = Nudges.zeros(len(splats), camera)
    truth = composited(splats, camera, GREENISH, 0, nudges=nudges)
    target_loss(truth.rgb).backward()
    parts, s = nudges.means2d.grad, nudges.log_alphas.grad
    fragments = (truth.weights > 0).sum((1, 2))
    variance = s.square().sum((1, 2)) - s.sum((1, 2)).square() / fragments.clamp_min(1)

    out = case.render(case.leaves(splats), camera, GREENISH, scores=True)
    target_loss(out.rgb).backward()
    found = out.statistics
    assert close(found.means2d_grad, parts.sum((1, 2)), SUM_TOLERANCE[case.dtype])
    assert close(found.variance, variance, SQUARE_TOLERANCE[case.dtype])


def test_clamped_fragments_count_in_the_variance_and_add_nothing_to_it(case):
    splats = one_splat((0.0, 0.0, 2.0), scale=0.3, opacity=1 - 1e-9, color=(0.8, 0.4, 0.2))
    splats, camera = case.rounded(splats), camera_at(33, 20)
    nudges = Nudges.zeros(1, camera)
    truth = composited(splats, camera, GREENISH, 0, nudges=nudges)
    target_loss(truth.rgb).backward()
    s = nudges.log_alphas.grad
    fragments = (truth.weights > 0).sum((1, 2))
    assert ((s != 0).sum((1, 2)) < fragments).all()  # the middle was clamped
    variance = s.square().sum((1, 2)) - s.sum((1, 2)).square() / fragments
    out = case.render(case.leaves(splats), camera, GREENISH, scores=True)
    target_loss(out.rgb).backward()
    assert close(out.statistics.variance, variance, SQUARE_TOLERANCE[case.dtype])


@pytest.mark.integration
def test_leave_one_out_is_the_squared_change_of_removing_that_gaussian(case):
    splats, camera = scene(seed=6)
    out = case.render(case.leaves(splats), camera, GREENISH, 2, scores=True)
    out.rgb.sum().backward()
    expected = changes(6, 2).sum((1, 2))
    assert close(out.statistics.loo, expected, SQUARE_TOLERANCE[case.dtype])


@pytest.mark.integration
def test_pixels_that_a_mask_ignores_count_in_no_score(case):
    splats, camera = scene(seed=6)
    mask = torch.rand(20, 33, generator=torch.Generator().manual_seed(0)) < 0.5
    out = case.render(case.leaves(splats), camera, GREENISH, scores=True,
                      mask=mask.to(case.device))
    out.rgb.sum().backward()
    found, weights = out.statistics, composited(splats, camera, BLACK, 0).weights * mask
    assert torch.equal(found.hits.cpu(), (weights > 0).sum((1, 2)))
    assert close(found.blend_sum, weights.sum((1, 2)), SUM_TOLERANCE[case.dtype])
    assert close(found.blend_max, weights.amax((1, 2)), SUM_TOLERANCE[case.dtype])
    expected = (changes(6, 0) * mask).sum((1, 2))
    assert close(found.loo, expected, SQUARE_TOLERANCE[case.dtype])


@pytest.mark.integration
def test_a_mask_of_the_scores_changes_neither_picture_nor_gradient(case):
    splats, camera = scene(seed=6)
    pictures = []
    for mask in (None, torch.zeros(20, 33, dtype=torch.bool, device=case.device)):
        tracked = case.leaves(splats)
        out = case.render(tracked, camera, GREENISH, scores=True, mask=mask)
        target_loss(out.rgb).backward()
        pictures.append((out.rgb, tracked.means.grad, out.statistics.variance))
    assert all(torch.equal(a, b) for a, b in zip(*pictures, strict=True))
    assert out.statistics.hits.sum() == 0
    assert out.statistics.loo.sum() == 0


def test_a_mask_of_another_size_or_type_is_refused(case):
    splats, camera = scene(seed=6)
    for mask in (torch.ones(33, 20, dtype=torch.bool), torch.ones(20, 33)):
        with raises(ValueError, "mask"):
            case.render(splats, camera, scores=True, mask=mask.to(case.device))


def test_the_gradient_of_the_projected_mean_moves_the_image(case):
    camera = camera_at(40, 30)
    splats = one_splat((0.1, 0.0, 3.0), scale=0.2, opacity=0.7, color=(0.9, 0.9, 0.9))
    out = case.render(case.leaves(splats), camera)
    target = torch.zeros_like(out.rgb)
    target[:, 20:] = 1.0
    (out.rgb - target).square().mean().backward()
    assert out.statistics.means2d_grad[0, 0] < 0  # moving right lowers the loss


def test_a_gaussian_without_fragments_has_zeros_and_never_nan(case):
    # its ellipse lies between the pixel centres: seen by the projection, hit by no pixel
    camera = camera_at(8, 8)
    camera = type(camera)(8, 8, 1e-3, 1e-3, 4.0, 4.0, camera.viewmat)
    small = one_splat((0.0, 0.0, 2.0), scale=1e-4, opacity=0.005, color=(1.0, 1.0, 1.0))
    far = one_splat((0.0, 0.0, -2.0), scale=1e-4, opacity=0.5, color=(1.0, 1.0, 1.0))
    splats = case.leaves(joined(small, far))
    rounded = case.rounded(splats).map(lambda tensor: tensor.cpu())
    assert composited(rounded, camera, BLACK, 0).weights.sum() == 0
    out = case.render(splats, camera, scores=True)
    out.rgb.sum().backward()
    found = out.statistics
    for values in (found.hits, found.blend_max, found.means2d_grad, found.variance, found.loo):
        assert (values == 0).all()
    assert all((p.grad == 0).all() for p in splats.parameters().values() if p.grad is not None)


def test_a_pixel_alone_has_no_variance(case):
    camera = camera_at(1, 1, focal=3.0)
    splats = leaves(case.cast(random_splats(20, seed=1)))
    out = case.render(splats, camera, GREENISH, scores=True)
    target_loss(out.rgb).backward()
    largest = out.statistics.means2d_grad.abs().max().item() ** 2
    assert largest > 0
    assert out.statistics.variance.max() <= 1e-6 * largest  # s^2 - s^2 / 1, up to its rounding
