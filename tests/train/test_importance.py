"""Significance scores in closed form, and pruning by rank."""

import math

import pytest
import torch
from scenes import camera_at, joined, one_splat, random_splats

from recon_cli.render import render
from recon_cli.train.importance import kept_rows, paper_score, significance


def test_the_papers_score_is_hits_times_opacity_times_normalised_volume():
    splats = joined(*[
        one_splat((0.0, 0.0, 2.0), scale=0.1 * (i + 1), opacity=0.5, color=(0.5, 0.5, 0.5))
        for i in range(10)])
    hits = torch.arange(10)
    score = paper_score(hits, splats, beta=0.1)
    reference = 0.9**3  # of ten ascending volumes the ninth is the 90th percentile
    for i in range(10):
        gamma = min((0.1 * (i + 1)) ** 3 / reference, 1) ** 0.1
        assert score[i].item() == pytest.approx(i * 0.5 * gamma, rel=1e-12)


def test_a_beta_of_zero_leaves_the_volume_out():
    splats = random_splats(20)
    hits = torch.full((20,), 7)
    assert torch.allclose(paper_score(hits, splats, beta=0.0), 7 * splats.opacities)


def test_volumes_beyond_the_range_of_float32_are_still_ranked():
    splats = random_splats(10).map(lambda tensor: tensor.float())
    splats.log_scales[:] = torch.linspace(-60, -40, 10)[:, None]
    score = paper_score(torch.ones(10, dtype=torch.int64), splats, beta=0.1)
    assert torch.isfinite(score).all()
    assert (score > 0).all()


def test_a_gaussian_behind_an_opaque_wall_scores_zero():
    wall = joined(*[
        one_splat((0.0, 0.0, 2.0 + 0.01 * i), scale=9.0, opacity=0.98, color=(0.5, 0.5, 0.5))
        for i in range(4)])
    hidden = one_splat((0.0, 0.0, 5.0), scale=0.1, opacity=0.9, color=(1.0, 0.0, 0.0))
    for name in ("paper", "blend_max", "loo"):
        score = significance(
            name, joined(wall, hidden), [camera_at(20, 20)], beta=0.1, sh_degree=0,
            backend="torch", generator=torch.Generator())
        assert score[4] == 0
        assert score[0] > 0


def test_scores_add_up_over_views():
    splats = random_splats(30)
    cameras = [camera_at(30, 20), camera_at(41, 33, focal=30.0)]
    args = {"beta": 0.0, "sh_degree": 0, "backend": "torch", "generator": torch.Generator()}
    both = significance("paper", splats, cameras, **args)
    parts = [significance("paper", splats, [camera], **args) for camera in cameras]
    assert torch.allclose(both, parts[0] + parts[1])
    hits = sum(render(splats, camera, torch.zeros(3, dtype=torch.float64), 0,
                      scores=True).statistics.hits for camera in cameras)
    assert torch.allclose(both, hits * splats.opacities)


def test_exactly_the_asked_share_goes_even_when_all_scores_are_equal():
    assert kept_rows(torch.ones(10), 0.3).tolist() == [0, 1, 2, 3, 4, 5, 6]
    assert len(kept_rows(torch.rand(101), 0.66)) == 101 - math.floor(0.66 * 101)


def test_the_lowest_scores_go_and_the_order_of_the_rest_stays():
    assert kept_rows(torch.tensor([5.0, 1.0, 4.0, 2.0, 3.0]), 0.4).tolist() == [0, 2, 4]


def test_pruning_everything_leaves_the_most_significant_one():
    assert kept_rows(torch.tensor([1.0, 3.0, 2.0]), 1.0).tolist() == [1]


def test_the_random_score_is_seeded():
    args = {"beta": 0.0, "sh_degree": 0, "backend": "torch"}
    splats = random_splats(8)
    draws = [significance("random", splats, [], generator=torch.Generator().manual_seed(3), **args)
             for _ in range(2)]
    assert torch.equal(*draws)
