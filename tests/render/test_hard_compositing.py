"""Hard cases of compositing: opaque layers, thresholds, ties, long lists. See notes/numerics."""

from __future__ import annotations

import math

import pytest
import torch
from backends import (
    BLACK,
    CASES,
    GRADIENT_TOLERANCE,
    GREENISH,
    IMAGE_TOLERANCE,
    compared,
    every_backend,
    every_backend_at_size,
)
from oracle import composited
from scenes import camera_at, joined, one_splat, random_splats

from recon_cli.render.contract import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from recon_cli.scene.splats import SH_C0, Splats

# T before the fragment that would leave less than 1e-4: alpha is at most .99
STOPPED_BELOW = TRANSMITTANCE_MIN / (1 - ALPHA_MAX)


def layers(count: int, *, logit: float, seed: int = 0) -> Splats:
    """Round Gaussians one behind the other that cover `camera_at(8, 8)`, of random colours."""
    generator = torch.Generator().manual_seed(seed)
    colors = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    one = one_splat((0.0, 0.0, 2.0), scale=50.0, opacity=0.5, color=(0.5, 0.5, 0.5))
    splats = one.map(lambda tensor: tensor.repeat(count, *[1] * (tensor.dim() - 1)))
    splats.means[:, 2] += 0.01 * torch.arange(count)
    splats.logit_opacities[:] = logit
    splats.sh_dc[:] = (colors - 0.5) / SH_C0
    return splats


def rendered(case, splats, camera, **options):
    """The picture and its Gaussians after the backward pass of a sum of squares."""
    tracked = case.leaves(splats)
    out = case.render(tracked, camera, GREENISH, **options)
    out.rgb.square().sum().backward()
    for parameter in tracked.parameters().values():
        assert parameter.grad is None or torch.isfinite(parameter.grad).all()
    return out, tracked


@every_backend
def test_opacities_of_one_are_clamped_and_have_no_gradient_where_they_are(case):
    out, tracked = rendered(case, layers(1, logit=40.0), camera_at(8, 8))
    assert out.alpha.min().item() == pytest.approx(ALPHA_MAX, abs=1e-6)
    assert out.alpha.max().item() == pytest.approx(ALPHA_MAX, abs=1e-6)
    assert (tracked.logit_opacities.grad == 0).all()  # every pixel is clamped
    assert (tracked.means.grad == 0).all()
    assert (tracked.sh_dc.grad != 0).all()


@pytest.mark.integration
@every_backend
def test_a_saturated_opacity_keeps_its_gradient_where_alpha_is_not_clamped(case):
    splats = one_splat((0.0, 0.0, 2.0), scale=0.3, opacity=0.5, color=(0.9, 0.5, 0.1))
    for logit in (10.0, 15.0, 40.0):  # 1 - o is 5e-5, 3e-7 and 4e-18
        splats.logit_opacities[:] = logit
        found = compared(case, splats, camera_at(30, 24), degree=0)
        assert found.gradients["logit_opacities"] <= GRADIENT_TOLERANCE[case.dtype]
        assert found.gradient <= GRADIENT_TOLERANCE[case.dtype]
        assert found.image <= IMAGE_TOLERANCE[case.dtype]


@every_backend
@pytest.mark.parametrize("logit", [-40.0, -5.55])  # 1/255 is -5.537
def test_opacities_below_one_step_are_culled_without_a_gradient(case, logit):
    out, tracked = rendered(case, layers(3, logit=logit), camera_at(8, 8), scores=True)
    assert out.alpha.abs().max() == 0
    assert (tracked.logit_opacities.grad == 0).all()
    assert out.statistics.broken == 0


@every_backend
def test_opaque_layers_stop_before_the_third_however_many(case):
    splats = layers(100 if case.interpreted else 1000, logit=40.0)
    out, tracked = rendered(case, splats, camera_at(8, 8), scores=True)
    left = 1 - out.alpha.double()
    # Two clamped fragments leave 1e-4; the threshold lies a rounding margin below that.
    assert (left - 1e-4).abs().max() <= 1e-7  # alpha is near 1, where float32 steps by 6e-8
    assert (out.statistics.hits[:2] == 64).all()
    assert (out.statistics.hits[2:] == 0).all()
    assert all((p.grad[2:] == 0).all() for p in tracked.parameters().values()
               if p.grad is not None)


@every_backend
@pytest.mark.parametrize("logit", [0.0, 2.0, 4.0])
def test_many_layers_agree_with_the_oracle_until_the_pixel_stops(case, logit):
    splats = layers(80, logit=logit, seed=1)  # more than a block of any backend
    found = compared(case, splats, camera_at(8, 8))
    assert found.doubtful == 0
    assert found.image <= IMAGE_TOLERANCE[case.dtype]
    # the picture hardly depends on where these Gaussians lie: a gradient of the mean is the
    # remainder of parts that cancel
    for name in ("log_scales", "logit_opacities", "sh_dc"):
        assert found.gradients[name] <= GRADIENT_TOLERANCE[case.dtype], name


