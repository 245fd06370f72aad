"""The check of a backend's kernels before their first use: good ones pass, faults are told."""

import dataclasses
import json

import pytest
import torch
from facts import raises
from interpreter import DEVICE

from recon_cli.errors import BackendError
from recon_cli.render import self_check
from recon_cli.render.self_check import (
    BackendCandidate,
    StepOutcome,
    Verdict,
    check,
    numba_candidate,
)

CPU = torch.device("cpu")
SIZE = {"count": 60, "width": 40, "height": 30}
FAILED = Verdict(
    "triton", "a GPU", "rgb, hard scene: error 7 times the allowed difference", {}, 1.0)
PASSED = Verdict("triton", "a GPU", "", {"rgb, hard scene": 0.01}, 1.0)


# ---- the check itself ----

@pytest.mark.integration
def test_the_numba_kernels_pass_far_from_what_is_allowed():
    verdict = check(numba_candidate(), CPU)
    assert verdict.passed, verdict.failure
    assert max(verdict.errors.values()) < 0.1
    for name in ("rgb, hard scene", "gradient of quats, hard scene", "loss of a step, hard scene",
                 "gradient of sh_rest in a masked step, hard scene", "bits of a second run"):
        assert any(key.startswith(name) for key in verdict.errors), name


@pytest.mark.slow
def test_the_triton_kernels_pass():
    pytest.importorskip("triton", reason="triton is not installed")
    verdict = check(
        self_check.triton_candidate(), torch.device(DEVICE), count=10, width=20, height=14)
    assert verdict.passed, verdict.failure


def faulty(render=None, step=None):
    """The numba backend with a fault in its render function or its training step."""
    good = numba_candidate()
    return BackendCandidate("fake", render(good.render) if render else good.render,
                     step(good.train_step) if step else good.train_step)


def brighter(original):
    def render(*arguments):
        output = original(*arguments)
        return dataclasses.replace(output, rgb=output.rgb + 1e-3)
    return render


def one_wrong_pixel(original):
    def render(*arguments):
        output = original(*arguments)
        spot = torch.zeros_like(output.depth)
        spot[3, 4] = 0.2
        return dataclasses.replace(output, depth=output.depth + spot)
    return render


def steeper(name, factor):
    """The right images, but one gradient is multiplied by a factor."""
    def wrap(original):
        def render(splats, *rest):
            value = getattr(splats, name)
            scaled = value * factor - (value * (factor - 1)).detach()
            return original(dataclasses.replace(splats, **{name: scaled}), *rest)
        return render
    return wrap


def other_bits(original):
    calls = []

    def render(*arguments):
        calls.append(1)
        output = original(*arguments)
        return dataclasses.replace(output, rgb=output.rgb + 1e-7 * len(calls))
    return render


def raising(_original):
    def fail(*_arguments):
        raise RuntimeError("PTX was compiled with\nan unsupported toolchain")
    return fail


def changed(change):
    """A training step whose result is changed."""
    def wrap(original):
        return lambda *arguments: change(original(*arguments))
    return wrap


def wrong_loss(result):
    return dataclasses.replace(result, loss=result.loss + 1e-3)


def wrong_gradient(result):
    return dataclasses.replace(result, gradients=dataclasses.replace(
        result.gradients, sh_dc=result.gradients.sh_dc * 1.01))


def wrong_adam(result):
    moved = result.moved.map(lambda tensor: tensor + 2e-5)
    return StepOutcome(result.loss, result.gradients, moved)


def no_number(result):
    return dataclasses.replace(result, loss=float("nan"))


