"""Values that are not finite, huge coefficients, and colours below black. See notes/numerics."""

from __future__ import annotations

import math

import pytest
import torch
from backends import (
    BLACK,
    GRADIENT_TOLERANCE,
    GREENISH,
    IMAGE_TOLERANCE,
    ORACLE_SH_TOLERANCE,
    compared,
    every_backend_at_size,
)
from oracle import brute_force
from scenes import camera_at, joined, one_splat, random_splats

from recon_cli.scene.splats import SH_C0

pytestmark = every_backend_at_size

NOT_FINITE = [math.nan, math.inf, -math.inf]
PARAMETERS = list(random_splats(1).parameters())


def visible_splats(count: int, seed: int):
    """Gaussians that all lie in the image, so that each that is broken has to be counted."""
    splats = random_splats(count, seed=seed)
    splats.means[:, :2] *= 0.2
    splats.means[:, 2] = splats.means[:, 2].abs() + 1.0
    splats.logit_opacities.clamp_(-2.0, 1.0)
    return splats


def finite_gradients(tracked, *, without: int | None = None):
    """Every gradient is finite, and zero in the row `without`."""
    for name, parameter in tracked.parameters().items():
        if parameter.grad is None:
            continue
        assert torch.isfinite(parameter.grad).all(), name
        assert without is None or parameter.grad[without].abs().max() == 0, name


@pytest.mark.parametrize("value", NOT_FINITE)
@pytest.mark.parametrize("name", PARAMETERS)
def test_a_value_that_is_not_finite_culls_its_gaussian_alone_and_is_counted(case, name, value):
    broken = visible_splats(24, seed=9)
    getattr(broken, name).view(24, -1)[7, -1] = value
    kept = broken.select(torch.arange(24) != 7)
    expected = case.render(kept, camera_at(33, 20), GREENISH, 3)
    tracked = case.leaves(broken)
    out = case.render(tracked, camera_at(33, 20), GREENISH, 3, scores=True)
    (out.rgb.square().sum() + out.depth.sum()).backward()
    assert torch.equal(out.rgb, expected.rgb)
    assert torch.equal(out.depth, expected.depth)
    finite_gradients(tracked, without=7)
    found = out.statistics
    for values in (found.radii, found.hits, found.blend_max, found.means2d_grad,
                   found.variance, found.loo):
        assert torch.isfinite(values).all()
        assert values[7].abs().max() == 0
    assert found.broken == 1
    assert expected.statistics.broken == 0


@pytest.mark.parametrize("entry", range(4))
def test_each_entry_of_a_parameter_is_looked_at(case, entry):
    broken = visible_splats(20, seed=10)
    broken.quats[5, entry] = math.nan
    broken.means[6, entry % 3] = math.inf
    broken.log_scales[7, entry % 3] = math.nan
    broken.sh_rest[8, entry, entry % 3] = math.nan
    tracked = case.leaves(broken)
    out = case.render(tracked, camera_at(33, 20), BLACK, 3)
    out.rgb.sum().backward()
    assert torch.isfinite(out.rgb).all()
    finite_gradients(tracked)
    assert out.statistics.broken == 4


def test_coefficients_that_are_not_in_use_may_hold_anything(case):
    splats = visible_splats(20, seed=11)
    for degree in range(3):
        later = splats.map(torch.clone)
        later.sh_rest[:, (degree + 1) ** 2 - 1:] = math.nan
        tracked = case.leaves(later)
        out = case.render(tracked, camera_at(33, 20), BLACK, degree)
        out.rgb.sum().backward()
        assert torch.equal(out.rgb, case.render(splats, camera_at(33, 20), BLACK, degree).rgb)
        assert out.statistics.broken == 0
        finite_gradients(tracked)


def test_a_scene_of_nothing_but_nan_shows_the_background(case):
    splats = visible_splats(20, seed=12).map(lambda tensor: tensor * math.nan)
    tracked = case.leaves(splats)
    out = case.render(tracked, camera_at(33, 20), GREENISH, 3, scores=True)
    out.rgb.sum().backward()
    assert torch.equal(out.rgb.cpu(), GREENISH.to(case.dtype).expand(20, 33, 3))
    finite_gradients(tracked)
    assert out.statistics.broken == 20


@pytest.mark.parametrize(("name", "value"), [
    ("log_scales", 100.0), ("log_scales", 3e38), ("log_scales", -100.0), ("log_scales", -3e38),
    ("means", 3e38), ("means", -3e38), ("quats", 3e38), ("logit_opacities", 3e38),
    ("logit_opacities", -3e38), ("sh_dc", 1e18), ("sh_rest", 1e18), ("sh_rest", 3e38),
])
def test_the_largest_finite_values_spoil_no_other_gaussian(case, name, value):
    huge = visible_splats(16, seed=13)
    getattr(huge, name)[7] = value
    tracked = case.leaves(huge)
    out = case.render(tracked, camera_at(33, 20), GREENISH, 3)
    weights = torch.linspace(-1, 1, out.rgb.numel(), dtype=case.dtype, device=case.device)
    (out.rgb.reshape(-1) * weights).sum().backward()
    assert torch.isfinite(out.rgb).all()
    assert ((out.alpha >= 0) & (out.alpha <= 1)).all()
    finite_gradients(tracked)
    if name in ("means", "log_scales") and value > 1e30:  # far beside the image, or infinite
        assert tracked.sh_dc.grad[7].abs().max() == 0


def test_colours_below_black_are_clamped_and_have_no_gradient(case):
    dark = one_splat((0.1, 0.0, 2.0), scale=0.3, opacity=0.7, color=(-0.4, 0.5, -1e-3))
    behind = one_splat((0.0, 0.0, 3.0), scale=0.5, opacity=0.5, color=(0.2, 0.3, 0.4))
    splats = joined(dark, behind)
    tracked = case.leaves(splats)
    out = case.render(tracked, camera_at())
    out.rgb.sum().backward()
    assert (out.rgb >= 0).all()
    assert tracked.sh_dc.grad[0, 0] == 0
    assert tracked.sh_dc.grad[0, 1] > 0
    assert tracked.sh_dc.grad[0, 2] == 0
    found = compared(case, splats, camera_at())
    assert found.image <= IMAGE_TOLERANCE[case.dtype]
    assert found.gradient <= GRADIENT_TOLERANCE[case.dtype]


def test_coefficients_seen_from_outside_the_training_cone_stay_bounded(case):
    # A colour that fits views from the front swings below black and far above white elsewhere.
    splats = visible_splats(40, seed=14)
    splats.sh_rest *= 30.0
    camera = camera_at()
    expected = brute_force(case.rounded(splats), camera, BLACK, 3)[0]
    assert expected.max() > 2
    found = compared(case, splats, camera, BLACK, degree=3)
    assert found.image <= IMAGE_TOLERANCE[case.dtype]
    for name, error in found.gradients.items():
        limit = max(GRADIENT_TOLERANCE[case.dtype], ORACLE_SH_TOLERANCE if name == "means" else 0)
        assert error <= limit, f"{name}: {error:.1e}"
    tracked = case.leaves(splats)
    out = case.render(tracked, camera, BLACK, 3)
    assert (out.rgb >= 0).all()
    largest = SH_C0 * splats.sh_dc.abs().amax() + 0.5 + 4.0 * splats.sh_rest.norm(dim=1).amax()
    assert out.rgb.max() <= largest  # |basis| over degrees 1 to 3 is sqrt(15 / (4 pi)) < 4
