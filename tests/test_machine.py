"""The facts on the machine."""

import shlex
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


@pytest.fixture
def environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """An environment with pip, and recon as a wheel leaves it: no clone around it."""
    scripts = tmp_path / "env" / "bin"
    scripts.mkdir(parents=True)
    (scripts / "pip").touch()
    monkeypatch.setattr(machine.sys, "platform", "linux")
    monkeypatch.setattr(machine.sys, "prefix", str(scripts.parent))
    monkeypatch.setattr(machine.sys, "executable", str(scripts / "python"))
    monkeypatch.setattr(
        machine, "__file__", str(tmp_path / "lib" / "recon_cli" / "machine.py"))
    monkeypatch.setattr(machine.importlib.metadata, "requires", lambda name: {
        "recon-gs": ["numpy>=1.26", "ray>=2.40; extra == 'ray'", 'lpips>=0.1.4; extra=="lpips"',
                     "ray>=2.40; extra == 'dev'"]}[name])
    monkeypatch.chdir(tmp_path)
    return scripts.parent


def test_in_a_clone_an_extra_is_installed_from_the_clone(
    environment: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
) -> None:
    clone = tmp_path / "my recon"
    (clone / "recon_cli").mkdir(parents=True)
    (clone / "pyproject.toml").touch()
    monkeypatch.setattr(machine, "__file__", str(clone / "recon_cli" / "machine.py"))
    assert shlex.split(machine.install_command("ray")) == [
        "env/bin/pip", "install", "-e", "my recon[ray]"]
    monkeypatch.chdir(clone)
    assert shlex.split(machine.install_command("ray")) == [
        str(environment / "bin" / "pip"), "install", "-e", ".[ray]"]


def test_of_a_wheel_the_packages_of_the_extra_are_installed(environment: Path) -> None:
    assert shlex.split(machine.install_command("ray")) == ["env/bin/pip", "install", "ray>=2.40"]
    assert shlex.split(machine.install_command("lpips"))[-1] == "lpips>=0.1.4"
    (environment / "bin" / "pip").unlink()
    assert shlex.split(machine.install_command("ray")) == [
        str(environment / "bin" / "python"), "-m", "pip", "install", "ray>=2.40"]


def test_pipx_and_uv_install_by_their_own_commands(
    environment: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(machine.importlib.util, "find_spec", lambda _name: None)
        assert shlex.split(machine.install_command("ray")) == [
            "uv", "pip", "install", "--python", str(environment / "bin" / "python"), "ray>=2.40"]
    (environment / "pipx_metadata.json").touch()
    assert shlex.split(machine.install_command("ray")) == [
        "pipx", "inject", "recon-gs", "ray>=2.40"]
