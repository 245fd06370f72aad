"""A workspace of known truth, and a viewer of it in this process."""

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from prepared_workspace import make_workspace
from scenes import random_splats
from viewing import view

from recon_cli.scene.splats import with_terms


def harmonic(count, seed):
    """Gaussians in front of all cameras whose colours differ from side to side."""
    made = random_splats(count, seed=seed, dtype=torch.float32)
    made.means[:, 2] = 3 + 0.3 * made.means[:, 2]
    made.log_scales.clamp_(min=-2.0, max=-1.5)
    generator = torch.Generator().manual_seed(seed)
    rest = 0.4 * torch.randn(count, 3, 3, generator=generator)
    return dataclasses.replace(made, sh_rest=with_terms(rest, 3))


@pytest.fixture(scope="package")
def room(tmp_path_factory):
    """A workspace with 60 Gaussians, 25 of which are left after pruning; nobody writes in it."""
    base = harmonic(60, 1)
    return make_workspace(
        tmp_path_factory.mktemp("room"), base, pruned=base.select(torch.arange(25)))


@pytest.fixture
def shown(room):
    """A viewer of that workspace."""
    with view(room) as found:
        yield found


@pytest.fixture
def elsewhere():
    """A thread to wait in for a browser, while playwright keeps this one."""
    with ThreadPoolExecutor(1) as pool:
        yield pool
