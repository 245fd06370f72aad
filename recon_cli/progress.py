"""How work reports its progress (protocol, tqdm, null), and how times and sizes are written."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol

from tqdm import tqdm


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


@contextmanager
def hide_bars() -> Iterator[None]:
    """Hides the bars of a terminal while something is written, and draws them again below it."""
    if not sys.stderr.isatty():
        yield
        return
    with tqdm.external_write_mode(file=sys.stderr):
        yield


class TqdmProgress:
    """Bars on stderr; one line every 20 seconds where stderr is not a terminal."""

    @contextmanager
    def bar(self, label: str, total: int, *, unit: str = "it", done: int = 0) -> Iterator[Bar]:
        """Yields a tqdm bar that is closed on leaving."""
        interval = 0.2 if sys.stderr.isatty() else 20.0
        with tqdm(
            desc=label, total=total, unit=unit, initial=done, file=sys.stderr,
            mininterval=interval, maxinterval=max(10.0, interval), dynamic_ncols=True,
            bar_format=_PERCENT if unit == "%" else None,
        ) as bar:
            yield _TqdmBar(bar)


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
