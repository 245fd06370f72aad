"""Pipes, sockets, devices and names that are too long, given to anything that takes a path."""

import os
import socket
from pathlib import Path

import pytest
from facts import raises

from recon_cli.cli import main
from recon_cli.config.settings import read_settings
from recon_cli.errors import ExitCode, FormatError, ReconError
from recon_cli.io.colmap import Reader
from recon_cli.splats.ply_tables import read_header
from recon_cli.trust.support import ViewSupport
from recon_cli.workspace.atomic import LEFTOVERS, read_json, replacing, write_bytes
from recon_cli.workspace.digests import read_source
from recon_cli.workspace.paths import refuse_special

LONG = "x" * 300


@pytest.fixture
def pipe(tmp_path):
    path = tmp_path / "pipe.json"
    os.mkfifo(path)
    return path


def test_files_folders_and_what_is_not_there_are_fine(tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "link").symlink_to("file")
    for name in ("", "file", "link", "none", "none/below"):
        refuse_special(tmp_path / name)


def test_a_pipe_a_device_and_a_socket_are_named(tmp_path, pipe, monkeypatch):
    (tmp_path / "link").symlink_to("/dev/zero")
    monkeypatch.chdir(tmp_path)
    with socket.socket(socket.AF_UNIX) as bound:
        bound.bind("socket")
        for path, kind in ((pipe, "named pipe"), (Path("link"), "device"),
                           (Path("/dev/null"), "device"), (Path("socket"), "socket")):
            with raises(FormatError, kind):
                refuse_special(path)


@pytest.mark.parametrize("read", [
    read_json, read_settings, read_header, ViewSupport.load, lambda path: Reader(path, "hint"),
    lambda path: read_source(path, without=path.parent)])
def test_no_reader_waits_for_a_pipe(pipe, read):
    with raises(ReconError, "pipe"):
        read(pipe)


@pytest.mark.parametrize("words", [
    ["ingest", "PATH"], ["import", "PATH"], ["run", "PATH"], ["eval", "PATH"], ["view", "PATH"],
    ["batch", "PATH", "--out", "out"], ["report", "-o", "PATH"], ["render", "--path", "PATH"],
    ["render", "--out", "PATH"], ["export", "--transform", "PATH"], ["train", "--config", "PATH"],
    ["status", "-w", "PATH"], ["map-segment", "PATH"], ["bench", "--compare", "PATH"]],
    ids=" ".join)
def test_no_verb_takes_a_pipe_or_a_name_that_is_too_long(
    tmp_path, pipe, words, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    for path in (str(pipe), f"{LONG}.json"):
        code = main([path if word == "PATH" else word for word in words])
        said = capsys.readouterr().err
        assert code in (ExitCode.USAGE, ExitCode.INPUT, ExitCode.STAGE), said
        assert "error:" in said
        assert "bug" not in said
    assert pipe.is_fifo()


def test_a_file_whose_name_is_as_long_as_one_may_be_is_written(tmp_path):
    path = tmp_path / ("é" * 120 + ".json")
    write_bytes(path, b"x")
    assert path.read_bytes() == b"x"
    with replacing(path) as temporary:
        temporary.touch()
        assert list(tmp_path.glob(LEFTOVERS)) == [temporary]
