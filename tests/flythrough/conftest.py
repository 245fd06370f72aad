"""Workspaces of known truth."""

import shutil

import pytest
from prepared_workspace import make_workspace, wall
from render_cli import splats


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A workspace with a base and a pruned model, whose units are metres; nobody writes in it."""
    return make_workspace(
        tmp_path_factory.mktemp("room"), splats(1), pruned=splats(2), metres=True)


@pytest.fixture(scope="module")
def before_a_wall(tmp_path_factory):
    """A workspace of unknown scale and up whose model is a wall at z = 4."""
    return make_workspace(
        tmp_path_factory.mktemp("wall"), wall(4.0, spacing=0.15), up_found=False)


@pytest.fixture
def copied(room, tmp_path):
    """A workspace of one's own."""
    return shutil.copytree(room, tmp_path / "ws")
