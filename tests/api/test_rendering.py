"""Renders as arrays: one Gaussian in closed form, and what it contributes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from facts import raises
from one_gaussian_scene import (
    DISTANCE,
    FOCAL,
    OPACITY,
    RED,
    SCALE,
    SIDE,
    facing_camera,
    one_gaussian,
)

from recon_cli.api import (
    BackendError,
    ConfigError,
    InputError,
    Splats,
    measure_contributions,
    render,
    render_depth,
)

BACKENDS = ["torch", "numba"]
MIDDLE = SIDE // 2
DILATION = 0.3  # pixels^2


def expected_alpha() -> np.ndarray:
    """The Gaussian's alpha in each pixel, 0 where it is below one step of 8 bits."""
    variance = (FOCAL * SCALE / DISTANCE) ** 2 + DILATION
    off = np.arange(SIDE) - MIDDLE
    alpha = OPACITY * np.exp(-(off[:, None] ** 2 + off**2) / (2 * variance))
    return np.where(alpha < 1 / 255, 0, alpha)


@pytest.mark.parametrize("backend", BACKENDS)
def test_one_gaussian_looks_as_its_formula_says(backend: str) -> None:
    output = render(one_gaussian(), facing_camera(), backend=backend, device="cpu")
    alpha = expected_alpha()
    np.testing.assert_allclose(output.alpha, alpha, atol=2e-4)
    np.testing.assert_allclose(output.rgb, alpha[..., None] * np.array(RED[0]), atol=2e-4)
    covered = output.alpha > 0.01
    np.testing.assert_allclose(output.depth[covered], DISTANCE, rtol=1e-4)
    assert output.depth[0, 0] == 0
    assert (output.rgb.dtype, output.depth.dtype) == (np.float32, np.float32)
    assert output.image[MIDDLE, MIDDLE].tolist() == [
        round(255 * OPACITY * channel) for channel in RED[0]]


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_surface_stays_where_it_is_though_something_shines_through(backend: str) -> None:
    wall = one_gaussian(scales=[[2.0, 2, 0.01]], opacities=[0.9])
    both = Splats.from_arrays(
        [[0.0, 0, 0], [0, 0, 90]], [[1.0, 0, 0, 0]] * 2, [[2.0, 2, 0.01], [50, 50, 1]],
        [0.9, 0.9], RED * 2)
    for splats in (wall, both):
        depth = render_depth(splats, facing_camera(), backend=backend, device="cpu")
        assert depth[MIDDLE, MIDDLE] == pytest.approx(DISTANCE, rel=1e-3)
    expected = render(both, facing_camera(), backend=backend, device="cpu").depth
    # 0.9 of it at 4 units, 0.09 at 94
    assert expected[MIDDLE, MIDDLE] == pytest.approx((0.9 * 4 + 0.09 * 94) / 0.99, rel=1e-3)


def test_the_background_shows_through() -> None:
    output = render(one_gaussian(), facing_camera(), background=(0, 0, 1), device="cpu")
    np.testing.assert_allclose(output.rgb[..., 2], 1 - output.alpha, atol=1e-5)


@pytest.mark.integration
@pytest.mark.parametrize("backend", BACKENDS)
def test_what_a_gaussian_contributes_is_the_sum_over_its_pixels(backend: str) -> None:
    found = measure_contributions(
        one_gaussian(), [facing_camera()] * 2, backend=backend, device="cpu")
    alpha = expected_alpha()
    assert found.views == 2
    assert found.hits.tolist() == [2 * np.count_nonzero(alpha)]
    assert found.blend_max.tolist() == [pytest.approx(OPACITY, rel=1e-4)]
    removed = 2 * (alpha**2).sum() * np.square(RED[0]).sum()  # against black
    assert found.loo.tolist() == [pytest.approx(removed, rel=1e-3)]


def test_masked_pixels_count_for_nothing() -> None:
    mask = np.zeros((SIDE, SIDE), bool)
    mask[:, MIDDLE:] = True
    found = measure_contributions(one_gaussian(), [facing_camera()], masks=[mask], device="cpu")
    assert found.hits.tolist() == [np.count_nonzero(expected_alpha()[:, MIDDLE:])]


def test_torch_has_the_threads_that_it_had() -> None:
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        render(one_gaussian(), facing_camera(), backend="numba", device="cpu", threads=1)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_nothing_is_printed(capfd: pytest.CaptureFixture[str]) -> None:
    render(one_gaussian(), facing_camera())
    assert capfd.readouterr() == ("", "")


def test_arguments_that_cannot_be_used_are_named() -> None:
    splats, camera = one_gaussian(), facing_camera()
    with raises(InputError, "sh_degree", 4):
        render(splats, camera, sh_degree=4)
    with raises(InputError, "background"):
        render(splats, camera, background=(1, 1))
    with raises(ConfigError, "cuda"):
        render(splats, camera, backend="cuda")
    with pytest.raises(BackendError):
        render(splats, camera, backend="numba", device="cuda")
    with raises(InputError, 2, 1, "cameras"):
        measure_contributions(splats, [camera], masks=[None, None])
    with raises(InputError, "mask"):
        measure_contributions(splats, [camera], masks=[np.ones((2, 2), bool)])


def test_no_gaussian_is_the_background() -> None:
    nothing = one_gaussian().select(torch.zeros(1, dtype=torch.bool))
    output = render(nothing, facing_camera(), background=(0.5, 0.5, 0.5), device="cpu")
    assert (output.rgb == 0.5).all()
    assert not output.alpha.any()
    assert not output.depth.any()
