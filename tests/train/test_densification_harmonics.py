"""Every way of densifying on Gaussians of which only some have higher spherical harmonics."""

from dataclasses import replace

import pytest
import torch
from scenes import random_splats, with_harmonics
from tiny_task import STRATEGIES, first_state, tiny_task

from recon_cli.scene.splats import with_rows
from recon_cli.train.fit import densification
from recon_cli.train.fit.loop import fit
from recon_cli.train.fit.state import DensificationStats

N, COLORED = 40, 13


def generator():
    return torch.Generator().manual_seed(0)


def by_reference(splats):
    gathered = DensificationStats.zeros(N, torch.device("cpu"))
    gathered.pull[::3] = 2.0
    gathered.count[:] = 1
    rule = densification.DensifyRule(1.0, 100.0, 0.05, None, 60)  # all are small: cloned
    return densification.densify_reference(splats, gathered, rule, generator())


def by_budget(splats):
    score = torch.rand(N, generator=generator())
    rule = densification.BudgetRule(55, 0.05, 0.99)
    return densification.densify_budget(splats, score, rule, generator())


@pytest.mark.parametrize("densify", [by_reference, by_budget])
@pytest.mark.parametrize("degree", [1, 3])
def test_children_have_what_their_parents_have_and_those_with_coefficients_come_first(
    densify, degree
):
    few = with_harmonics(random_splats(N, dtype=torch.float32), degree, COLORED)
    whole = replace(few, sh_rest=with_rows(few.sh_rest, N))  # the same with rows of zeros
    result, source = densify(few)
    expected, plain = densify(whole)
    colored = (expected.sh_rest != 0).flatten(1).any(1)
    order = torch.cat([torch.nonzero(colored)[:, 0], torch.nonzero(~colored)[:, 0]])
    assert len(result) > N
    assert 0 < len(result.sh_rest) == int(colored.sum()) < len(result)
    assert torch.equal(source, plain[order])
    for name, value in expected.parameters().items():
        ours = with_rows(result.sh_rest, len(result)) if name == "sh_rest" else (
            getattr(result, name))
        assert torch.equal(ours, value[order]), name


def test_halves_of_a_split_have_what_their_parent_has():
    few = with_harmonics(random_splats(N, dtype=torch.float32), 2, COLORED)
    gathered = DensificationStats.zeros(N, torch.device("cpu"))
    gathered.pull[:] = 2.0
    gathered.count[:] = 1
    few.logit_opacities[:] = 1.0
    rule = densification.DensifyRule(1.0, 0.0, 0.005, None, 200)  # all are large: split
    result, source = densification.densify_reference(few, gathered, rule, generator())
    assert source.tolist() == [-1] * 2 * N
    assert torch.equal(result.sh_rest, few.sh_rest.repeat(2, 1, 1))
    assert torch.equal(result.sh_dc[: 2 * COLORED], few.sh_dc[:COLORED].repeat(2, 1))
    assert torch.equal(result.sh_dc[2 * COLORED :], few.sh_dc[COLORED:].repeat(2, 1))


def test_a_run_takes_harmonics_from_no_gaussian():
    config = STRATEGIES["budget"]
    state = first_state(config, backend="numba")
    fit(state, tiny_task(config, backend="numba"), 45)
    assert len(state.splats.sh_rest) == len(state.splats)


def test_a_budget_leaves_gaussians_in_spatial_order_with_their_moments(monkeypatch):
    monkeypatch.setattr(densification, "densify_budget", lambda splats, *_: (
        splats.map(torch.Tensor.detach), torch.arange(len(splats))))
    state, task = first_state(colored=COLORED), tiny_task()
    with torch.no_grad():
        state.splats.means.zero_()
        state.splats.means[:, 0] = torch.randperm(N, generator=generator()).float()
    before = state.splats.means[:, 0].detach().clone()
    for name, value in state.optimizer.tensors().items():
        if name.endswith("exp_avg"):
            value.copy_(before[:len(value)].reshape(-1, *[1] * (value.dim() - 1)).expand_as(value))
    state.iteration = task.schedule.config.densify_every
    densification.STRATEGIES["budget"].control(state, task)
    place, moments = state.splats.means[:, 0].detach(), state.optimizer.tensors()
    assert torch.equal(place[:COLORED], before[:COLORED].sort().values)
    assert torch.equal(place[COLORED:], before[COLORED:].sort().values)
    assert torch.equal(moments["adam.quats.exp_avg"][:, 0], place)
    assert torch.equal(moments["adam.sh_rest.exp_avg"][:, 0, 0], place[:COLORED])
