"""What the doctor finds."""

from pathlib import Path

from recon_cli.commands import doctor


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
