"""Runs recon commands in processes of this machine, or has `ray_executor` do it.

A command is one that a user could type. Its results lie in a workspace whose stages commit
atomically and resume: a retry is the same command, and only an exit code has to come back. Its
progress can be read in the workspace.
"""

from __future__ import annotations

import subprocess
import threading
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from filelock import FileLock, Timeout

from recon_cli import machine
from recon_cli.errors import ExitCode
from recon_cli.processes import CHILD, ask_to_end, start_module
from recon_cli.workspace.layout import LOCK

PROGRAM = "recon_cli"  # the module that is run
CORES = 4  # of a command where nothing is said; more shorten it by little
TRIES = 3  # of a command whose process is killed, by the system for want of memory or by somebody
_ENDED = (ExitCode.HANGUP, ExitCode.TERMINATED)  # by a signal that recon handles
# Within which a process that lost its parent is gone, one that is stopped has saved its checkpoint,
# and a busy machine answers.
PATIENCE_SECONDS = 60.0


class _NeedsGpu(dict[str, bool | None]):
    """Whether a command needs a GPU, by --device; None: if a machine has one."""

    def __missing__(self, _device: str) -> bool:
        return True  # cuda:N


NEEDS_GPU = _NeedsGpu({"auto": None, "cpu": False, "cuda": True})


@dataclass(frozen=True)
class Command:
    """One `recon` command on one workspace; paths are absolute."""

    words: tuple[str, ...]  # after `recon`
    workspace: Path
    log: Path  # for its output; replaced by each call


class Executor(Protocol):
    """Runs commands somewhere; `run` may be called by `slots` threads at once."""

    slots: int

    def run(self, command: Command) -> int:
        """Runs a command until it ends and returns its exit code; 128 + n for a signal n.

        Raises:
            BackendError: the machines cannot be reached any more.
        """

    def stop(self) -> None:
        """Interrupts the commands: each saves its checkpoint, and `run` returns 130."""

    def close(self) -> None:
        """Lets the machines go."""


class LocalExecutor:
    """Runs up to `slots` commands at once in processes of this machine."""

    def __init__(self, slots: int) -> None:
        self.slots = slots
        self._running: set[RunningCommand] = set()
        self._lock = threading.Lock()
        self._stopped = False

    def run(self, command: Command) -> int:
        """Runs a command until it ends and returns its exit code; see `Executor`."""
        running = RunningCommand(command)
        with self._lock:
            if self._stopped:
                return ExitCode.INTERRUPTED
            self._running.add(running)
        try:
            return running.wait()
        finally:
            with self._lock:
                self._running.discard(running)

    def stop(self) -> None:
        """Interrupts the commands; see `Executor`."""
        with self._lock:
            self._stopped = True
            for running in self._running:
                running.interrupt()

    def close(self) -> None:
        """Does nothing: no process outlives `run`."""


class RunningCommand:
    """A command in a process of this machine, which ends when this process does."""

    def __init__(self, command: Command) -> None:
        self._command = command
        self._stopped = threading.Event()
        self._process: subprocess.Popen[bytes] | None = None

    def wait(self) -> int:
        """Runs the command until it ends by itself, three times at most; returns its exit code."""
        code = 0
        for _ in range(TRIES):
            code = ExitCode.INTERRUPTED if self._stopped.is_set() else self._run_once()
            if code >= 0 and code not in _ENDED:
                return code
        return code if code > 0 else ExitCode.SIGNAL - code

    def interrupt(self) -> None:
        """Has the command save its work and end; `wait` returns 130."""
        self._stopped.set()
        process = self._process
        if process is not None:
            ask_to_end(process)
            timer = threading.Timer(PATIENCE_SECONDS, process.kill)
            timer.daemon = True
            timer.start()

    def _run_once(self) -> int:
        """Returns the exit code, negative for a signal."""
        command = self._command
        command.log.parent.mkdir(parents=True, exist_ok=True)
        if command.workspace.is_dir():
            _wait_until_free(command.workspace)
        # A session of its own: Ctrl-C is passed on by `interrupt`, once.
        with command.log.open("wb") as log, start_module(
            PROGRAM, *command.words, folder=command.log.parent, out=log, errors=subprocess.STDOUT,
            session=True, **{CHILD: "1"},
        ) as process:
            self._process = process
            if self._stopped.is_set():
                self.interrupt()
            try:
                code = process.wait()
                ended = code < 0 or code in _ENDED
                return ExitCode.INTERRUPTED if ended and self._stopped.is_set() else code
            finally:
                self._process = None
                process.kill()  # where this thread is interrupted itself


def start_executor(
    place: str, folder: Path, *, inputs: Sequence[Path] = (), slots: int | None = None,
    cores: int | None = None, gpu: bool | None = None,
) -> tuple[Executor, int]:
    """Returns the executor of commands on `folder`, and how many threads each command has.

    `place` is "local" or "ray". None: as many commands at once, and as many cores for each of them,
    as suit the machines; a GPU if they have one.

    Raises:
        BackendError: no Ray cluster was found, or it lacks resources for a command.
        WorkspaceError: a machine of it does not see `folder` or one of `inputs`.
    """
    if place == "ray":
        from recon_cli.jobs.ray_executor import RayExecutor

        executor = RayExecutor.connect(
            cores=cores, gpu=gpu, slots=slots, folder=folder.absolute(),
            inputs=[path.absolute() for path in inputs])
        return executor, executor.cores
    usable = machine.usable_threads()
    slots = slots or max(1, usable // (cores or CORES))
    return LocalExecutor(slots), cores or max(1, usable // slots)


def _wait_until_free(workspace: Path) -> None:
    """Waits for a process whose parent was killed: it ends, but not at once.

    A process that holds the workspace for longer is somebody else's; the command says so.
    """
    lock = FileLock(workspace / LOCK)
    with suppress(Timeout):
        lock.acquire(timeout=PATIENCE_SECONDS)
        lock.release()
