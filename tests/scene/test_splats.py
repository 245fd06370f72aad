"""Which Gaussians have higher spherical harmonics, through selecting, joining and other degrees."""

from dataclasses import replace

import pytest
import torch
from facts import raises
from scenes import random_splats, with_harmonics

from recon_cli.scene.splats import TERMS, joined, with_rows


def some(n=10, *, degree=3, colored=4, seed=0):
    return with_harmonics(random_splats(n, seed=seed), degree, colored)


def same(ours, theirs):
    for name, value in theirs.parameters().items():
        assert torch.equal(getattr(ours, name), value), name


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("colored", [0, 4, 10])
def test_the_degree_is_that_of_the_coefficients(degree, colored):
    splats = some(degree=degree, colored=colored)
    assert len(splats) == 10
    assert splats.sh_degree == degree
    assert splats.sh_rest.shape == (colored, TERMS[degree], 3)


@pytest.mark.parametrize("shape", [(11, 15, 3), (10, 4, 3), (10, 15, 2), (10, 45), (10, 16, 3)])
def test_coefficients_of_more_gaussians_than_there_are_or_of_no_degree_are_refused(shape):
    with raises(ValueError, "sh_rest", shape):
        replace(some(), sh_rest=torch.zeros(shape, dtype=torch.float64))


def test_coefficients_of_another_precision_are_refused():
    with raises(ValueError, "sh_rest"):
        replace(some(), sh_rest=torch.zeros(10, 15, 3))


@pytest.mark.parametrize(("rows", "count"), [
    ([0, 2, 3, 4, 9], 3), ([4, 5], 0), ([0, 1, 2, 3], 4), ([], 0), ([3, 1, 9, 4], 2),
    ([-10, -1], 1), ([2, 2, 7, 7], 2)])
def test_selected_rows_keep_their_order_and_their_coefficients(rows, count):
    splats, rows = some(), torch.tensor(rows, dtype=torch.int64)
    chosen = splats.select(rows)
    assert len(chosen) == len(rows)
    assert torch.equal(chosen.means, splats.means[rows])
    assert torch.equal(chosen.sh_rest, splats.sh_rest[rows[:count] % 10])


def test_a_mask_selects_like_the_rows_that_it_holds():
    splats = some()
    mask = torch.arange(10) % 3 == 0
    same(splats.select(mask), splats.select(torch.nonzero(mask)[:, 0]))


@pytest.mark.parametrize("rows", [[4, 0], [0, 9, 3], [-1, 0]])
def test_an_order_that_the_layout_cannot_hold_is_refused(rows):
    with raises(ValueError, "coefficients"):
        some().select(torch.tensor(rows))


def test_any_order_is_taken_where_all_have_coefficients_or_none():
    order = torch.randperm(10, generator=torch.Generator().manual_seed(0))
    for colored in (0, 10):
        splats = some(colored=colored)
        chosen = splats.select(order)
        assert torch.equal(chosen.means, splats.means[order])
        assert torch.equal(chosen.sh_rest, splats.sh_rest[order[:colored]])


def test_joined_gaussians_with_coefficients_come_first_and_keep_what_is_theirs():
    parts = [some(3, colored=1, seed=1), some(2, colored=0, seed=2), some(4, colored=3, seed=3)]
    whole, order = joined(parts)
    assert order.tolist() == [0, 5, 6, 7, 1, 2, 3, 4, 8]
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh_dc"):
        plain = torch.cat([getattr(part, name) for part in parts])
        assert torch.equal(getattr(whole, name), plain[order]), name
    padded = torch.cat([with_rows(part.sh_rest, len(part)) for part in parts])
    assert torch.equal(with_rows(whole.sh_rest, 9), padded[order])
    assert len(whole.sh_rest) == 4


@pytest.mark.parametrize("colored", [0, 3])
def test_joining_keeps_the_order_where_all_have_coefficients_or_none(colored):
    whole, order = joined([some(3, colored=colored, seed=seed) for seed in range(3)])
    assert order.tolist() == list(range(9))
    assert len(whole.sh_rest) == 3 * colored


def test_parts_of_different_degrees_are_not_joined():
    with raises(ValueError, "degrees"):
        joined([some(degree=2), some(degree=3)])


@pytest.mark.parametrize("before", range(4))
@pytest.mark.parametrize("after", range(4))
def test_another_degree_cuts_or_fills_with_zeros_for_the_same_gaussians(before, after):
    splats = some(degree=before)
    changed = splats.with_degree(after)
    assert changed.sh_degree == after
    assert len(changed.sh_rest) == 4
    kept = TERMS[min(before, after)]
    assert torch.equal(changed.sh_rest[:, :kept], splats.sh_rest[:, :kept])
    assert (changed.sh_rest[:, kept:] == 0).all()
    same(replace(changed, sh_rest=splats.sh_rest), splats)
