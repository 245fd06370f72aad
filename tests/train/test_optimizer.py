"""Adam whose rows follow the Gaussians."""

import torch
from scenes import joined, random_splats

from recon_cli.config import TrainConfig
from recon_cli.train.optimizer import SplatOptimizer


def stepped(splats, times=3):
    optimizer = SplatOptimizer(splats.map(lambda t: t.float()), TrainConfig(), extent=2.0)
    for _ in range(times):
        loss = sum(p.square().sum() for p in optimizer.splats.parameters().values())
        loss.backward()
        optimizer.step(1e-4)
    return optimizer


def test_the_first_step_moves_each_parameter_by_its_learning_rate():
    splats = random_splats(4).map(lambda tensor: tensor.float())
    before = splats.map(lambda tensor: tensor.clone())
    optimizer = stepped(splats, times=1)
    moved = {name: (getattr(before, name) - value).abs().median().item()
             for name, value in optimizer.splats.parameters().items()}
    rates = {"means": 2e-4, "quats": 1e-3, "log_scales": 5e-3, "logit_opacities": 5e-2,
             "sh_dc": 2.5e-3, "sh_rest": 1.25e-4}
    for name, rate in rates.items():
        assert abs(moved[name] - rate) < 0.02 * rate, name


def test_kept_rows_go_on_as_if_nothing_had_happened():
    a, b = random_splats(3, seed=0), random_splats(2, seed=1)
    alone = stepped(a)
    both = stepped(joined(a, b))
    both.replace(both.splats.select(torch.arange(3)), torch.arange(3))
    for optimizer in (alone, both):
        loss = sum(p.square().sum() for p in optimizer.splats.parameters().values())
        loss.backward()
        optimizer.step(1e-4)
    for name, value in alone.splats.parameters().items():
        assert torch.equal(value, getattr(both.splats, name)), name


def test_new_rows_start_without_moments():
    optimizer = stepped(random_splats(3))
    fresh = random_splats(1).map(torch.Tensor.float)
    grown = joined(optimizer.splats.select(torch.arange(3)), fresh)
    optimizer.replace(grown, torch.tensor([2, 0, 1, -1]))
    moments = optimizer.tensors()
    assert moments["adam.means.exp_avg"][3].abs().max() == 0
    assert moments["adam.means.exp_avg"][0].abs().max() > 0


def test_forgetting_touches_one_parameter_only():
    optimizer = stepped(random_splats(3))
    optimizer.forget("logit_opacities")
    tensors = optimizer.tensors()
    assert tensors["adam.logit_opacities.exp_avg_sq"].abs().max() == 0
    assert tensors["adam.means.exp_avg_sq"].abs().max() > 0
