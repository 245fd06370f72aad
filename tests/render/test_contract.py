"""The rasterizer's contract, for every backend: closed form, oracle, gradients, refusals."""

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
    ORACLE_SH_TOLERANCE,
    compared,
    every_backend,
)
from facts import raises
from oracle import brute_force
from scenes import camera_at, joined, one_splat, random_splats

from recon_cli.render import render
from recon_cli.scene.splats import Splats

pytestmark = every_backend

# One fragment: the rounding of its alpha alone.
CLOSED_FORM_TOLERANCE = {torch.float32: 2e-6, torch.float64: 1e-13}


@pytest.mark.integration
def test_one_gaussian_at_a_known_pixel_has_its_closed_form_colour(case):
    camera = camera_at(64, 48)
    splats = one_splat((0.2, 0.1, 3.0), scale=0.1, opacity=0.6, color=(0.9, 0.5, 0.1))
    out = case.render(splats, camera)
    local = camera.viewmat[:3, :3] @ [0.2, 0.1, 3.0] + camera.viewmat[:3, 3]
    x, y, z = local
    mean = (camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy)
    column, row = int(mean[0]), int(mean[1])
    a = (camera.fx / z * 0.1) ** 2 * (1 + (x / z) ** 2) + 0.3
    b = camera.fx * camera.fy / z**2 * 0.01 * (x / z) * (y / z)
    c = (camera.fy / z * 0.1) ** 2 * (1 + (y / z) ** 2) + 0.3
    dx, dy = column + 0.5 - mean[0], row + 0.5 - mean[1]
    q = (c * dx * dx - 2 * b * dx * dy + a * dy * dy) / (a * c - b * b)
    alpha = 0.6 * math.exp(-q / 2)
    expected = torch.tensor([0.9, 0.5, 0.1], dtype=torch.float64) * alpha
    limit = CLOSED_FORM_TOLERANCE[case.dtype]
    assert torch.allclose(out.rgb[row, column].cpu().double(), expected, rtol=0, atol=limit)
    assert out.alpha[row, column].item() == pytest.approx(alpha, abs=limit)
    assert out.depth[row, column].item() == pytest.approx(alpha * z, abs=10 * limit)


def test_the_front_gaussian_covers_the_one_behind_it(case):
    camera = camera_at(16, 16)
    front = one_splat((0.0, 0.0, 2.0), scale=5.0, opacity=0.75, color=(1.0, 0.0, 0.0))
    back = one_splat((0.0, 0.0, 4.0), scale=9.0, opacity=0.5, color=(0.0, 1.0, 0.0))
    out, front_alone, back_alone = (
        case.render(splats, camera) for splats in (joined(back, front), front, back))
    expected = front_alone.rgb + (1 - front_alone.alpha)[..., None] * back_alone.rgb
    assert torch.allclose(out.rgb, expected, rtol=0, atol=CLOSED_FORM_TOLERANCE[case.dtype])


def test_an_empty_view_shows_the_background(case):
    background = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    behind = one_splat((0.0, 0.0, -3.0), scale=0.1, opacity=0.9, color=(1.0, 1.0, 1.0))
    for splats in (behind, behind.select(torch.zeros(1, dtype=torch.bool))):
        tracked = case.leaves(splats)
        out = case.render(tracked, camera_at(), background, 3, scores=True)
        shown = background.to(case.dtype).expand(37, 50, 3)
        assert torch.equal(out.rgb.cpu(), shown)
        assert out.alpha.abs().max() == 0
        out.rgb.sum().backward()
        assert all((p.grad == 0).all() for p in tracked.parameters().values())
        assert out.statistics.radii.sum() == 0
        assert out.statistics.broken == 0


def scene_for(case, *, seed):
    """Returns Gaussians and a camera of several tiles, the last ones cut by the border.

    Fewer and smaller for an interpreter, which takes a tenth of a second for ten Gaussians in a
    tile.
    """
    count, size = (60, (33, 20)) if case.interpreted else (150, (50, 37))
    return random_splats(count, seed=seed), camera_at(*size)


@pytest.mark.integration
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_images_and_gradients_agree_with_the_brute_force(case, degree):
    splats, camera = scene_for(case, seed=degree)
    found = compared(case, splats, camera, GREENISH, degree)
    assert found.image <= IMAGE_TOLERANCE[case.dtype]
    assert found.doubtful <= 0.01 * camera.width * camera.height
    for name, error in found.gradients.items():
        loose = ORACLE_SH_TOLERANCE if name == "means" and degree else 0.0
        assert error <= max(GRADIENT_TOLERANCE[case.dtype], loose), f"{name}: {error:.1e}"


