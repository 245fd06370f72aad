"""The triton backend alone: its kernels compile for GPUs that are not here."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from backends import BLACK, GREENISH, Case
from facts import raises
from interpreter import DEVICE
from scenes import camera_at, random_splats

from recon_cli.render import render

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("triton") is None, reason="the package triton is not installed")


@pytest.mark.compile
def test_every_kernel_compiles_for_gpus_old_and_new_without_spilling(tmp_path):
    script = Path(__file__).with_name("triton_targets.py")
    environment = {**os.environ, "TRITON_CACHE_DIR": str(tmp_path), "TRITON_INTERPRET": "0"}
    done = subprocess.run(
        [sys.executable, str(script)], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count("registers, 0 bytes spilled") == 44


def pictures(splats, case):
    tracked = case.leaves(splats)
    out = case.render(tracked, camera_at(20, 18), GREENISH, 3, scores=True)
    (out.rgb.square().sum() + out.depth.sum() + out.alpha.square().sum()).backward()
    return [out.rgb, out.depth, tracked.means.grad, tracked.sh_rest.grad, out.statistics.loo]


@pytest.mark.integration
def test_the_same_small_scene_gives_the_same_bits_in_any_order_of_its_gaussians():
    case, splats = Case("triton", DEVICE, torch.float32), random_splats(24, seed=2)
    first, again = pictures(splats, case), pictures(splats, case)
    assert all(torch.equal(one, other) for one, other in zip(first, again, strict=True))
    order = torch.randperm(24, generator=torch.Generator().manual_seed(0))
    turned = pictures(splats.select(order), case)
    assert torch.equal(first[0], turned[0])
    assert torch.equal(first[2][order.to(DEVICE)], turned[2])


def test_float64_is_refused():
    with raises(ValueError, "float32"):
        render(random_splats(3), camera_at(), BLACK, 0, backend="triton")


def test_a_scene_of_no_gaussians_in_view_launches_kernels_over_nothing():
    splats = random_splats(3).map(torch.Tensor.float)
    splats.means[:, 2] = -5
    out = render(splats, camera_at(40, 20), BLACK.float(), 0, backend="triton", scores=True)
    assert out.alpha.abs().max() == 0
    assert out.statistics.hits.sum() == 0
