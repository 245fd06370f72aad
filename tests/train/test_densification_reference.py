"""Cloning, splitting and deleting, each on Gaussians chosen to show it."""

import dataclasses
import math
from types import SimpleNamespace

import pytest
import torch
from scenes import joined, one_splat

from recon_cli.config.stages import RunConfig
from recon_cli.render import Statistics
from recon_cli.train.fit.densification import (
    STRATEGIES,
    DensifyRule,
    cap_opacities,
    densify_reference,
)
from recon_cli.train.fit.schedule import Schedule
from recon_cli.train.fit.state import DensificationStats, new_state

RULE = DensifyRule(gradient=1.0, clone_scale=0.1, min_opacity=0.005, large_scale=1.0, most=100)


def splat(scale=0.05, opacity=0.5):
    one = one_splat((1.0, 2.0, 3.0), scale=scale, opacity=opacity, color=(0.2, 0.4, 0.6))
    return one.map(lambda tensor: tensor.float())


def pulled(*means):
    gathered = DensificationStats.zeros(len(means), torch.device("cpu"))
    gathered.pull[:] = torch.tensor(means)
    gathered.count[:] = 1
    return gathered


def test_a_small_gaussian_that_is_pulled_hard_is_cloned():
    result, source = densify_reference(splat(), pulled(2.0), RULE, torch.Generator())
    assert source.tolist() == [0, -1]
    assert torch.equal(result.means[0], result.means[1])


def test_a_large_one_is_replaced_by_two_smaller_ones_near_it():
    result, source = densify_reference(
        splat(0.5), pulled(2.0), RULE, torch.Generator().manual_seed(0))
    assert source.tolist() == [-1, -1]
    assert torch.allclose(result.scales, torch.full((2, 3), 0.5 / 1.6))
    assert (result.means - torch.tensor([1.0, 2.0, 3.0])).norm(dim=1).max() < 5 * 0.5
    assert not torch.equal(result.means[0], result.means[1])


def test_one_below_the_threshold_stays_as_it_is():
    result, source = densify_reference(splat(), pulled(0.9), RULE, torch.Generator())
    assert source.tolist() == [0]
    assert torch.equal(result.means, splat().means)


def test_transparent_and_oversized_ones_are_deleted():
    splats = joined(splat(), splat(opacity=0.004), splat(scale=1.5))
    _, source = densify_reference(splats, pulled(0.0, 0.0, 0.0), RULE, torch.Generator())
    assert source.tolist() == [0]


def test_one_that_covers_too_much_of_the_screen_is_deleted_only_when_asked():
    gathered = pulled(0.0)
    gathered.radius[:] = 21.0
    kept = DensifyRule(1.0, 0.1, 0.005, None, 100)
    assert len(densify_reference(splat(), gathered, RULE, torch.Generator())[0]) == 0
    assert len(densify_reference(splat(), gathered, kept, torch.Generator())[0]) == 1
    published = dataclasses.replace(RULE, max_radius=math.inf)  # INRIA's code never deletes it
    assert len(densify_reference(splat(), gathered, published, torch.Generator())[0]) == 1


@pytest.mark.parametrize(("option", "left"), [(20.0, 1), (0.0, 2)])
def test_the_option_says_how_wide_one_may_be_on_the_screen(option, left):
    config = RunConfig(densify="reference", iterations=30_000, max_radius=option)
    task = SimpleNamespace(
        schedule=Schedule(config), extent=100.0, device=torch.device("cpu"),
        inside=lambda means: torch.ones(len(means)))
    state = new_state(joined(splat(), splat()), config, 1.0)
    state.iteration = 3100  # opacities were reset once
    state.gathered.radius[0] = 21.0
    STRATEGIES["reference"].control(state, task)
    assert len(state.splats) == left


def test_the_count_never_exceeds_its_cap_and_the_hardest_pulled_come_first():
    splats = joined(*[splat() for _ in range(5)])
    rule = DensifyRule(1.0, 0.1, 0.005, None, most=7)
    result, source = densify_reference(
        splats, pulled(2.0, 9.0, 3.0, 8.0, 4.0), rule, torch.Generator())
    assert len(result) == 7
    assert source.tolist() == [0, 1, 2, 3, 4, -1, -1]


def test_the_pull_is_measured_in_normalised_device_coordinates_over_seen_steps():
    statistics = Statistics.zeros(torch.zeros(2, 3))
    statistics.means2d_grad[0] = torch.tensor([0.3, 0.4])
    statistics.radii[0] = 5.0
    gathered = DensificationStats.zeros(2, torch.device("cpu"))
    gathered.add(statistics, 20, 20, variance=False)
    gathered.add(statistics, 20, 20, variance=False)
    assert gathered.mean_grad2d.tolist() == pytest.approx([0.5 * 10, 0.0])
    assert gathered.radius.tolist() == [5.0, 0.0]


def test_the_variance_is_added_alone():
    statistics = Statistics.zeros(torch.zeros(2, 3))
    statistics.variance[0], statistics.radii[0] = 3.0, 5.0
    gathered = DensificationStats.zeros(2, torch.device("cpu"))
    gathered.add(statistics, 20, 20, variance=True)
    assert gathered.variance.tolist() == [3.0, 0.0]
    assert not gathered.count.any()
    assert not gathered.radius.any()


def test_a_reset_lowers_high_opacities_and_leaves_low_ones():
    lowered = cap_opacities(joined(splat(opacity=0.9), splat(opacity=0.006)))
    assert lowered.opacities.tolist() == pytest.approx([0.01, 0.006], rel=1e-5)
    assert math.isclose(splat().opacities.item(), 0.5)
