"""Names, defaults and refusals of backends and devices."""

import importlib.util

import pytest
import torch
from facts import assert_facts, raises

from recon_cli.errors import BackendError
from recon_cli.render import resolve, self_check
from recon_cli.render.registry import cuda_verdict
from recon_cli.render.self_check import Verdict

FAILURE = "gradient of quats, hard scene: error 312 times the allowed difference"


def test_auto_names_what_will_run():
    assert resolve("auto", "cpu") == ("numba", "cpu")


def test_a_backend_that_does_not_exist_is_refused():
    with raises(BackendError, "backend"):
        resolve("vulkan", "cpu")


def on_a_gpu(monkeypatch, *, capability=(9, 0), triton=True, failure=""):
    """Lets the registry believe in a GPU, on which the self-check of triton ends like this."""
    monkeypatch.setattr(self_check, "verdict_for", lambda backend, device: Verdict(
        backend, f"a {device.type} GPU", failure, {}, 2.0))
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
    ({"triton": False}, "installed"), ({"capability": (6, 1)}, 6.1)])
def test_auto_says_why_torch_is_used_in_place_of_triton(monkeypatch, caplog, there, reason):
    on_a_gpu(monkeypatch, **there)
    with caplog.at_level("WARNING", "recon"):
        assert resolve("auto", "cuda") == ("torch", "cuda")
    assert_facts(caplog.text, "torch", "place", "triton", reason)
    with raises(BackendError, reason):
        resolve("triton", "cuda")


def test_auto_takes_torch_where_the_triton_kernels_fail_on_this_gpu(monkeypatch, caplog):
    on_a_gpu(monkeypatch, failure=FAILURE)
    with caplog.at_level("WARNING", "recon"):
        assert resolve("auto", "auto") == ("torch", "cuda")
    assert_facts(caplog.text, "torch", "place", "triton")
    assert FAILURE in caplog.text
    assert not cuda_verdict().passed


def test_triton_by_name_runs_where_it_fails_with_a_warning(monkeypatch, caplog):
    on_a_gpu(monkeypatch, failure=FAILURE)
    with caplog.at_level("WARNING", "recon"):
        assert resolve("triton", "cuda") == ("triton", "cuda")
    assert_facts(caplog.text, "results", "wrong")
    assert FAILURE in caplog.text
    caplog.clear()
    on_a_gpu(monkeypatch)
    assert resolve("triton", "cuda") == ("triton", "cuda")
    assert not caplog.text


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has CUDA")
def test_nothing_is_checked_where_triton_cannot_run():
    assert cuda_verdict() is None


def test_triton_is_refused_on_the_cpu():
    with raises(BackendError, "triton"):
        resolve("triton", "cpu")


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has CUDA")
def test_cuda_is_refused_where_there_is_none_instead_of_using_the_cpu():
    with raises(BackendError, "CUDA") as caught:
        resolve("torch", "cuda")
    assert caught.value.exit_code == 6
