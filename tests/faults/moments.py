"""Moments in the work of a command: the n-th time that it changes a file.

Counted over all of its processes, so that a fault can strike between any two renames, and strikes
at the same moment again when it is repeated.
"""

from __future__ import annotations

import mmap
import os
import select
import signal
import struct
import sys
from collections.abc import Callable
from pathlib import Path

_CHANGES = {"os.rename", "os.remove", "os.rmdir", "os.mkdir", "os.link", "os.symlink",
            "os.truncate", "shutil.rmtree"}
_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT


class Moments:
    """Counts the changes below a folder by the process that calls `watch` and those it forks."""

    def __init__(self, root: Path) -> None:
        self._root = os.fsencode(root)
        self._shared = mmap.mmap(-1, 8)

    @property
    def count(self) -> int:
        """How many there were."""
        return int(struct.unpack("q", self._shared[:8])[0])

    def watch(self, at: int | None = None, act: Callable[[int], None] | None = None) -> None:
        """Counts from now on, in this process; calls act(its number) at the `at`-th moment."""
        process = os.getpid()

        def see(event: str, arguments: tuple[object, ...]) -> None:
            if event != "open" and event not in _CHANGES:
                return
            if event == "open" and not (
                    isinstance(arguments[2], int) and arguments[2] & _WRITES):
                return
            path = arguments[0]
            if not isinstance(path, (str, bytes, os.PathLike)):
                return
            if not os.path.abspath(os.fsencode(path)).startswith(self._root):
                return
            number = self.count + 1
            self._shared[:8] = struct.pack("q", number)
            if number == at and act is not None:
                act(process)

        sys.addaudithook(see)


def sending(number: signal.Signals) -> Callable[[int], None]:
    """Returns the act that sends a signal to the command."""
    return lambda process: os.kill(process, number)


class Gate:
    """Stops a command at a moment until it is let through."""

    def __init__(self) -> None:
        self._reached, self._there = os.pipe()
        self._open, self._go = os.pipe()
        self.descriptors = {self._reached, self._there, self._open, self._go}

    def hold(self, _process: int) -> None:
        """Waits in the command; an act for `Moments.watch`."""
        os.write(self._there, b"x")
        os.read(self._open, 1)

    def reached(self, limit: float) -> bool:
        """Returns whether the command comes here within so many seconds."""
        return bool(select.select([self._reached], [], [], limit)[0])

    def let_through(self) -> None:
        """Lets the command continue, whether it waits already or not."""
        os.write(self._go, b"x")

    def close(self) -> None:
        """Frees what the gate is made of."""
        for descriptor in self.descriptors:
            os.close(descriptor)
