"""Runs `recon` commands in forked children of a process that has imported everything.

A start of Python and torch takes seconds, a fork milliseconds. Each command still is a process of
its own, so a crash, a hang, a signal and an exit code are seen as the user would see them. What the
command starts itself (`python -m recon_cli...`) is forked as well.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import gc
import importlib
import os
import resource
import runpy
import select
import signal
import subprocess
import sys
import time
import tomllib
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import cv2
import psutil
import pycolmap  # noqa: F401 - the mapping process is forked, too
import torch

from recon_cli import cli
from recon_cli.render import registry
from recon_cli.stages import IMPORT, STAGES

MEMORY_BYTES = 16 << 30  # of address space: what a hostile input asks for must not stop the machine
_PROJECT = Path(__file__).resolve().parents[2] / "pyproject.toml"
SCRIPT = tomllib.loads(_PROJECT.read_text())["project"]["scripts"]["recon"]  # module:function
_PROGRAM = "import sys; from {} import {} as main; sys.argv[0] = 'recon'; sys.exit(main())".format(
    *SCRIPT.split(":"))
_PIPE_BYTES = 1 << 20
_ORPHAN_SECONDS = 20.0  # for a child to notice the end of its parent: it may be importing still


@dataclass(frozen=True)
class Finished:
    """How a command ended."""

    words: tuple[str, ...]  # after `recon`
    code: int  # negative for a signal
    out: str
    err: str
    seconds: float
    timed_out: bool = False
    orphans: tuple[str, ...] = ()  # processes that outlived it
    memory_bytes: int = 0  # at its peak, beyond what it began with

    def __str__(self) -> str:
        how = "timed out" if self.timed_out else f"exit code {self.code}"
        return f"recon {' '.join(self.words)}: {how} in {self.seconds:.1f} s"


def preload() -> None:
    """Imports what commands need and compiles the kernels; starts no thread, for forks lose them.

    What imports this module has set OMP_NUM_THREADS=1 before.
    """
    for verb in cli.VERBS:
        cli.cli.get_command(click.Context(cli.cli), verb)
    late = ("recon_cli.flythrough.run", "recon_cli.report.build", "recon_cli.splats.registry")
    for module in (*(row.module for row in (*STAGES, IMPORT)), *late):
        importlib.import_module(module)
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    registry.prepare("numba", lambda: None)
    gc.freeze()  # else each child copies every page that its first collection marks


class Said:
    """The output of a command: a pipe with room for all of it, which no full disk stops."""

    def __init__(self) -> None:
        self._source, self.target = os.pipe()
        fcntl.fcntl(self.target, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)

    def read(self) -> str:
        """Returns what was printed; to be called once, when the command has ended."""
        os.close(self.target)
        os.set_blocking(self._source, False)  # something that outlives it may hold the other end
        data = b""
        with contextlib.suppress(BlockingIOError):
            while more := os.read(self._source, _PIPE_BYTES):
                data += more
        os.close(self._source)
        return data.decode(errors="replace")


@dataclass
class Running:
    """A command that runs."""

    words: tuple[str, ...]
    pid: int
    said: tuple[Said, Said]  # on stdout and stderr
    begin: float
    memory_bytes: int = 0  # that a forked one shares with the campaign

    def signal(self, number: int) -> None:
        """Sends a signal to the command, not to what it started."""
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, number)

    def wait(self, limit: float) -> bool:
        """Returns whether the command ends within so many seconds."""
        descriptor = os.pidfd_open(self.pid)
        try:
            poll = select.poll()
            poll.register(descriptor, select.POLLIN)
            return bool(poll.poll(max(0.0, limit) * 1000))
        finally:
            os.close(descriptor)

    def finish(self, limit: float) -> Finished:
        """Waits for the end; kills what takes longer, and whatever outlives the command."""
        timed_out = not self.wait(limit)
        if timed_out:
            os.kill(self.pid, signal.SIGKILL)
        _, status, usage = os.wait4(self.pid, 0)
        seconds = time.monotonic() - self.begin
        orphans = () if timed_out else tuple(_orphans())
        end_children()
        out, err = (stream.read() for stream in self.said)
        return Finished(self.words, os.waitstatus_to_exitcode(status), out, err, seconds,
                        timed_out, orphans, max(0, 1024 * usage.ru_maxrss - self.memory_bytes))


def start(
    words: Sequence[str], *, cwd: Path, prepare: Callable[[], None] | None = None
) -> Running:
    """Starts a command in a forked child; `prepare` is called in it before anything else."""
    sys.stdout.flush()
    sys.stderr.flush()
    said = Said(), Said()
    begin, pid = time.monotonic(), os.fork()
    if pid == 0:
        code = 1
        try:
            _enter(cwd, said)
            if prepare is not None:
                prepare()
            code = _run_entry_point(words)
        except BaseException:
            traceback.print_exc()
        finally:
            _leave(code)
    return Running(tuple(words), pid, said, begin, psutil.Process().memory_info().rss)


def start_process(
    words: Sequence[str], *, cwd: Path, flags: Sequence[str] = (),
    environment: Mapping[str, str] | None = None,
) -> Running:
    """Starts a command as the user would: a new process, with `flags` of Python."""
    said, begin = (Said(), Said()), time.monotonic()
    process = subprocess.Popen(
        [sys.executable, *flags, "-P", "-c", _PROGRAM, *words], cwd=cwd,
        env={**os.environ, **(environment or {})}, start_new_session=True,
        stdin=subprocess.DEVNULL, stdout=said[0].target, stderr=said[1].target)
    process.returncode = 0  # `finish` waits for it by its number
    return Running(tuple(words), process.pid, said, begin)


def _enter(cwd: Path, said: tuple[Said, Said]) -> None:
    """Makes the child look like a process that a shell started."""
    os.setsid()
    for number, descriptor in enumerate((
            os.open(os.devnull, os.O_RDONLY), said[0].target, said[1].target)):
        os.dup2(descriptor, number)
    # Those of the campaign may be files, and take it ill that they no longer are.
    sys.stdout, sys.stderr = (
        open(number, "w", encoding="utf-8", errors=errors, closefd=False)  # noqa: SIM115
        for number, errors in ((1, "strict"), (2, "backslashreplace")))
    os.chdir(cwd)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    subprocess.Popen = _ForkedPopen  # type: ignore[misc]


def _run_entry_point(words: Sequence[str]) -> int:
    """Runs what the script `recon` runs, and returns the exit code."""
    sys.argv = ["recon", *words]
    try:
        module, _, name = SCRIPT.partition(":")
        return _exit_code(getattr(importlib.import_module(module), name)())
    except SystemExit as end:
        return _exit_code(end.code)


def _exit_code(value: object) -> int:
    return value & 255 if isinstance(value, int) else int(value is not None)


def _leave(code: int) -> None:
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(Exception):
            stream.flush()
    os._exit(code)


class _ForkedPopen(subprocess.Popen[Any]):
    """Forks `python [-P] -m recon_cli.x.y` in place of starting it anew; anything else is started.

    So is a whole command of recon, which must find no traces of the one that starts it.
    """

    def __init__(self, args: Any, *more: Any, **options: Any) -> None:
        module, words = _module_of(args)
        if module:
            sys.stdout.flush()
            options["preexec_fn"] = lambda: _become(module, words, options.get("env"))
        super().__init__(args, *more, **options)


def _module_of(args: Any) -> tuple[str, list[str]]:
    """Returns the worker of ours that a command runs, and its arguments."""
    if not isinstance(args, (list, tuple)) or str(args[0]) != sys.executable or "-m" not in args:
        return "", []
    at = args.index("-m")
    module = str(args[at + 1])
    ours = module.startswith("recon_cli.")
    return (module if ours else "", [str(word) for word in args[at + 2:]])


def _become(module: str, words: list[str], environment: dict[str, str] | None) -> None:
    """Runs a module in place of the program that the child was to become."""
    for descriptor in set(range(3, 1024)) - kept:
        with contextlib.suppress(OSError):  # the end of one tells Popen that the program runs
            os.close(descriptor)
    gc.enable()
    if environment is not None:
        os.environ.clear()
        os.environ.update(environment)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, signal.default_int_handler if number == signal.SIGINT
                          else signal.SIG_DFL)
    for number in (signal.SIGPIPE, signal.SIGXFSZ):  # Python ignores them from its start on
        signal.signal(number, signal.SIG_IGN)
    sys.argv = [module, *words]
    code = 1
    try:
        runpy.run_module(module, run_name="__main__")
        code = 0
    except SystemExit as end:
        code = _exit_code(end.code)
    except BaseException:
        traceback.print_exc()
    finally:
        _leave(code)


def adopt_orphans() -> None:
    """Makes this process the parent of whatever its children leave behind (Linux)."""
    ctypes.CDLL(None).prctl(36, 1, 0, 0, 0)  # PR_SET_CHILD_SUBREAPER


def _orphans() -> Iterator[str]:
    """Yields the processes that are still there when they should have ended."""
    end = time.monotonic() + _ORPHAN_SECONDS
    while (alive := _children()) and time.monotonic() < end:
        time.sleep(0.02)
    for process in alive:
        with contextlib.suppress(psutil.Error):
            yield f"{process.pid} {process.status()}"


kept: set[int] = set()  # file descriptors that what a command starts needs for the campaign
# Commands that run beside the one that is waited for; they are nobody's orphans.
known: set[int] = set()


def _children() -> list[psutil.Process]:
    found = []
    for process in psutil.Process().children():
        with contextlib.suppress(psutil.Error):
            if process.pid in known:
                continue
            if process.status() == psutil.STATUS_ZOMBIE:
                with contextlib.suppress(ChildProcessError):
                    os.waitpid(process.pid, os.WNOHANG)
                continue
            found.append(process)
    return found


def end_children() -> None:
    """Ends whatever the commands left behind."""
    for process in _children():
        with contextlib.suppress(psutil.Error):
            process.kill()
            process.wait(5)
