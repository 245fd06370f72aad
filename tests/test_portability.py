"""What macOS and Windows do differently, as far as this system can act like them."""

from __future__ import annotations

import ast
import errno
import importlib.util
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest
import torch
from facts import raises
from scenes import random_splats
from syntax import FILES, PACKAGE, dotted, nodes

from recon_cli import processes, signals
from recon_cli.config.stages import RunConfig
from recon_cli.errors import ConfigError, ExitCode
from recon_cli.pipeline.batch import name_captures
from recon_cli.train.fit.state import load_state, new_state, save_state
from recon_cli.viewer import server
from recon_cli.workspace import atomic, disk, durable, layout, steps

ROOT = PACKAGE.parent
# Names that Windows keeps for devices, whatever suffix they have.
RESERVED = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)
# What only POSIX has, and which module may name it: behind a question whether it is there.
POSIX_ONLY = {
    "os.getuid": "kernels/kernel.py", "os.sched_getparam": "flythrough/output.py",
    "os.sched_getscheduler": "flythrough/output.py",
    "os.sched_setscheduler": "flythrough/output.py",
    "mmap.MADV_DONTNEED": "scene/image_file.py", "segment.madvise": "scene/image_file.py"}
MISSING = re.compile(
    r"os\.(fork|forkpty|getuid|geteuid|getgid|getpgid|setsid|killpg|mkfifo|statvfs|sysconf|uname|"
    r"nice|sched_\w+|getloadavg|chown|wait\w*|register_at_fork|get_blocking|set_blocking)|"
    r"signal\.(SIGHUP|SIGKILL|SIGUSR\d|SIGALRM|SIGCHLD|SIGPIPE|SIGQUIT|pthread_\w+|alarm|"
    r"setitimer|sigwait\w*)|mmap\.(MADV_\w+|MAP_\w+|PROT_\w+)|\w+\.madvise|socket\.AF_UNIX")
POSIX_MODULES = {"fcntl", "resource", "pwd", "grp", "termios", "tty", "pty", "syslog"}
FLAGS = os.O_RDWR | os.O_WRONLY


def all_nodes(kind):
    for path in FILES:
        for node in nodes(path, kind):
            yield path.relative_to(PACKAGE).as_posix(), node


@pytest.fixture
def on_windows(monkeypatch):
    """Files as Windows has them: no handle of a folder, no flush of what is open for reading."""
    flush, opening = os.fsync, os.open

    def fsync(descriptor):
        import fcntl

        if not fcntl.fcntl(descriptor, fcntl.F_GETFL) & FLAGS:
            raise OSError(errno.EBADF, "Bad file descriptor")
        flush(descriptor)

    def refusing_folders(path, flags, *rest, **more):
        if os.path.isdir(path):
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return opening(path, flags, *rest, **more)

    monkeypatch.setattr(durable, "ON_WINDOWS", True)
    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(os, "open", refusing_folders)


@pytest.mark.integration
def test_what_only_posix_has_is_asked_for_before_it_is_used():
    found = {(name, where) for where, node in all_nodes(ast.Attribute)
             if MISSING.fullmatch(name := dotted(node))}
    assert found == set(POSIX_ONLY.items())
    for _, where in found:
        assert "hasattr(" in (PACKAGE / where).read_text(encoding="utf-8")


def test_no_module_of_posix_alone_is_imported():
    for where, node in all_nodes(ast.Import):
        assert not POSIX_MODULES & {alias.name for alias in node.names}, where
    for where, node in all_nodes(ast.ImportFrom):
        assert node.module not in POSIX_MODULES, where


@pytest.mark.integration
def test_text_is_read_and_written_as_utf8_whatever_the_system_prefers():
    for where, node in all_nodes(ast.Call):
        if not isinstance(node.func, ast.Attribute):
            continue
        words = {word.arg for word in node.keywords}
        mode = next((each.value for each in node.args[:1] if isinstance(each, ast.Constant)), "r")
        text = node.func.attr in ("read_text", "write_text") or (
            node.func.attr == "open" and isinstance(mode, str) and "b" not in mode
            and dotted(node.func.value).endswith(("path", "file", "log")))
        own = dotted(node.func.value) == "atomic"  # which knows nothing else
        assert not text or own or "encoding" in words, f"{where}:{node.lineno}"


def test_names_of_files_differ_by_more_than_case_and_can_be_made_on_windows():
    paths = [path.relative_to(ROOT).as_posix() for top in (PACKAGE, ROOT / "tests", ROOT / "docs")
             for path in top.rglob("*") if "__pycache__" not in path.parts]
    assert [path for path, count in Counter(map(str.casefold, paths)).items() if count > 1] == []
    assert [path for path in paths
            if any(RESERVED.fullmatch(part) for part in Path(path).parts)
            or re.search(r'[<>:"\\|?*]|[. ](/|$)', path)] == []


