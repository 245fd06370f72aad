"""What is public: listed, loaded lazily, and as it was in the last version that anybody used."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest
from facts import raises

from recon_cli import api

ROOT = Path(__file__).resolve().parents[2]
RENEW = "If that is meant: .venv/bin/python docs/generate_api.py --accept-signatures"


@pytest.fixture(scope="module")
def generator():
    spec = importlib.util.spec_from_file_location("generate_api", ROOT / "docs/generate_api.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def may_come(line: str, generator) -> bool:
    """Returns whether a new line breaks nobody: an option, or a field of a record."""
    found = re.match(r"(\w+)\.\w+: ", line)
    return bool(found) and generator.may_gain_fields(generator.public()[found[1]])


def test_no_public_signature_has_changed(generator) -> None:
    before = generator.SNAPSHOT.read_text(encoding="utf-8").splitlines()
    now = generator.signatures()
    gone = [line for line in before if line not in now]
    new = [line for line in now if line not in before and not may_come(line, generator)]
    assert (gone, new) == ([], []), RENEW


@pytest.mark.integration
def test_a_changed_signature_is_found(generator, monkeypatch) -> None:
    def render(splats: object) -> None:
        """Has lost its camera."""

    monkeypatch.setattr(api, "render", render)
    before = generator.SNAPSHOT.read_text(encoding="utf-8").splitlines()
    assert any(line.startswith("render(") for line in before
               if line not in generator.signatures())
    assert may_come("TrainConfig.something: int", generator)
    assert not may_come("Workspace.something: int", generator)


def test_every_name_is_there_and_explains_itself() -> None:
    for name in api.__all__:
        item = getattr(api, name)
        assert item.__doc__, name
        assert name in dir(api)
    with raises(AttributeError, "rendre"):
        api.rendre  # noqa: B018


def test_type_checkers_see_the_names_that_are_loaded_lazily() -> None:
    source = (ROOT / "recon_cli" / "api" / "__init__.py").read_text(encoding="utf-8")
    imported = re.findall(r"^    from (\S+) import (\w+) as \2$", source, re.M)
    assert {name: module for module, name in imported} == api._HOMES


@pytest.mark.integration
def test_the_import_loads_neither_torch_nor_click() -> None:
    code = ("import sys, recon_cli.api; from recon_cli.api import Workspace; "
            "print(*{'torch', 'numba', 'click', 'pycolmap'} & set(sys.modules))")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
