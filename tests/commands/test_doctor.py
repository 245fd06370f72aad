"""The doctor's findings."""

import dataclasses
import json
from pathlib import Path

import pytest

from recon_cli.commands import doctor
from recon_cli.render import registry
from recon_cli.render.self_check import Verdict


def test_the_doctor_finds_versions_backends_memory_and_disk(tmp_path: Path) -> None:
    found = doctor.examine(tmp_path / "not" / "there" / "yet")
    assert {"python", "recon", "torch", "pycolmap", "opencv", "numpy"} <= found.versions.keys()
    assert "missing" not in found.versions.values()
    assert any("cpu" in backend.devices and not backend.missing for backend in found.backends)
    assert 0 < found.memory_free_bytes <= found.memory_total_bytes
    assert found.disk_free_bytes > 0
    assert found.cores >= 1
    assert found.writable
    assert not (tmp_path / "not").exists()


def test_a_file_in_the_place_of_the_workspace_is_not_writable(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert not doctor.examine(tmp_path / "file").writable


@pytest.mark.parametrize(("failure", "told"), [
    ("", "triton on a GPU: passed in 2.0 s"), ("rgb is off", "FAILED, torch is used instead: rgb")])
def test_the_self_check_of_triton_is_told(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, failure: str, told: str
) -> None:
    plain = doctor.examine(tmp_path)
    verdict = Verdict("triton", "a GPU", failure, {"rgb": 0.1}, 2.0)
    monkeypatch.setattr(registry, "cuda_verdict", lambda: verdict)
    findings = doctor.examine(tmp_path)
    assert told in doctor.findings_text(findings)
    printed = json.loads(json.dumps(dataclasses.asdict(findings)))
    assert printed["self_check"]["failure"] == failure
    if plain.self_check is None:  # no GPU here
        assert "self-check" not in doctor.findings_text(plain)