def test_two_captures_whose_names_differ_only_in_case_get_different_folders(tmp_path):
    first, second = name_captures(
        [tmp_path / "up" / "Room.mp4", tmp_path / "down" / "room.mp4"], tmp_path / "out")
    assert (first.name, second.name) == ("up-Room", "down-room")
    with raises(ConfigError, "both"):
        name_captures([tmp_path / "Room.mp4", tmp_path / "room.mov"], tmp_path / "out")


@pytest.mark.usefixtures("on_windows")
def test_results_are_flushed_where_folders_cannot_be_and_files_only_for_writing(tmp_path):
    stage = tmp_path / ".partial" / "train"
    stage.mkdir(parents=True)
    steps.start(stage)
    atomic.write_text(stage / "a.txt", "one")
    (stage / "log.txt").write_bytes(b"line")
    steps.expect_growth(stage / "log.txt")
    (stage / "folder").mkdir()
    sealed = layout.Workspace(tmp_path).seal("train")
    assert set(sealed) == {"a.txt", "log.txt"}
    atomic.sync_folder(tmp_path)
    layout.move(stage, tmp_path / "train")
    assert (tmp_path / "train" / "a.txt").read_text(encoding="utf-8") == "one"


def test_a_file_that_is_read_only_is_left_unflushed_on_windows(tmp_path, monkeypatch):
    monkeypatch.setattr(durable, "ON_WINDOWS", True)
    monkeypatch.setattr(Path, "open", raising(PermissionError))
    durable.flush(tmp_path / "file")


def raising(error):
    def act(*_arguments, **_more):
        raise error
    return act


@pytest.mark.parametrize("act", [durable.rename, durable.replace])
def test_a_rename_waits_for_a_scanner_on_windows_and_fails_at_once_elsewhere(
    tmp_path, monkeypatch, act
):
    calls = []

    def busy_twice(source, target):
        calls.append(target)
        if len(calls) < 3:
            raise PermissionError(errno.EACCES, "in use")
        os.replace(source, target)

    monkeypatch.setattr(Path, act.__name__, busy_twice)
    monkeypatch.setattr(durable, "_WAITS", (0.0, 0.0, 0.0))
    (tmp_path / "a").write_bytes(b"1")
    with pytest.raises(PermissionError):
        act(tmp_path / "a", tmp_path / "b")
    assert len(calls) == 1
    monkeypatch.setattr(durable, "ON_WINDOWS", True)
    act(tmp_path / "a", tmp_path / "b")
    assert (tmp_path / "b").read_bytes() == b"1"
    assert len(calls) == 3


def test_a_line_of_digests_keeps_its_bytes_where_files_are_text_unless_told(
    tmp_path, monkeypatch
):
    stage = tmp_path / ".partial" / "train"
    stage.mkdir(parents=True)
    steps.start(stage)
    binary = 1 << 40  # of no other flag
    opening, asked = os.open, []

    def noting(path, flags, *rest):
        asked.append(flags)
        return opening(path, flags & ~binary, *rest)

    monkeypatch.setattr(os, "O_BINARY", binary, raising=False)
    monkeypatch.setattr(os, "open", noting)
    steps.confirm(stage / "file")
    assert asked[-1] & binary
    steps.StepFolder(stage, steps.log_path(stage)).refuse_damaged_log()


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="needs /proc")
def test_a_checkpoint_that_was_read_is_closed_so_that_it_can_be_replaced(tmp_path):
    # what safetensors gives keeps its file mapped, which Windows refuses to replace
    path, config = tmp_path / "state.safetensors", RunConfig()
    save_state(path, new_state(random_splats(1 << 10), config, 1.0))
    state = load_state(path, config, 1.0, torch.device("cpu"))
    assert len(state.splats) == 1 << 10
    assert str(tmp_path) not in Path("/proc/self/maps").read_text(encoding="utf-8")


def test_a_file_is_copied_where_links_are_not_implemented(tmp_path, monkeypatch):
    (tmp_path / "a").write_bytes(b"1")
    monkeypatch.setattr(os, "link", raising(NotImplementedError("follow_symlinks")))
    layout.link_or_copy(tmp_path / "a", tmp_path / "b")
    assert (tmp_path / "b").read_bytes() == b"1"


