"""How work reports its progress (protocol, bars, lines, null), and how times and sizes are written.

On a terminal there are bars; elsewhere records of the logger `recon.progress`, which become lines.
"""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol

from tqdm import tqdm

RECORD_SECONDS = 0.5  # a person sees no difference, and a flush to disk costs nothing at this pace
LINE_SECONDS = 20.0  # between two lines of a stage

logger = logging.getLogger("recon.progress")
logger.propagate = False  # the log of a workspace tells of events alone


class Bar(Protocol):
    """One piece of work whose length is known."""

    def advance(self, steps: int = 1) -> None:
        """Counts `steps` more units as done."""

    def note(self, text: str) -> None:
        """Shows `text` beside the bar (loss, count, the file at hand)."""


class Progress(Protocol):
    """Opens bars; the layers below the CLI know nothing else about terminals."""

    def bar(
        self, label: str, total: int, *, unit: str = "it", done: int = 0
    ) -> AbstractContextManager[Bar]:
        """Returns a context manager that yields a `Bar` already at `done` of `total`."""


class _NullBar:
    def advance(self, steps: int = 1) -> None:
        """Ignores the step."""

    def note(self, text: str) -> None:
        """Ignores the text."""


class NullProgress:
    """Shows nothing: for tests and for use as a library."""

    @contextmanager
    def bar(
        self, label: str, total: int, *, unit: str = "it", done: int = 0  # noqa: ARG002
    ) -> Iterator[Bar]:
        """Yields a bar that ignores everything."""
        yield _NullBar()


# of a bar of percent, whose count and rate would say nothing more
_PERCENT = "{l_bar}{bar}| {elapsed}<{remaining}{postfix}"


class _TqdmBar:
    def __init__(self, bar: tqdm) -> None:
        self._bar = bar

    def advance(self, steps: int = 1) -> None:
        with tqdm.get_lock():  # threads may report at once
            self._bar.update(steps)

    def note(self, text: str) -> None:
        self._bar.set_postfix_str(text, refresh=False)


class _Pace:
    """The stage that runs, and when its next line is due: the first at once."""

    def __init__(self) -> None:
        self.stage = ""
        self._next = float("-inf")
        self._lock = threading.Lock()

    def begin(self, stage: str) -> None:
        """Names the stage that all lines are of from here on."""
        with self._lock:
            self.stage, self._next = stage, float("-inf")

    def is_due(self) -> bool:
        """Returns whether a line may be written now, and then counts it as written."""
        with self._lock:
            now = time.monotonic()
            if now < self._next:
                return False
            self._next = now + LINE_SECONDS
            return True


_pace = _Pace()


@contextmanager
def in_stage(name: str) -> Iterator[None]:
    """Names the stage that the block runs, in each record of progress."""
    before = _pace.stage
    _pace.begin(name)
    logger.debug("begins", extra={"event": "start", "stage": name})
    try:
        yield
    finally:
        _pace.begin(before)


def current_stage() -> str:
    """Returns the name of the stage that runs; empty outside of one."""
    return _pace.stage


class _LineBar:
    """Writes how far the work is: at its beginning and while it advances, where a line is due."""

    def __init__(self, label: str, total: int, unit: str, done: int) -> None:
        self._label, self._total, self._unit = label, total, unit
        self._done = self._first = done
        self._begin = time.monotonic()
        self._text = ""
        self._lock = threading.Lock()  # threads may report at once
        self._write()

    def advance(self, steps: int = 1) -> None:
        with self._lock:
            self._done += steps
        self._write()

    def note(self, text: str) -> None:
        self._text = text

    def _write(self) -> None:
        if not _pace.is_due():
            return
        share = f"{100 * self._done // max(1, self._total)}%"
        count = share if self._unit == "%" else f"{self._done}/{self._total} ({share})"
        steps, left = self._done - self._first, self._total - self._done
        seconds = (time.monotonic() - self._begin) * left / steps if steps > 0 else 0.0
        remaining = f", {format_duration(seconds)} left" if seconds > 0 else ""
        text = f": {self._text}" if self._text else ""
        label = "" if self._label == _pace.stage else f"{self._label} "
        logger.info("%s%s%s%s", label, count, remaining, text, extra={
            "event": "progress", "stage": _pace.stage, "done": self._done, "total": self._total})


def _is_terminal() -> bool:
    return sys.stderr.isatty()


_uses_bars: Callable[[], bool] = _is_terminal


def choose_bars(uses_bars: Callable[[], bool] = _is_terminal) -> None:
    """Draws bars where the function says so from here on; by default on a terminal."""
    global _uses_bars
    _uses_bars = uses_bars


@contextmanager
def hide_bars() -> Iterator[None]:
    """Hides the bars of a terminal while something is written, and draws them again below it."""
    if not _uses_bars():
        yield
        return
    with tqdm.external_write_mode(file=sys.stderr):
        yield


class TqdmProgress:
    """Bars on stderr; a line every 20 seconds where stderr is not a terminal."""

    @contextmanager
    def bar(self, label: str, total: int, *, unit: str = "it", done: int = 0) -> Iterator[Bar]:
        """Yields a bar that is closed on leaving."""
        if not _uses_bars():
            yield _LineBar(label, total, unit, done)
            return
        with tqdm(
            desc=label, total=total, unit=unit, initial=done, file=sys.stderr,
            mininterval=0.2, dynamic_ncols=True, bar_format=_PERCENT if unit == "%" else None,
        ) as bar:
            yield _TqdmBar(bar)


def limit_rate(record: Callable[[int, int], None]) -> Callable[[int, int], None]:
    """Returns a function that records what is done, of a total, at most twice a second."""
    last = float("-inf")

    def limited(done: int, total: int) -> None:
        nonlocal last
        if done == total or time.monotonic() - last >= RECORD_SECONDS:
            last = time.monotonic()
            record(done, total)

    return limited


def format_duration(seconds: float) -> str:
    """Returns seconds as a person says them: 8.2 s, 4 min 10 s, 1 h 05 min."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"


def format_megabytes(size: int) -> str:
    """Returns a number of bytes in MB."""
    return f"{size / 1e6:.1f} MB"