@pytest.mark.integration
def test_the_gradient_of_the_background_is_what_is_left_of_it(case):
    background = GREENISH.clone().requires_grad_()
    splats, camera = scene_for(case, seed=5)
    generator = torch.Generator().manual_seed(0)
    weights = torch.randn(camera.height, camera.width, 3, generator=generator)
    out = case.render(splats, camera, background)
    (out.rgb.cpu() * weights).sum().backward()
    alpha = brute_force(case.rounded(splats), camera, BLACK, 0)[1]
    expected = ((1 - alpha)[..., None] * weights).sum((0, 1))
    # 1,850 terms of either sign add up here, which costs digits
    limit = {torch.float32: 1e-3, torch.float64: 1e-11}[case.dtype]
    assert torch.allclose(background.grad, expected.double(), rtol=0, atol=limit)


@pytest.mark.integration
def test_coefficients_that_are_not_in_use_get_no_gradient(case):
    tracked, camera = case.leaves(random_splats(12)), camera_at(20, 12)
    case.render(tracked, camera).rgb.sum().backward()
    assert tracked.sh_rest.grad is None
    case.render(tracked, camera, degree=1).rgb.sum().backward()
    assert tracked.sh_rest.grad[:, :3].abs().max() > 0
    assert tracked.sh_rest.grad[:, 3:].abs().max() == 0


def test_gradcheck_passes_away_from_thresholds(case):
    if case.dtype == torch.float32:
        pytest.skip("central differences need float64")
    camera = camera_at(7, 5, focal=6.0)
    near = one_splat((0.0, 0.0, 2.0), scale=1.0, opacity=0.5, color=(0.7, 0.4, 0.2))
    far = one_splat((0.3, 0.1, 3.0), scale=1.5, opacity=0.4, color=(0.3, 0.8, 0.6))
    both = joined(near, far)
    generator = torch.Generator().manual_seed(1)
    noise = {name: 0.05 * torch.randn(value.shape, generator=generator, dtype=torch.float64)
             for name, value in both.parameters().items()}
    names = list(noise)
    values = [(getattr(both, n) + noise[n]).to(case.device).requires_grad_() for n in names]

    def image(*tensors):
        out = render(Splats(**dict(zip(names, tensors, strict=True))), camera,
                     BLACK.to(case.device), 3, backend=case.backend)
        return out.rgb, out.alpha, out.depth

    assert torch.autograd.gradcheck(
        image, values, eps=1e-6, atol=1e-6, rtol=1e-5, fast_mode=True)


@pytest.mark.integration
def test_long_lists_are_carried_across_blocks(case):
    # blocks end at every 64th of all instances; an interpreter's lists of 100 and 93 reach over 5
    count = 300 if case.interpreted else 500
    faint = random_splats(count, seed=4)
    faint.logit_opacities = torch.full((count,), -3.0, dtype=torch.float64)
    found = compared(case, faint, camera_at(20, 12 if case.interpreted else 20), BLACK, 1)
    assert found.image <= IMAGE_TOLERANCE[case.dtype]
    assert found.gradient <= max(GRADIENT_TOLERANCE[case.dtype], ORACLE_SH_TOLERANCE)
    assert found.doubtful <= 4


@pytest.mark.integration
@pytest.mark.parametrize("size", [(1, 1), (15, 17), (16, 16), (33, 1)])
def test_any_image_size_and_principal_point_work(case, size):
    camera = camera_at(*size, focal=20.0)
    camera = type(camera)(*size, 20.0, 20.0, -7.5, 40.0, camera.viewmat)  # outside the image
    found = compared(case, random_splats(80, seed=8), camera, BLACK, 1)
    assert found.doubtful <= 2
    assert found.image <= IMAGE_TOLERANCE[case.dtype]
    for name, error in found.gradients.items():
        loose = ORACLE_SH_TOLERANCE if name == "means" else 0.0
        assert error <= max(GRADIENT_TOLERANCE[case.dtype], loose), f"{name}: {error:.1e}"


def test_wrong_shapes_and_degrees_are_refused(case):
    splats = case.cast(random_splats(3))
    black = torch.zeros(3, dtype=case.dtype, device=case.device)
    other = torch.float64 if case.dtype == torch.float32 else torch.float32
    with raises(ValueError, "background"):
        render(splats, camera_at(), black.new_zeros(4), 0, backend=case.backend)
    with raises(ValueError, "sh_degree"):
        render(splats, camera_at(), black, 4, backend=case.backend)
    with raises(ValueError, "dtype"):
        render(splats, camera_at(), black.to(other), 0, backend=case.backend)


def test_float64_is_refused_by_the_backend_that_cannot_take_it(case):
    if case.backend != "numba":
        pytest.skip(f"{case.backend} takes float64")
    assert [other for other in CASES if other.backend == "numba"] == [case]
    with raises(ValueError, "float32"):
        render(random_splats(3), camera_at(), BLACK, 0, backend="numba")
