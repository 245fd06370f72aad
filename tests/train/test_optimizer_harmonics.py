"""Adam where only some Gaussians have higher spherical harmonics, of any degree."""

import pytest
import torch
from adam_runs import BACKENDS, CONFIG, ROLES, assert_close, every_kind, feed, gradients_of, held
from scenes import random_splats, with_harmonics

from recon_cli.scene.splats import TERMS
from recon_cli.train.fit.optimizer import SplatOptimizer


def some(n, degree, colored, *, seed=0):
    return with_harmonics(random_splats(n, seed=seed, dtype=torch.float32), degree, colored)


def filled(optimizer):
    """Every moment gets a value of its own."""
    for name, value in optimizer.tensors().items():
        if name != "adam.count":
            with torch.no_grad():
                value.copy_(torch.arange(1.0, 1 + value.numel()).view(value.shape))


@every_kind
@pytest.mark.parametrize(("colored", "after", "source"), [
    (9, 4, [1, 3, 5, 7, 0, 2, 4, 6, 8]),  # some lose their coefficients
    (4, 9, [0, 1, 2, 3, 4, 5, 6, 7, 8]),  # all get some
    (4, 3, [3, 1, -1, 8, 5, -1]),  # fewer, and new ones
    (4, 0, [0, 4, 5]),
    (0, 2, [8, -1, 1, 2]),
])
@pytest.mark.parametrize("degree", [1, 3])
def test_moments_of_coefficients_follow_their_gaussian(backend, colored, after, source, degree):
    optimizer = SplatOptimizer(some(9, 3, colored), CONFIG, means_unit=2.0, backend=backend)
    filled(optimizer)
    before = held(optimizer)
    new = some(len(source), degree, after, seed=3)
    optimizer.replace(new, torch.tensor(source))
    now = held(optimizer)
    for name, value in new.parameters().items():
        assert torch.equal(now[f"splats.{name}"], value)
    for role in ROLES:
        moment = before[f"adam.sh_rest.{role}"][:, :TERMS[degree]]
        assert now[f"adam.sh_rest.{role}"].shape == new.sh_rest.shape
        for row, old in enumerate(source[:after]):
            expected = moment[old] if 0 <= old < colored else torch.zeros_like(new.sh_rest[0])
            assert torch.equal(now[f"adam.sh_rest.{role}"][row], expected)
        for row, old in enumerate(source):
            expected = before[f"adam.means.{role}"][old] if old >= 0 else torch.zeros(3)
            assert torch.equal(now[f"adam.means.{role}"][row], expected)


@pytest.mark.parametrize(("degree", "colored"), [(0, 9), (1, 4), (2, 9), (3, 5), (3, 0)])
def test_every_kind_steps_alike_whatever_the_share(degree, colored):
    found = []
    for backend in BACKENDS:
        optimizer = SplatOptimizer(
            some(9, degree, colored), CONFIG, means_unit=2.0, backend=backend)
        for step in range(5):
            gradients = with_harmonics(gradients_of(9, step), degree, colored)
            feed(optimizer, gradients)
            optimizer.step(1e-4)
        found.append(held(optimizer))
    for other in found[1:]:
        assert_close(other, found[0])


@every_kind
def test_no_memory_is_held_for_coefficients_that_nobody_has(backend):
    optimizer = SplatOptimizer(some(9, 3, 9), CONFIG, means_unit=2.0, backend=backend)
    optimizer.replace(some(9, 3, 4), torch.arange(9))
    assert all(len(buffer) == 4 for buffer in optimizer._buffers["sh_rest"].values())
    optimizer.replace(some(9, 3, 9), torch.arange(9))
    assert all(len(buffer) == 50 for buffer in optimizer._buffers["sh_rest"].values())
    optimizer.replace(some(9, 0, 9), torch.arange(9))
    assert all(buffer.numel() == 0 for buffer in optimizer._buffers["sh_rest"].values())
