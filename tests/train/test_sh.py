"""Which Gaussians lose their higher harmonics, and what they look like then."""

import math

import numpy as np
import pytest
import torch
from oracle import color_towards
from scenes import camera_at, joined, one_splat, random_splats, with_harmonics

from recon_cli.config.stages import TrainConfig
from recon_cli.render import render
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import SH_C0, with_rows
from recon_cli.train.optimizer import SplatOptimizer
from recon_cli.train.sh import ColorSpread, color_spread, needed, reduced, visibility

C1 = math.sqrt(3 / (4 * math.pi))
EXACT = 1e-12
GREY = (0.5, 0.5, 0.5)


def camera_from(x, y, z, size=20):
    """A camera at a place, with the axes of the world."""
    viewmat = np.eye(4)
    viewmat[:3, 3] = [-x, -y, -z]
    return Camera(size, size, 20.0, 20.0, size / 2, size / 2, viewmat)


def striped(strength):
    """A Gaussian at (0, 0, 4) whose red is 0.5 + strength * C1 * z of the direction to it."""
    splats = one_splat((0.0, 0.0, 4.0), scale=0.2, opacity=0.7, color=GREY)
    splats.sh_rest[0, 1, 0] = strength
    return splats


def test_mean_and_deviation_of_two_views_are_those_by_hand():
    # seen along (0, 0, 1) and along (-3, 0, 4) / 5, the second with three times the weight
    spread = color_spread(
        striped(0.5), [camera_from(0, 0, 0), camera_from(3, 0, 0)], torch.tensor([[1.0], [3.0]]))
    first, second = 0.5 + 0.5 * C1, 0.5 + 0.5 * C1 * 0.8
    mean = (first + 3 * second) / 4
    deviation = math.sqrt(((first - mean) ** 2 + 3 * (second - mean) ** 2) / 4)
    assert spread.mean[0].tolist() == pytest.approx([mean, 0.5, 0.5], abs=EXACT)
    assert spread.deviation[0].item() == pytest.approx(deviation / 3, abs=EXACT)


def test_the_spread_is_that_of_numpy_over_many_views():
    splats = with_harmonics(random_splats(50, seed=1), 2, 30)
    cameras = [camera_from(*place) for place in np.random.default_rng(0).normal(size=(12, 3))]
    weights = torch.rand(12, 50, generator=torch.Generator().manual_seed(0)).double()
    weights[weights < 0.3] = 0
    weights[:, 7] = 0
    spread = color_spread(splats, cameras, iter(weights))
    seen = np.array([[color_towards(splats, i, camera, 3).tolist() for i in range(50)]
                     for camera in cameras])
    for i in set(range(50)) - {7}:
        mean = np.average(seen[:, i], axis=0, weights=weights[:, i])
        variance = np.average((seen[:, i] - mean) ** 2, axis=0, weights=weights[:, i])
        assert spread.mean[i].tolist() == pytest.approx(mean.tolist(), abs=EXACT)
        assert spread.deviation[i].item() == pytest.approx(np.sqrt(variance).mean(), abs=1e-9)
    assert (spread.deviation[30:] < 1e-9).all()  # of degree 0: one colour from everywhere
    assert (spread.deviation[:7] > 1e-3).all()


def test_a_gaussian_that_no_view_sees_keeps_its_base_colour_and_needs_nothing():
    spread = color_spread(striped(5.0), [camera_from(0, 0, 0)], torch.zeros(1, 1))
    assert spread.mean[0].tolist() == pytest.approx(GREY, abs=EXACT)
    assert spread.deviation[0] == 0
    assert not needed(spread).any()


def test_colours_count_as_they_are_seen_not_below_black():
    spread = color_spread(
        striped(-9.0), [camera_from(0, 0, 0), camera_from(3, 0, 0)], torch.ones(2, 1))
    assert spread.mean[0, 0] == 0
    assert spread.deviation[0] == 0


def test_weights_of_another_number_of_views_are_refused():
    with pytest.raises(ValueError, match="shorter"):
        color_spread(striped(1.0), [camera_from(0, 0, 0)] * 2, torch.ones(1, 1))


