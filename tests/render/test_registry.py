"""Names, defaults and refusals of backends and devices."""

import importlib.util

import pytest
import torch

from recon_cli.errors import BackendError
from recon_cli.render import resolve


def test_auto_names_what_will_run():
    assert resolve("auto", "cpu") == ("numba", "cpu")


def test_a_backend_that_does_not_exist_is_refused():
    with pytest.raises(BackendError, match="no backend"):
        resolve("vulkan", "cpu")


def on_a_gpu(monkeypatch, *, capability=(9, 0), triton=True):
    """Lets the registry believe in a GPU."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: capability)
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: (
        object() if triton else None) if name == "triton" else find(name))


def test_auto_takes_triton_on_a_gpu(monkeypatch):
    on_a_gpu(monkeypatch)
    assert resolve("auto", "auto") == ("triton", "cuda")
    assert resolve("auto", "cpu") == ("numba", "cpu")


@pytest.mark.parametrize(("there", "reason"), [
    ({"triton": False}, "not installed"), ({"capability": (6, 1)}, "compute capability 6.1")])
def test_auto_says_why_torch_is_used_in_place_of_triton(monkeypatch, caplog, there, reason):
    on_a_gpu(monkeypatch, **there)
    with caplog.at_level("WARNING", "recon"):
        assert resolve("auto", "cuda") == ("torch", "cuda")
    assert "torch is used in place of triton" in caplog.text
    assert reason in caplog.text
    with pytest.raises(BackendError, match=reason):
        resolve("triton", "cuda")


def test_triton_is_refused_on_the_cpu():
    with pytest.raises(BackendError, match=r"does not run on cpu|no CUDA device"):
        resolve("triton", "cpu")


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has CUDA")
def test_cuda_is_refused_where_there_is_none_instead_of_using_the_cpu():
    with pytest.raises(BackendError, match="CUDA") as caught:
        resolve("torch", "cuda")
    assert caught.value.exit_code == 6
