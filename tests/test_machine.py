"""The facts on the machine."""

from pathlib import Path

import pytest

from recon_cli import machine


def test_the_folder_follows_the_custom_of_the_platform(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
) -> None:
    monkeypatch.delenv("RECON_CACHE_DIR", raising=False)
    monkeypatch.setattr(machine.sys, "platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert machine.cache_root() == tmp_path / "recon"
    monkeypatch.setattr(machine.sys, "platform", "darwin")
    assert machine.cache_root() == Path.home() / "Library" / "Caches" / "recon"
    monkeypatch.setattr(machine.sys, "platform", "win32")
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path))
    assert machine.cache_root() == tmp_path / "recon" / "cache"
    monkeypatch.setenv("RECON_CACHE_DIR", str(tmp_path / "mine"))
    assert machine.cache_root() == tmp_path / "mine"
