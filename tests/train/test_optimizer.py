"""Adam whose rows follow the Gaussians."""

import pytest
import torch
from adam_runs import (
    BACKENDS,
    CONFIG,
    KERNELS,
    ROLES,
    assert_close,
    every_kind,
    held,
    optimizer_of,
    walk,
)
from scenes import joined, random_splats

from recon_cli.config.stages import RunConfig
from recon_cli.kernels.thread_pool import pool
from recon_cli.scene.splats import Splats
from recon_cli.train.fit.optimizer import SplatOptimizer

BYTES = 1500  # a Gaussian may take in training: what is promised for a million on a laptop


def stepped(splats, times=3, densify="reference"):
    optimizer = SplatOptimizer(
        splats.map(lambda t: t.float()), RunConfig(densify=densify), means_unit=2.0)
    for _ in range(times):
        loss = sum(p.square().sum() for p in optimizer.splats.parameters().values())
        loss.backward()
        optimizer.step(1e-4)
    return optimizer


@pytest.mark.parametrize(("densify", "scales", "colors", "rest"), [
    ("reference", 1, 1, 1), ("budget", 4, 2, 4)])
def test_the_first_step_moves_each_parameter_by_its_learning_rate(densify, scales, colors, rest):
    splats = random_splats(4).map(lambda tensor: tensor.float())
    before = splats.map(lambda tensor: tensor.clone())
    optimizer = stepped(splats, times=1, densify=densify)
    moved = {name: (getattr(before, name) - value).abs().median().item()
             for name, value in optimizer.splats.parameters().items()}
    rates = {"means": 2e-4, "quats": 1e-3, "log_scales": scales * 5e-3, "logit_opacities": 5e-2,
             "sh_dc": colors * 2.5e-3, "sh_rest": rest * 1.25e-4}
    for name, rate in rates.items():
        assert abs(moved[name] - rate) < 0.02 * rate, name


@pytest.mark.parametrize(("densify", "share"), [("reference", 0.1), ("budget", 0.2)])
def test_a_recipe_has_a_momentum_of_its_own(densify, share):
    splats = random_splats(4).map(lambda tensor: tensor.float())
    moments = stepped(splats, times=1, densify=densify).tensors()
    gradient = 2 * splats.quats  # of the sum of squares
    assert torch.allclose(moments["adam.quats.exp_avg"], share * gradient, rtol=1e-5)


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


# ---- fused: gradients in buffers, one kernel for all parameters ----

@pytest.mark.integration
@pytest.mark.parametrize("backend", KERNELS)
@pytest.mark.parametrize("n", [1, 5, 37])  # numbers of values that no vector divides
def test_fused_steps_equal_those_of_torch(n, backend):
    plain, fused = optimizer_of(n, backend="torch"), optimizer_of(n, backend=backend)
    walk(plain, 20)
    walk(fused, 20)
    assert plain.count == fused.count == 20
    assert_close(held(fused), held(plain))


def test_fused_steps_have_the_same_bits_with_any_number_of_threads(monkeypatch):
    found = []
    for threads in (1, 2, 3):
        monkeypatch.setattr(pool, "threads", threads)
        optimizer = optimizer_of(1200, backend="numba")  # several blocks of the largest group
        walk(optimizer, 2)
        found.append(held(optimizer))
    for name, value in found[0].items():
        assert torch.equal(value, found[1][name]), name
        assert torch.equal(value, found[2][name]), name


@every_kind
def test_higher_degrees_that_are_not_in_use_stay_as_they_are(backend):
    optimizer = optimizer_of(7, backend=backend)
    before = held(optimizer)
    walk(optimizer, 3, sh_rest=False)
    after = held(optimizer)
    for name, value in before.items():
        kept = "sh_rest" in name
        assert torch.equal(value, after[name]) == kept, name


