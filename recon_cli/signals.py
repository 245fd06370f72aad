"""Signals that end a command: Ctrl-C, SIGTERM (docker stop, timeout, systemd) and SIGHUP.

Windows has no SIGHUP; Ctrl-Break and the end of a console stand for SIGTERM there.

The first one raises `Interrupted` in the main thread, so that unfinished work is saved and
children end. Programs such as `timeout` send it twice, so another one counts only a while later: it
ends the process at once, and with it its children, whose standard input ends.
"""

from __future__ import annotations

import ctypes
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from types import FrameType

from recon_cli.errors import ExitCode

NUMBERS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")
    if hasattr(signal, name))
_BREAK: int | None = getattr(signal, "SIGBREAK", None)  # of Windows
_TWICE_SECONDS = 1.0  # within which signals are one
_SIGACTION_BYTES = 1024  # more than a struct sigaction has on any system


class Interrupted(KeyboardInterrupt):
    """A signal asked this process to end."""

    def __init__(self, number: int = signal.SIGINT) -> None:
        super().__init__()
        self.number = number


def exit_code(error: BaseException | None) -> int:
    """Returns the exit code for an interruption: 130 for Ctrl-C, 143 for SIGTERM."""
    return ExitCode.SIGNAL + (error.number if isinstance(error, Interrupted) else signal.SIGINT)


def describe_end(error: BaseException | None) -> str:
    """Returns the line that says why a command ended, and how to continue."""
    number = exit_code(error) - ExitCode.SIGNAL
    reason = "interrupted" if number == signal.SIGINT else f"ended by {signal.Signals(number).name}"
    return f"{reason}; run the same command again to resume"


class _Watch:
    """The signals received so far."""

    def __init__(self) -> None:
        self.number = 0  # of the first one
        self.deferred = False  # the first one is asked for, and raises nothing
        self._last = float("-inf")

    def handle(self, number: int, _frame: FrameType | None) -> None:
        """Raises Interrupted for the first signal; ends the process by a later one."""
        number = signal.SIGTERM if number == _BREAK else number
        again = time.monotonic() - self._last < _TWICE_SECONDS
        self._last = time.monotonic()
        if self.number and again:
            return
        if self.number and not self.deferred:
            os._exit(ExitCode.SIGNAL + number)
        if not self.number and self.deferred:
            self.number = number
            return
        self.number, self.deferred = number, False
        raise Interrupted(number)


_watch: _Watch | None = None  # of the running command


@contextmanager
def raising(*, restore: bool = True) -> Iterator[None]:
    """Raises Interrupted in the block where a signal asks this process to end.

    Signals that are ignored, as nohup has it, stay so. Without `restore` they are ignored when the
    block is left: what remains is the end of the process, in the midst of which Python would give
    them back their default action, and with it another exit code to a command that is done.
    """
    global _watch
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    if _watch is not None:
        with _naming_the_signal(_watch):
            yield
        return
    _watch = _Watch()
    before = {number: signal.getsignal(number) for number in NUMBERS}
    before = {number: handler for number, handler in before.items()
              if handler not in (signal.SIG_IGN, None)}
    for number in before:
        signal.signal(number, _watch.handle)
    try:
        with _naming_the_signal(_watch):
            yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler if restore else signal.SIG_IGN)
        _watch = None


@contextmanager
def _naming_the_signal(watch: _Watch) -> Iterator[None]:
    """Raises Interrupted in place of what a native module says that a signal met in its import."""
    try:
        yield
    except (ImportError, SystemError) as error:
        if not watch.number or watch.deferred:
            raise
        raise Interrupted(watch.number) from error


@contextmanager
def deferring() -> Iterator[Callable[[], int]]:
    """Yields which signal asked to end, 0 for none, so that no step is cut; a later one cuts."""
    if threading.current_thread() is not threading.main_thread():
        yield lambda: 0
        return
    with raising():
        watch = _watch
        assert watch is not None
        watch.deferred = True
        try:
            yield lambda: watch.number
        finally:
            pending, watch.deferred = watch.deferred and watch.number, False
        if pending:  # it came after the last look
            raise Interrupted(pending)


def leave_to_parent() -> None:
    """Ignores the signals in a child that ends with its parent, to which they are sent too."""
    for number in NUMBERS:
        signal.signal(number, signal.SIG_IGN)


@contextmanager
def keeping_handlers() -> Iterator[None]:
    """Puts back the handlers that a library replaces when it is imported or started.

    Native code replaces them behind Python's back, perhaps in a thread, where Python sets none.
    """
    handlers = {number: signal.getsignal(number) for number in NUMBERS}
    with _keeping_actions() if os.name == "posix" else nullcontext():
        try:
            yield
        finally:
            if threading.current_thread() is threading.main_thread():
                for number, handler in handlers.items():
                    if handler is not None:
                        signal.signal(number, handler)


@contextmanager
def _keeping_actions() -> Iterator[None]:
    """Puts back what the system does at each signal; only POSIX lets any thread do so."""
    libc = ctypes.CDLL(None)
    actions = {number: ctypes.create_string_buffer(_SIGACTION_BYTES) for number in NUMBERS}
    for number, action in actions.items():
        libc.sigaction(number, None, action)
    try:
        yield
    finally:
        for number, action in actions.items():
            libc.sigaction(number, action, None)