def test_visible_is_what_may_touch_the_image():
    splats = joined(*[
        one_splat(place, scale=0.05, opacity=0.7, color=GREY)
        for place in ((0.0, 0.0, 4.0), (0.0, 0.0, -4.0), (40.0, 0.0, 4.0))])
    weights = list(visibility(splats, [camera_from(0, 0, 0), camera_from(0, 0, -10)]))
    assert [weight.tolist() for weight in weights] == [[1, 0, 0], [1, 1, 0]]


def test_a_colour_under_the_threshold_is_one_colour():
    mean = torch.zeros(3, 3)
    spread = ColorSpread(mean, torch.tensor([0.0399, 0.04, 0.2]))
    assert needed(spread).tolist() == [False, True, True]
    assert needed(spread, threshold=0.1).tolist() == [False, False, True]


@pytest.mark.parametrize("degree", [1, 3])
@pytest.mark.parametrize("colored", [0, 20, 30])
def test_those_that_keep_their_harmonics_come_first_and_lose_nothing(degree, colored):
    splats = with_harmonics(random_splats(30), degree, colored)
    keep = torch.rand(30, generator=torch.Generator().manual_seed(0)) < 0.5
    fewer, order = reduced(splats, keep)
    assert sorted(order.tolist()) == list(range(30))
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh_dc"):
        assert torch.equal(getattr(fewer, name), getattr(splats, name)[order]), name
    count = int(keep[:colored].sum())
    assert fewer.sh_rest.shape == (count, splats.sh_rest.shape[1], 3)
    assert torch.equal(fewer.sh_rest, splats.sh_rest[order[:count]])
    assert keep[order[:count]].all()


def test_the_picture_is_that_of_the_same_gaussians_with_zeros():
    splats = random_splats(60, seed=2)
    keep = torch.arange(60) % 3 == 0
    colors = torch.rand(60, 3, generator=torch.Generator().manual_seed(0)).double()
    fewer, _ = reduced(splats, keep, colors=colors)
    plain = splats.map(torch.clone)
    plain.sh_rest[~keep] = 0
    plain.sh_dc[~keep] = (colors[~keep] - 0.5) / SH_C0
    camera, black = camera_at(), torch.zeros(3, dtype=torch.float64)
    ours, theirs = (render(one, camera, black, 3).rgb for one in (fewer, plain))
    assert torch.allclose(ours, theirs, rtol=0, atol=EXACT)


def test_what_looks_the_same_from_everywhere_loses_its_harmonics_and_hardly_changes():
    flat, lively = striped(0.01), striped(9.0)
    lively.means[0] = torch.tensor([1.0, 0.0, 5.0])  # no tie in depth: it would go by row
    splats = joined(flat, lively)
    cameras = [camera_from(x, 0, 0, size=60) for x in (-2.0, 0.0, 2.0)]
    spread = color_spread(splats, cameras, visibility(splats, cameras))
    fewer, order = reduced(splats, needed(spread), colors=spread.mean)
    assert order.tolist() == [1, 0]
    assert len(fewer.sh_rest) == 1
    black = torch.zeros(3, dtype=torch.float64)
    for camera in cameras:
        before, after = (render(one, camera, black, 3).rgb for one in (splats, fewer))
        assert (before - after).abs().max() < 0.01 * C1  # what the coefficient could do at most


def test_training_goes_on_with_the_moments_of_what_was_kept():
    splats = random_splats(20, dtype=torch.float32)
    optimizer = SplatOptimizer(splats, TrainConfig(max_gaussians=20), 1.0)
    sum(p.square().sum() for p in optimizer.splats.parameters().values()).backward()
    optimizer.step(1e-4)
    before = {name: value.clone() for name, value in optimizer.tensors().items()}
    keep = torch.arange(20) % 2 == 1
    fewer, order = reduced(optimizer.splats, keep)
    optimizer.replace(fewer, order)
    after = optimizer.tensors()
    assert torch.equal(after["adam.means.exp_avg"], before["adam.means.exp_avg"][order])
    assert torch.equal(after["adam.sh_rest.exp_avg"], before["adam.sh_rest.exp_avg"][keep])
    assert torch.equal(with_rows(optimizer.splats.sh_rest, 20)[:10], before["splats.sh_rest"][keep])