@pytest.mark.integration
@pytest.mark.parametrize(("candidate", "failure"), [
    (faulty(brighter), "rgb, ordinary scene"),
    (faulty(one_wrong_pixel), "depth, ordinary scene"),
    (faulty(steeper("quats", 1.01)), "gradient of quats, ordinary scene"),
    (faulty(steeper("sh_rest", 1.5)), "gradient of sh_rest, ordinary scene"),
    (faulty(other_bits), "bits of a second run"),
    (faulty(raising), "RuntimeError: PTX was compiled with an unsupported toolchain"),
    (faulty(step=changed(wrong_loss)), "loss of a step"),
    (faulty(step=changed(no_number)), "loss of a step"),
    (faulty(step=changed(wrong_gradient)), "gradient of sh_dc in a step"),
    (faulty(step=changed(wrong_adam)), "Adam of means in a step"),
    (faulty(step=raising), "RuntimeError"),
], ids=lambda value: value.replace(" ", "-") if isinstance(value, str) else "")
def test_a_fault_is_found_and_named(candidate, failure):
    verdict = check(candidate, CPU, **SIZE)
    assert not verdict.passed
    assert verdict.failure.startswith(failure)
    json.loads(json.dumps(dataclasses.asdict(verdict), allow_nan=False))  # doctor prints it


# ---- the verdict on disk ----

@pytest.fixture
def checks(monkeypatch, tmp_path):
    """An empty cache folder, and how often the fake backend was checked."""
    calls = []

    def fake_check(candidate, device):
        calls.append(candidate)
        return Verdict("numba", device.type, "", {"rgb": 0.1}, 0.5)

    monkeypatch.setenv("RECON_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(self_check, "check", fake_check)
    monkeypatch.setattr(self_check, "_verdicts", {})
    return calls


def in_a_new_process(monkeypatch):
    """Asks for the verdict with nothing but the disk to remember it."""
    monkeypatch.setattr(self_check, "_verdicts", {})
    return self_check.verdict_for("numba", CPU)


def test_a_verdict_is_kept_for_the_next_process(checks, monkeypatch):
    first = self_check.verdict_for("numba", CPU)
    assert in_a_new_process(monkeypatch) == first
    assert len(checks) == 1


def test_another_driver_version_or_source_is_checked_anew(checks, monkeypatch):
    self_check.verdict_for("numba", CPU)
    original = self_check._key
    for name in ("driver", "gpu", "torch", "numba", "recon", "sources"):
        monkeypatch.setattr(
            self_check, "_key",
            lambda *arguments, name=name: original(*arguments) | {name: "another"})
        in_a_new_process(monkeypatch)
    assert len(checks) == 7


@pytest.mark.parametrize("content", [
    b"", b"{", b"[]", b"\xff\xfe", b'{"key": {}, "verdict": {}}', b'{"key": 1}'])
def test_a_damaged_verdict_is_checked_again(checks, monkeypatch, tmp_path, content):
    self_check.verdict_for("numba", CPU)
    path, = (tmp_path / "self-check").iterdir()
    whole = path.read_bytes()
    path.write_bytes(content)
    assert in_a_new_process(monkeypatch).passed
    assert len(checks) == 2
    assert path.read_bytes() == whole  # repaired


def test_a_verdict_with_missing_fields_is_checked_again(checks, monkeypatch, tmp_path):
    self_check.verdict_for("numba", CPU)
    path, = (tmp_path / "self-check").iterdir()
    content = json.loads(path.read_text())
    del content["verdict"]["failure"]
    path.write_text(json.dumps(content))
    assert in_a_new_process(monkeypatch).passed
    assert len(checks) == 2


def test_without_a_writable_folder_a_process_checks_once_and_says_so(
        checks, monkeypatch, tmp_path, caplog):
    (tmp_path / "file").touch()
    monkeypatch.setenv("RECON_CACHE_DIR", str(tmp_path / "file"))
    assert self_check.verdict_for("numba", CPU).passed
    assert self_check.verdict_for("numba", CPU).passed
    assert len(checks) == 1
    assert "RECON_CACHE_DIR" in caplog.text


def test_a_fault_that_spoils_cuda_for_the_process_is_kept_and_tells_to_run_again(monkeypatch):
    def broken(*_, **__):
        raise RuntimeError("CUDA error: an illegal memory access was encountered")

    monkeypatch.setattr(torch, "zeros", broken)
    with raises(BackendError, "process") as caught:
        self_check._require_usable(torch.device("cuda"), FAILED)
    assert "again" in caught.value.hint
    self_check._require_usable(torch.device("cuda"), PASSED)
    self_check._require_usable(CPU, FAILED)
