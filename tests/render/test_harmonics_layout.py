"""Splats of which only some have higher spherical harmonics, of any degree, for every backend."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
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
from scenes import camera_at, joined, one_splat, random_splats, with_harmonics

from recon_cli.kernels.thread_pool import pool
from recon_cli.render.contract import StepOptions, TargetImage
from recon_cli.render.numba.step import PhotometricStep
from recon_cli.scene.splats import TERMS, with_rows

N = 70
GUARD = 64  # numbers behind a buffer; the widest vector has 16
every_degree = pytest.mark.parametrize("degree", range(4))
# none, one, a share that ends within a vector of Gaussians, all but one, all
every_share = pytest.mark.parametrize("colored", [0, 1, 33, N - 1, N])


def camera_for(case):
    """Returns a camera of many tiles, or of two for an interpreter."""
    return camera_at(18, 12) if case.interpreted else camera_at()


def ones(colored: int, degree: int, *, seed: int = 5):
    return with_harmonics(random_splats(N, seed=seed), degree, colored)


@every_backend_at_size
@every_degree
@every_share
def test_images_and_gradients_agree_with_the_brute_force(case, degree, colored):
    # degree 3 is asked for: what the splats do not have is not in use
    found = compared(case, ones(colored, degree), camera_for(case), GREENISH, 3)
    assert found.image <= IMAGE_TOLERANCE[case.dtype]
    for name, error in found.gradients.items():
        loose = ORACLE_SH_TOLERANCE if name == "means" else 0.0
        assert error <= max(GRADIENT_TOLERANCE[case.dtype], loose), f"{name}: {error:.1e}"


@every_backend_at_size
@pytest.mark.parametrize(("used", "stored"), [(1, 2), (1, 3), (2, 3)])
def test_a_lower_degree_in_use_agrees_with_the_brute_force(case, used, stored):
    found = compared(case, ones(33, stored), camera_for(case), GREENISH, used)
    assert found.image <= IMAGE_TOLERANCE[case.dtype]
    limit = max(GRADIENT_TOLERANCE[case.dtype], ORACLE_SH_TOLERANCE)
    assert found.gradient <= limit


@every_backend_at_size
@every_degree
def test_a_gaussian_without_coefficients_has_exactly_its_base_colour(case, degree):
    plain = one_splat((0.5, 0.1, 3.0), scale=0.1, opacity=0.6, color=(0.9, 0.5, 0.1))
    loud = one_splat((-1.0, 0.1, 3.0), scale=0.1, opacity=0.6, color=(0.5, 0.5, 0.5))
    loud = replace(loud, sh_rest=torch.full((1, TERMS[degree], 3), 9.0, dtype=torch.float64))
    plain = with_harmonics(plain, degree, 0)
    both = replace(joined(loud, plain), sh_rest=loud.sh_rest)
    camera = camera_at(64, 48)
    local = camera.viewmat[:3, :3] @ plain.means[0].numpy() + camera.viewmat[:3, 3]
    column = int(camera.fx * local[0] / local[2] + camera.cx)
    row = int(camera.fy * local[1] / local[2] + camera.cy)
    out, alone = (case.render(splats, camera, BLACK, 3) for splats in (both, plain))
    assert torch.equal(out.rgb[row, column], alone.rgb[row, column])
    alpha = out.alpha[row, column].item()
    assert alpha > 0.5
    assert out.rgb[row, column].tolist() == pytest.approx(
        [0.9 * alpha, 0.5 * alpha, 0.1 * alpha], abs=2e-7)


@every_backend_at_size
@every_degree
@every_share
def test_no_coefficients_and_coefficients_of_zero_are_the_same_picture(case, degree, colored):
    few = case.leaves(ones(colored, degree))
    zeros = case.leaves(replace(few, sh_rest=with_rows(few.sh_rest, N)))
    images = []
    for splats in (few, zeros):
        out = case.render(splats, camera_for(case), GREENISH, 3)
        (out.rgb.square().sum() + out.depth.sum()).backward()
        images.append(out.rgb)
    assert torch.equal(*images)
    for name, value in few.parameters().items():
        theirs = getattr(zeros, name).grad
        if value.grad is None:
            assert theirs is None or degree * colored == 0
        else:
            assert torch.equal(value.grad, theirs[: len(value)]), name


@every_backend_at_size
def test_only_coefficients_that_exist_and_are_in_use_can_be_broken(case):
    splats = ones(60, 2)
    splats.means[:, :2] *= 0.2
    splats.means[:, 2] = splats.means[:, 2].abs() + 1.0
    splats.logit_opacities.clamp_(-2.0, 1.0)
    splats.sh_rest[59, 7, 2] = math.nan
    splats.sh_rest[0, 0, 0] = math.inf
    tracked = case.leaves(splats)
    for degree, expected in ((0, 0), (1, 1), (2, 2), (3, 2)):
        out = case.render(tracked, camera_for(case), GREENISH, degree)
        out.rgb.sum().backward()
        assert out.statistics.broken == expected
        assert torch.isfinite(out.rgb).all()
    for value in tracked.parameters().values():
        assert torch.isfinite(value.grad).all()


# ---- memory and threads of the kernels ----

def guarded(splats, guard):
    """Splats whose coefficients lie before numbers that must not be touched, and these numbers."""
    size = splats.sh_rest.numel()
    buffer = torch.full((size + GUARD,), guard)
    buffer[:size] = splats.sh_rest.reshape(-1)
    return replace(splats, sh_rest=buffer[:size].view(splats.sh_rest.shape)), buffer[size:]


def step_of(splats, gradients, degree):
    camera = camera_at(60, 41)
    truth = np.random.default_rng(0).integers(0, 256, (41, 60, 3), np.uint8)
    return PhotometricStep()(
        splats, gradients, camera, TargetImage(truth), StepOptions(degree, 0.2))


@every_degree
@every_share
@pytest.mark.parametrize("used", [1, 2, 3])
def test_kernels_touch_nothing_behind_the_last_coefficients(degree, colored, used):
    whole = ones(colored, degree).map(torch.Tensor.float)
    splats, behind = guarded(whole, math.nan)
    gradients, written = guarded(whole.map(lambda tensor: torch.full_like(tensor, -7.0)), -7.0)
    loss = step_of(splats, gradients, used)
    assert math.isfinite(loss)
    assert torch.isnan(behind).all()
    assert (written == -7).all()
    for name, value in gradients.parameters().items():
        assert torch.isfinite(value).all(), name
    assert not (gradients.sh_rest == -7).any()  # zeros where nothing was seen
    assert (gradients.sh_rest[:, TERMS[used]:] == 0).all()


@pytest.mark.parametrize(("degree", "colored"), [(1, 2999), (2, 1111), (3, 1024), (3, 1500)])
def test_kernels_give_the_same_bits_with_any_number_of_threads(degree, colored, monkeypatch):
    splats = with_harmonics(random_splats(3000, dtype=torch.float32), degree, colored)
    found = []
    for threads in (1, 2, 3):
        monkeypatch.setattr(pool, "threads", threads)
        gradients = splats.map(torch.empty_like)
        loss = step_of(splats, gradients, 3)
        found.append((loss, gradients))
    for loss, gradients in found[1:]:
        assert loss == found[0][0]
        for name, value in gradients.parameters().items():
            assert torch.equal(value, getattr(found[0][1], name)), name
