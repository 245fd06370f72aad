"""Budgeted densification: what is split, into what, and how many there may be."""

import math

import pytest
import torch
from scenes import joined, one_splat

from recon_cli.train.fit.densification import BudgetRule, decay_opacities, densify_budget, draw_rows

RULE = BudgetRule(target=4, min_opacity=0.005, decay=1.0)


def splat(opacity=0.5, log_scales=(-3.0, -1.0, -2.0)):
    one = one_splat((1.0, 2.0, 3.0), scale=0.1, opacity=opacity, color=(0.2, 0.4, 0.6))
    one.log_scales = torch.tensor([log_scales], dtype=one.means.dtype)
    one.quats = torch.tensor([[1.0, 0, 0, 0]], dtype=one.means.dtype)
    return one.map(lambda tensor: tensor.float())


def seeded():
    return torch.Generator().manual_seed(0)


def test_a_split_gives_two_halves_along_the_longest_axis():
    result, source = densify_budget(
        joined(splat(), splat()), torch.tensor([1.0, 0.0]), RULE, seeded())
    assert source.tolist() == [1, -1, -1]
    offset = 0.5 * math.exp(-1.0)
    assert result.means[1:].tolist() == [
        pytest.approx([1.0, 2.0 - offset, 3.0]), pytest.approx([1.0, 2.0 + offset, 3.0])]
    shrunk = torch.tensor([0.85 * math.exp(-3), 0.5 * math.exp(-1), 0.85 * math.exp(-2)])
    assert torch.allclose(result.scales[1:], shrunk.expand(2, 3))
    assert result.opacities[1:].tolist() == pytest.approx([0.3, 0.3])


def test_the_long_axis_turns_with_the_gaussian():
    one = splat()
    one.quats = torch.tensor([[math.cos(math.pi / 4), 0, 0, math.sin(math.pi / 4)]])  # y to -x
    result, _ = densify_budget(joined(splat(), one), torch.tensor([0.0, 1.0]), RULE, seeded())
    assert (result.means[2] - result.means[1]).abs().tolist() == pytest.approx(
        [math.exp(-1.0), 0, 0], abs=1e-6)


def test_transparent_gaussians_are_deleted_and_never_split():
    splats = joined(splat(0.004), splat(), splat(0.004))
    result, source = densify_budget(splats, torch.tensor([9.0, 0.0, 9.0]), RULE, seeded())
    assert source.tolist() == [1]
    assert len(result) == 1


def test_the_decay_comes_before_the_threshold():
    rule = BudgetRule(target=1, min_opacity=0.005, decay=0.5)
    assert decay_opacities(splat(0.5), 0.5).opacities.item() == pytest.approx(0.25)
    assert len(densify_budget(splat(0.008), torch.ones(1), rule, seeded())[0]) == 0


@pytest.mark.parametrize("target", [0, 1, 7, 8, 9, 100])
def test_the_count_never_exceeds_the_target_nor_grows_by_more_than_half(target):
    splats = joined(*[splat() for _ in range(8)])
    rule = BudgetRule(target=target, min_opacity=0.005, decay=1.0)
    result, _ = densify_budget(splats, torch.ones(8), rule, seeded())
    assert len(result) == max(8, min(target, 12))


def test_a_gaussian_that_was_never_seen_is_never_split():
    splats = joined(*[splat() for _ in range(4)])
    rule = BudgetRule(target=6, min_opacity=0.005, decay=1.0)
    _, source = densify_budget(splats, torch.tensor([0.0, 1.0, 0.0, 0.0]), rule, seeded())
    assert source.tolist() == [0, 2, 3, -1, -1]


def test_those_to_blame_for_least_make_room_for_splits_elsewhere():
    splats = joined(*[splat() for _ in range(10)])
    score = torch.tensor([5.0, 0.1, 5.0, 0.0, 0.2, 5.0, 5.0, 5.0, 5.0, 5.0])
    rule = BudgetRule(target=10, min_opacity=0.005, decay=1.0, replaced=0.25)
    result, source = densify_budget(splats, score, rule, seeded())
    kept = source[source >= 0].tolist()
    assert len(result) == 10
    assert not {1, 4} & set(kept)  # a quarter of the nine of which something is known
    assert 3 in kept  # no view showed it
    assert len(kept) == 6  # two of the others were split


def test_nothing_is_replaced_where_the_share_is_less_than_one():
    splats = joined(*[splat() for _ in range(8)])
    rule = BudgetRule(target=8, min_opacity=0.005, decay=1.0, replaced=0.1)
    _, source = densify_budget(splats, torch.ones(8), rule, seeded())
    assert source.tolist() == list(range(8))


@pytest.mark.integration
def test_equal_scores_are_drawn_alike_and_the_draw_follows_the_weights():
    generator = seeded()
    counts = torch.zeros(4)
    for _ in range(4000):
        counts[draw_rows(torch.tensor([1.0, 1.0, 2.0, 0.0]), 1, generator)] += 1
    # three standard deviations of a share of .25 among 4,000 are .02
    assert (counts / 4000).tolist() == pytest.approx([0.25, 0.25, 0.5, 0.0], abs=0.025)


def test_a_draw_of_all_takes_each_once():
    assert draw_rows(torch.rand(50) + 0.1, 50, seeded()).tolist() == list(range(50))


def test_scores_of_any_size_can_be_drawn():
    weight = torch.tensor([1e-38, 1e-38, 0.0])
    assert draw_rows(weight, 5, seeded()).tolist() == [0, 1]
    assert draw_rows(torch.zeros(3), 2, seeded()).tolist() == []