def reload_with(module, monkeypatch, missing=(), **more):
    """A copy of a module as it is where a system lacks some names and has others."""
    for owner, name in missing:
        monkeypatch.delattr(owner, name)
    for words, value in more.items():
        owner, _, name = words.partition("__")
        monkeypatch.setattr(sys.modules[owner], name, value, raising=False)
    spec = importlib.util.spec_from_file_location(f"{module.__name__}_elsewhere", module.__file__)
    copy = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(copy)
    return copy


def send(number):
    os.kill(os.getpid(), number)
    time.sleep(0.01)  # Python looks between two of its instructions


def test_signals_work_without_sighup_and_ctrl_break_counts_as_sigterm(monkeypatch):
    # SIGUSR1 stands in for SIGBREAK, which is raised by Ctrl-Break and by a console that closes
    copy = reload_with(
        signals, monkeypatch, [(signal, "SIGHUP")], signal__SIGBREAK=signal.SIGUSR1)
    assert copy.NUMBERS == (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)
    with pytest.raises(KeyboardInterrupt) as raised, copy.raising():
        send(signal.SIGUSR1)
    assert copy.exit_code(raised.value) == ExitCode.TERMINATED
    assert "SIGTERM" in copy.describe_end(raised.value)


def test_handlers_are_put_back_where_there_is_no_sigaction(monkeypatch):
    monkeypatch.setattr(signals.os, "name", "nt")
    monkeypatch.setattr(signals.ctypes, "CDLL", raising(TypeError("no such library")))
    before = signal.getsignal(signal.SIGTERM)
    with signals.keeping_handlers():
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_child_has_a_group_of_its_own_and_is_asked_by_ctrl_break_on_windows(
    tmp_path, monkeypatch
):
    copy = reload_with(processes, monkeypatch, subprocess__CREATE_NEW_PROCESS_GROUP=512,
                       signal__CTRL_BREAK_EVENT=signal.SIGUSR1)
    given = {}
    monkeypatch.setattr(subprocess, "Popen", lambda *_words, **more: given.update(more))
    for session, flags in ((True, 512), (False, 0)):
        copy.start_module("x", folder=tmp_path, out=1, errors=2, session=session)
        assert given["creationflags"] == flags

    class Child:
        def __init__(self, error=None):
            self.error, self.said = error, []

        def send_signal(self, number):
            self.said.append(number)
            if self.error:
                raise self.error

        def terminate(self):
            self.said.append("terminate")

    for error, said in ((None, [signal.SIGUSR1]), (ProcessLookupError(), [signal.SIGUSR1]),
                        (OSError(6, "no console"), [signal.SIGUSR1, "terminate"])):
        child = Child(error)
        copy.ask_to_end(child)
        assert child.said == said


def test_the_words_of_an_unknown_error_mean_no_full_disk(monkeypatch):
    said = os.strerror
    monkeypatch.setattr(os, "strerror", lambda number: (
        "Unknown error" if number == errno.EDQUOT else said(number)))  # Windows has no quota's
    copy = reload_with(disk, monkeypatch)
    assert copy.find_space_errno(RuntimeError("Unknown error")) is None
    assert copy.find_space_errno(RuntimeError(said(errno.ENOSPC))) == errno.ENOSPC


def test_a_port_in_use_is_not_shared_on_windows(monkeypatch):
    asked = []

    class Trial(socket.socket):
        def setsockopt(self, *words):
            asked.append(words)
            super().setsockopt(*words)

    monkeypatch.setattr(server.socket, "socket", Trial)
    assert server._is_free("127.0.0.1", 0)
    assert len(asked) == 1
    monkeypatch.setattr(server.os, "name", "nt")
    assert server._is_free("127.0.0.1", 0)
    assert len(asked) == 1


@pytest.mark.integration
def test_every_program_of_recon_runs_as_a_module_without_make(tmp_path):
    done = subprocess.run(
        processes.python_command("-m", "recon_cli", "demo", "--help"), cwd=tmp_path,
        capture_output=True, text=True, check=True)
    assert "recon demo" in done.stdout


@pytest.mark.integration
def test_frames_are_chosen_without_what_windows_lacks(tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent / "without_posix")}
    video = PACKAGE / "samples" / "room.mp4"
    commands = ((["ingest", str(video), "--frames", "12"], "ingest"), (["status"], "fresh"))
    for words, said in commands:
        done = subprocess.run(
            processes.python_command("-m", "recon_cli", *words), cwd=tmp_path, env=environment,
            capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        assert said in done.stdout + done.stderr
    assert (tmp_path / "workspace" / "ingest" / "manifest.json").is_file()
