"""A workspace with a base and a pruned model; nobody writes in it, tests take a copy."""

import shutil
from pathlib import Path

import pytest
from report_workspace import make_workspace


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_workspace(tmp_path_factory.mktemp("page"))


@pytest.fixture
def workspace(finished: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(finished, tmp_path / "ws", copy_function=shutil.copy2))
