"""Products, blocks and solvers of bench_second_order, against float64 and closed forms."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from scenes import camera_at, random_splats

from recon_cli.render import render
from recon_cli.scene.splats import Splats
from recon_cli.scene.train_view import TrainView

sys.path.insert(0, str(Path(__file__).parents[1] / "bench"))
import gauss_newton as gn

pytestmark = pytest.mark.compile  # half a minute, once

N = 40
CAMERA = camera_at(70, 45)
GREY = np.full(3, 0.3, np.float32)
# float32 against float64, of the norms: sums over a thousand pixels and forty Gaussians
ROUNDING = 2e-4


@pytest.fixture(scope="module")
def splats():
    return random_splats(N, seed=3, dtype=torch.float32).with_degree(0)


@pytest.fixture(scope="module")
def linear(splats):
    view = gn.LinearizedView()
    view.render(gn.to_vector(splats), photo(splats), GREY)
    view.weights = random_vector(3 * 70 * 45, 5) ** 2
    return view


def photo(splats):
    with torch.no_grad():
        rgb = render(splats, CAMERA, torch.from_numpy(GREY), 0, backend="numba").rgb
    return TrainView(CAMERA, (rgb.clamp(0, 1) * 255).to(torch.uint8).numpy())


def random_vector(size, seed):
    return np.random.default_rng(seed).normal(size=size).astype(np.float32)


def a_change(seed=0):
    change = random_vector(gn.NUMBERS * N, seed)
    gn.parts(change)[0][:] *= 0.1
    return change


def exact_render(values):
    n = [*np.split(values, np.cumsum(np.array(gn.SIZES) * N)[:-1])]
    means, quats, scales, logits, colors = (torch.from_numpy(part) for part in n)
    splats = Splats(means.view(N, 3), quats.view(N, 4), scales.view(N, 3), logits,
                    colors.view(N, 3), torch.zeros(N, 0, 3, dtype=torch.float64))
    with torch.no_grad():
        return render(splats, CAMERA, torch.from_numpy(GREY).double(), 0,
                      backend="torch").rgb.numpy().reshape(-1)


def test_the_forward_sweep_is_the_derivative_of_the_float64_render(splats, linear):
    values, change = gn.to_vector(splats).astype(np.float64), a_change().astype(np.float64)
    step = 1e-6
    slope = (exact_render(values + step * change) - exact_render(values - step * change)) / (
        2 * step)
    pushed = linear.push(change.astype(np.float32))
    assert np.abs(slope).max() > 0.1
    assert np.linalg.norm(pushed - slope) < ROUNDING * np.linalg.norm(slope)


@pytest.mark.parametrize("share", [1.0, 0.4])
def test_both_sweeps_are_transposes_of_each_other(linear, share):
    change, slopes = a_change(1), random_vector(3 * 70 * 45, 2)
    linear.sample(share, np.random.default_rng(0))
    pushed, pulled = linear.push(change).copy(), np.empty_like(change)
    linear.pull(slopes, pulled)
    linear.sample(1, np.random.default_rng(0))
    scale = np.linalg.norm(slopes) * np.linalg.norm(pushed)
    assert abs(gn.dot(slopes, pushed)) > 1e-3 * scale
    assert abs(gn.dot(slopes, pushed) - gn.dot(pulled, change)) < ROUNDING * scale


def test_a_sample_sees_its_share_of_the_pixels(linear):
    whole = linear.push(a_change(1)).copy()
    linear.sample(0.4, np.random.default_rng(0))
    some = linear.push(a_change(1)).copy()
    linear.sample(1, np.random.default_rng(0))
    seen = some != 0
    assert np.array_equal(some[seen], whole[seen])
    assert 0.2 < seen.sum() / (whole != 0).sum() < 0.6


def test_blocks_are_the_curvature_of_single_gaussians(linear):
    blocks, change = gn.Blocks(N), a_change(4)
    linear.add_blocks(1.0, blocks.geometry, blocks.colors)
    product = blocks.multiply(change)
    seen = 0
    for group in (gn.geometry, lambda vector: [gn.parts(vector)[4][0::3]]):
        for i in range(N):
            alone = np.zeros_like(change)
            expected = 0.0
            for to, source, image in zip(
                    group(alone), group(change), group(product), strict=True):
                size = len(to) // N
                to[size * i:size * (i + 1)] = source[size * i:size * (i + 1)]
                expected += gn.dot(source[size * i:size * (i + 1)], image[size * i:size * (i + 1)])
            pushed = linear.push(alone)
            curvature = gn.dot(pushed * linear.weights, pushed)
            assert expected == pytest.approx(curvature, rel=1e-3, abs=1e-5)
            seen += curvature > 1e-3
    assert seen > N


def test_blocks_with_a_ridge_are_inverted(linear):
    blocks, change = gn.Blocks(N), a_change(4)
    linear.add_blocks(1.0, blocks.geometry, blocks.colors)
    ridge = np.full_like(change, 0.5)
    inverse = gn.invert(blocks, 2.0, ridge)
    again = inverse.multiply(2 * blocks.multiply(change) + ridge * change)
    assert np.abs(again - change).max() < 1e-2 * np.abs(change).max()


def test_conjugate_gradients_are_exact_after_as_many_products_as_unknowns():
    random = np.random.default_rng(0)
    root = random.normal(size=(6, 6))
    matrix, right = root @ root.T + np.eye(6), random.normal(size=6)
    diagonal = np.diag(matrix)
    for start in (None, random.normal(size=6)):
        solution = gn.conjugate_gradients(
            lambda x: matrix @ x, right, lambda x: x / diagonal, 7, start)
        assert np.abs(matrix @ solution - right).max() < 1e-5


def test_one_step_finds_the_colours_in_which_the_render_is_linear(splats):
    truth = gn.to_vector(splats)
    wrong = truth.copy()
    bright = gn.parts(truth)[4]
    bright[:] = np.abs(bright)  # none is clamped at black
    gn.parts(wrong)[4][:] = bright + 0.3 * np.abs(random_vector(3 * N, 9))
    view = gn.LinearizedView()
    target = view.render(truth, photo(splats), GREY).copy()
    error = target - view.render(wrong, photo(splats), GREY)
    view.weights = np.ones_like(error)
    only = np.zeros_like(truth)
    gn.parts(only)[4][:] = 1

    def curvature(change):
        return gn.multiply_views([view], only * change, 1.0) * only + 1e-6 * change

    right = np.empty_like(truth)
    view.pull(error, right)
    step = gn.conjugate_gradients(curvature, right * only, lambda x: x, 200)
    left = target - view.render(wrong + step, photo(splats), GREY)
    assert np.abs(error).max() > 0.05
    assert np.abs(left).max() < 0.01 * np.abs(error).max()