@pytest.mark.parametrize("backend", KERNELS)
def test_fused_steps_without_higher_degrees_equal_those_of_torch(backend):
    plain, fused = optimizer_of(9, backend="torch"), optimizer_of(9, backend=backend)
    for optimizer in (plain, fused):
        walk(optimizer, 5, sh_rest=False)
        for value in optimizer.splats.parameters().values():
            value.grad = None
        walk(optimizer, 5, start=5)
    assert_close(held(fused), held(plain))


SOURCES = {
    "shrunk": torch.tensor([4, 0, 2]),
    "grown": torch.cat([torch.arange(9), torch.tensor([1, 3, -1, -1])]),
    "beyond capacity": torch.cat([torch.arange(9), torch.full((60,), -1)]),
}


@every_kind
@pytest.mark.parametrize("case", SOURCES)
def test_rows_keep_values_and_moments_when_gaussians_are_replaced(case, backend):
    source = SOURCES[case]
    optimizer = optimizer_of(9, backend=backend)
    walk(optimizer, 3)
    before = held(optimizer)
    new = random_splats(len(source), seed=3, dtype=torch.float32)
    optimizer.replace(new, source)
    after = held(optimizer)
    assert optimizer.count == 3
    assert len(optimizer.splats) == len(source)
    for name, value in new.parameters().items():
        assert torch.equal(after[f"splats.{name}"], value)
        for role in ROLES:
            key = f"adam.{name}.{role}"
            expected = before[key][source.clamp_min(0)]
            expected[source < 0] = 0
            assert torch.equal(after[key], expected), key
    walk(optimizer, 2, start=3)
    assert all(torch.isfinite(value).all() for value in optimizer.tensors().values())


@pytest.mark.parametrize("case", SOURCES)
def test_every_kind_goes_on_alike_after_gaussians_were_replaced(case):
    source, found = SOURCES[case], []
    for backend in BACKENDS:
        optimizer = optimizer_of(9, backend=backend)
        walk(optimizer, 3)
        optimizer.replace(random_splats(len(source), seed=3, dtype=torch.float32), source)
        walk(optimizer, 5, start=3)
        found.append(held(optimizer))
    for other in found[1:]:
        assert_close(other, found[0])


def places(optimizer):
    return {name: value.data_ptr() for name, value in optimizer.tensors().items()
            if name != "adam.count"}


@every_kind
def test_nothing_is_allocated_anew_while_the_gaussians_fit(backend):
    optimizer = optimizer_of(9, backend=backend)
    before = places(optimizer)
    for n in (30, 3, 50):  # the last is the capacity
        source = torch.full((n,), -1)
        optimizer.replace(random_splats(n, dtype=torch.float32), source)
        assert places(optimizer) == before
    optimizer.replace(random_splats(51, dtype=torch.float32), torch.full((51,), -1))
    assert places(optimizer) != before


@every_kind
def test_a_gaussian_takes_as_many_bytes_as_promised(backend):
    optimizer = optimizer_of(9, backend=backend)
    values = sum(value[0].numel() for value in optimizer.splats.parameters().values())
    held = sum(buffer[0].numel() * buffer.element_size()
               for roles in optimizer._buffers.values() for buffer in roles.values())
    of_autograd = 0 if optimizer.fused else 4 * values
    assert held + of_autograd == 4 * 4 * values  # value, gradient and two moments
    assert held + of_autograd <= BYTES


@every_kind
@pytest.mark.parametrize("other", BACKENDS)
def test_what_a_checkpoint_holds_comes_back_bit_by_bit(backend, other):
    optimizer = optimizer_of(9, backend=backend)
    walk(optimizer, 3)
    saved = held(optimizer)
    values = {name.removeprefix("splats."): value
              for name, value in saved.items() if name.startswith("splats.")}
    resumed = SplatOptimizer(Splats(**values), CONFIG, means_unit=2.0, backend=other)
    resumed.restore(saved)
    for name, value in held(resumed).items():
        assert torch.equal(value, saved[name]), name
    if other == backend:
        walk(optimizer, 2, start=3)
        walk(resumed, 2, start=3)
        for name, value in held(resumed).items():
            assert torch.equal(value, held(optimizer)[name]), name
