"""Significance scores in closed form."""

import numpy as np
import pytest
import torch
from scenes import camera_at, joined, one_splat, random_splats
from tiny_task import importance_of

from recon_cli.config.stages import PRUNE_SCORES, RunConfig
from recon_cli.render import render
from recon_cli.render.contract import StepOptions
from recon_cli.scene.train_view import TrainView
from recon_cli.train.fit.gradient import gradient_step
from recon_cli.train.fit.importance import RANDOM, Importance, paper_score
from recon_cli.train.fit.optimizer import SplatOptimizer

CPU = torch.device("cpu")


def blank(camera, mask=None):
    return TrainView(camera, np.zeros((camera.height, camera.width, 3), np.uint8), mask)


def scored(name, splats, cameras, *, beta=0.1, backend="torch"):
    found = importance_of(
        splats, [blank(camera) for camera in cameras], sh_degree=0, backend=backend)
    return found.score(name, splats, beta=beta, generator=torch.Generator())


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


@pytest.mark.parametrize("name", PRUNE_SCORES)
def test_a_gaussian_behind_an_opaque_wall_scores_zero(name):
    wall = joined(*[
        one_splat((0.0, 0.0, 2.0 + 0.01 * i), scale=9.0, opacity=0.98, color=(0.5, 0.5, 0.5))
        for i in range(4)])
    hidden = one_splat((0.0, 0.0, 5.0), scale=0.1, opacity=0.9, color=(1.0, 0.0, 0.0))
    score = scored(name, joined(wall, hidden), [camera_at(20, 20)])
    assert score[4] == 0
    assert score[0] > 0


def test_one_gaussian_alone_has_the_score_that_its_picture_gives():
    splats = one_splat((0.0, 0.0, 2.0), scale=0.3, opacity=0.6, color=(0.9, 0.5, 0.1))
    camera = camera_at(24, 20)
    alpha = render(splats, camera, torch.zeros(3, dtype=torch.float64), 0).alpha
    found = importance_of(splats, [blank(camera)] * 2, sh_degree=0, backend="torch")
    assert found.views == 2
    assert found.hits.item() == 2 * (alpha > 0).sum()
    assert found.blend_max.item() == pytest.approx(alpha.max().item())
    squares = 0.9**2 + 0.5**2 + 0.1**2  # of the colour over black
    assert found.loo.item() == pytest.approx(2 * squares * alpha.square().sum().item())


@pytest.mark.parametrize("name", PRUNE_SCORES)
def test_a_view_whose_mask_ignores_all_adds_nothing(name):
    splats, camera = random_splats(30), camera_at(30, 20)
    views = [blank(camera), blank(camera, np.zeros((20, 30), bool))]
    both, one = (
        importance_of(splats, some, sh_degree=0, backend="torch").score(
            name, splats, beta=0.1, generator=torch.Generator()) for some in (views, views[:1]))
    assert torch.equal(both, one)
    assert one.max() > 0


def test_scores_add_up_over_views():
    splats = random_splats(30)
    cameras = [camera_at(30, 20), camera_at(41, 33, focal=30.0)]
    for name in ("loo", "paper"):
        both = scored(name, splats, cameras)
        parts = [scored(name, splats, [camera]) for camera in cameras]
        assert torch.allclose(both, parts[0] + parts[1]), name
    parts = [scored("blend_max", splats, [camera]) for camera in cameras]
    assert torch.equal(scored("blend_max", splats, cameras), torch.maximum(*parts))


@pytest.mark.parametrize("backend", ["torch", "numba"])
def test_a_training_step_leaves_the_scores_of_its_view(backend):
    if backend == "numba":
        pytest.importorskip("numba")
    splats = random_splats(60, dtype=torch.float32)
    mask = np.random.default_rng(0).random((20, 30)) < 0.5
    view = blank(camera_at(30, 20), mask)
    optimizer = SplatOptimizer(splats, RunConfig(), 1.0, backend=backend)
    _, statistics = gradient_step(backend)(
        optimizer, view, StepOptions(0, 0.2, scores=True, loo=True))
    trained = Importance.zeros(60, CPU)
    trained.add(statistics)
    expected = importance_of(splats, [view], sh_degree=0, backend=backend)
    for name in ("hits", "blend_max", "loo"):
        assert torch.allclose(getattr(trained, name), getattr(expected, name)), name
    assert trained.loo.max() > 0


def test_the_random_score_is_seeded():
    splats = random_splats(8)
    draws = [Importance.zeros(8, CPU).score(
        RANDOM, splats, beta=0.1, generator=torch.Generator().manual_seed(3))
        for _ in range(2)]
    assert torch.equal(*draws)
