"""`recon view` as it is typed: what it takes, what it refuses, and how it ends."""

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import urllib.request
from pathlib import Path

import pytest
import torch
from facts import assert_facts

from recon_cli.cli import main
from recon_cli.commands import view
from recon_cli.splats.registry import FORMATS
from recon_cli.viewer.content import load_file
from recon_cli.workspace.export_formats import EXPORT_FORMATS

pytestmark = pytest.mark.floors


@pytest.fixture
def ended(monkeypatch):
    """Ends the viewer as soon as it is there."""
    monkeypatch.setattr(view, "wait", lambda: None)


@pytest.mark.usefixtures("ended")
def test_it_prints_its_address_and_opens_no_browser_where_there_is_no_terminal(
    room, capsys, monkeypatch
):
    opened = []
    monkeypatch.setattr(view.webbrowser, "open", opened.append)
    assert main(["view", "-w", str(room)]) == 0
    address = re.search(r"http://127\.0\.0\.1:\d+", capsys.readouterr().out)[0]
    assert not opened
    assert main(["view", str(room), "--open"]) == 0
    assert opened == [address]


@pytest.mark.usefixtures("ended")
@pytest.mark.parametrize("name", list(FORMATS))
def test_a_file_of_any_format_is_shown_without_cameras(room, tmp_path, name):
    path = tmp_path / EXPORT_FORMATS[name].file
    FORMATS[name].write(path, FORMATS["ply"].read(room / "train" / "splats.ply"))
    content = load_file(path)
    assert [len(packed.splats) for packed in content.models.values()] == [60]
    assert content.views == ()
    assert main(["view", str(path)]) == 0


@pytest.mark.parametrize(("words", "code", "said"), [
    (["nothing.ply"], 3, "does not exist"),
    (["empty"], 3, "neither a workspace nor a splat file"),
    (["text.txt"], 3, "known format"),
    (["room", "-w", "room"], 2, "exclude each other"),
    (["room/train/splats.ply", "--model", "base"], 2, "no effect on a file"),
    (["-w", "none"], 4, "no scene to view"),
    (["room", "--model", "half"], 2, "half"),
    (["room", "--port", "70000"], 2, "70000"),
    (["room", "--host", "no.such.host.invalid"], 2, "no.such.host.invalid"),
])
def test_what_cannot_be_shown_is_refused_with_a_hint(
    room, tmp_path, monkeypatch, capsys, words, code, said
):
    monkeypatch.chdir(tmp_path)
    Path("empty").mkdir()
    Path("text.txt").write_text("no Gaussians")
    Path("room").symlink_to(room)
    assert main(["view", *words]) == code
    found = capsys.readouterr().err
    assert said in found
    assert "hint:" in found


def test_a_file_without_a_gaussian_is_refused(room, tmp_path, capsys):
    splats = FORMATS["ply"].read(room / "train" / "splats.ply")
    FORMATS["ply"].write(tmp_path / "none.ply", splats.select(torch.zeros(60, dtype=torch.bool)))
    assert main(["view", str(tmp_path / "none.ply")]) == 3
    assert "hint:" in capsys.readouterr().err


def test_the_pruned_model_that_is_not_there_is_refused(room, tmp_path, capsys):
    workspace = shutil.copytree(room, tmp_path / "ws")
    shutil.rmtree(workspace / "prune")
    assert main(["view", str(workspace), "--model", "pruned"]) == 4
    assert "recon prune" in capsys.readouterr().err


def test_a_port_that_is_taken_is_refused(room, capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert main(["view", str(room), "--port", str(port)]) == 2
    assert_facts(capsys.readouterr().err, "error:", "port", port)


@pytest.mark.integration
def test_ctrl_c_ends_it_without_a_word_too_many_and_frees_the_port(room):
    with socket.create_server(("127.0.0.1", 0)) as free:  # other workers take the default
        port = free.getsockname()[1]
    process = subprocess.Popen(
        [sys.executable, "-m", "recon_cli", "view", str(room), "--port", str(port)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"})
    killer = threading.Timer(120, process.kill)
    killer.start()
    try:
        assert process.stdout
        address = re.search(r"http://127\.0\.0\.1:(\d+)", process.stdout.readline())
        assert address
        with urllib.request.urlopen(address[0]) as page:
            assert b"<html" in page.read()
        process.send_signal(signal.SIGINT)
        _, said = process.communicate()
    finally:
        killer.cancel()
    assert process.returncode == 0
    assert said.splitlines()[1:] == ["closed"], "after what it opens"
    socket.create_server(("127.0.0.1", int(address[1]))).close()