@every_backend_at_size
def test_the_transmittance_of_faint_layers_does_not_underflow(case):
    splats = layers(3000, logit=-4.0)  # alpha .018: 3,000 would leave 1e-24
    out, _ = rendered(case, splats, camera_at(8, 8), scores=True)
    left = 1 - out.alpha.double()
    alpha = 1 / (1 + math.exp(4.0))
    stop = math.floor(math.log(TRANSMITTANCE_MIN) / math.log1p(-alpha))
    # the covariance of the layers shades their alpha by less than 1e-3 across 8 pixels
    assert (out.statistics.hits > 0).sum().item() == pytest.approx(stop, abs=3)
    assert left.min() >= TRANSMITTANCE_MIN * (1 - 1e-3)
    assert left.max() <= TRANSMITTANCE_MIN / (1 - alpha) * (1 + 1e-2)


@every_backend
def test_coincident_gaussians_composite_in_order_of_index(case):
    red = one_splat((0.0, 0.0, 2.0), scale=5.0, opacity=0.8, color=(1.0, 0.0, 0.0))
    green = one_splat((0.0, 0.0, 2.0), scale=5.0, opacity=0.8, color=(0.0, 1.0, 0.0))
    first = case.render(joined(red, green), camera_at(8, 8)).rgb
    second = case.render(joined(green, red), camera_at(8, 8)).rgb
    assert (first[..., 0] > first[..., 1]).all()
    assert (second[..., 1] > second[..., 0]).all()


@every_backend_at_size
def test_a_hundred_coincident_gaussians_agree_with_the_oracle(case):
    splats = layers(100, logit=-2.0, seed=2)
    splats.means[:] = torch.tensor([0.0, 0.0, 2.0])
    splats.log_scales[:] = torch.tensor([-2.0, -1.5, -1.0])
    found = compared(case, splats, camera_at())
    assert found.doubtful <= 18
    assert found.image <= IMAGE_TOLERANCE[case.dtype]
    assert found.gradient <= GRADIENT_TOLERANCE[case.dtype]


@pytest.mark.integration
@every_backend
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_thresholds_drop_no_more_than_the_theory_says(case, seed):
    # Dropping a fragment changes a pixel by alpha T (c - B), and c and B, the colour behind, lie
    # between 0 and the greatest colour. Taken out from back to front, each with the transmittance
    # of the picture without thresholds; stopping exchanges what is behind for the background.
    splats = case.rounded(random_splats(60 if case.interpreted else 150, seed=seed))
    camera = camera_at(33, 20)
    whole = composited(splats, camera, GREENISH, 0, thresholds=False)
    faint = (whole.alphas > 0) & (whole.alphas < ALPHA_MIN)
    dropped = (whole.weights * faint).sum(0)
    out = case.render(splats, camera, GREENISH)
    left = 1 - out.alpha.cpu().double()
    stopped = torch.where(left < STOPPED_BELOW * (1 + 1e-5), left, 0.0)
    greatest = max(GREENISH.max(), (SH_C0 * splats.sh_dc + 0.5).max())
    error = (out.rgb.cpu().double() - whole.rgb).abs().amax(-1)
    rounding = IMAGE_TOLERANCE[case.dtype]
    assert (error <= greatest * (dropped + stopped) + rounding).all()
    assert error.max() > rounding  # the thresholds do drop something here
    assert dropped.max() <= faint.sum(0).max() * ALPHA_MIN


@every_backend_at_size
def test_gaussians_that_cover_every_tile_agree_with_the_oracle(case):
    splats = random_splats(20, seed=3)
    splats.means[:, 2] = splats.means[:, 2].abs() + 1.0
    splats.log_scales[:] = 1.0
    splats.log_scales[:, 1] = 0.5
    splats.logit_opacities[:] = -2.0
    found = compared(case, splats, camera_at(50, 37))
    assert found.doubtful <= 18
    assert found.image <= IMAGE_TOLERANCE[case.dtype]
    assert found.gradient <= GRADIENT_TOLERANCE[case.dtype]


def _covering(count: int) -> Splats:
    """Faint Gaussians that reach every tile of a picture; alpha is 1/250 in the middle."""
    splats = random_splats(count, seed=4, dtype=torch.float32)
    splats.means[:, 2] = splats.means[:, 2].abs() + 1.0
    splats.log_scales[:] = 4.0
    splats.logit_opacities[:] = math.log(0.004 / 0.996)
    return splats


@pytest.mark.slow
@pytest.mark.timeout(120)
@pytest.mark.parametrize("case", [c for c in CASES if c.dtype == torch.float32], ids=str)
def test_up_to_ten_million_instances_fit_into_memory_and_into_integers(case):
    if case.interpreted:
        pytest.skip("a million instances take an interpreter hours")
    count = 2_000 if case.backend == "torch" else 20_000  # the torch backend takes its time
    camera = camera_at(480, 270, focal=300.0)
    tracked = case.leaves(_covering(count))
    out = case.render(tracked, camera, BLACK, scores=True)
    assert (out.statistics.radii > 1000).all()  # every tile, 17 x 30 of 16 x 16 pixels each
    assert torch.isfinite(out.rgb).all()
    out.rgb.mean().backward()
    for parameter in tracked.parameters().values():
        assert parameter.grad is None or torch.isfinite(parameter.grad).all()
    left = (1 - 0.004) ** out.statistics.hits.sum().div(480 * 270).item()
    assert (1 - out.alpha).mean().item() == pytest.approx(left, rel=0.05)
