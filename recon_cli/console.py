"""What appears on stderr: the log, plain, notices marked as such, and errors with their hints."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import TextIO

import click

logger = logging.getLogger("recon")


class _Plain(logging.Formatter):
    """Marks what must not be missed; everything else is told as it is."""

    def format(self, record: logging.LogRecord) -> str:
        """Returns the message, after `notice:` where it is a warning."""
        text = super().format(record)
        return f"notice: {text}" if record.levelno >= logging.WARNING else text


class _Beside(logging.StreamHandler[TextIO]):
    """Writes on stderr where something else may be drawn, which makes way meanwhile."""

    def __init__(self, aside: Callable[[], AbstractContextManager[None]]) -> None:
        super().__init__()
        self._aside = aside

    def emit(self, record: logging.LogRecord) -> None:
        """Writes a record on a line of its own."""
        with self._aside():
            super().emit(record)


def show_log(
    *, detailed: Callable[[], bool],
    aside: Callable[[], AbstractContextManager[None]] = nullcontext,
) -> logging.Handler:
    """Shows the log on stderr and returns the handler, to be removed at the end.

    Args:
        detailed: whether debug messages are shown too; asked anew for each of them, because the
            log is there before the command line has been read.
        aside: lets progress bars make way while a message is written.
    """
    handler = _Beside(aside)
    handler.setFormatter(_Plain())
    handler.addFilter(lambda record: record.levelno >= logging.INFO or detailed())
    logger.addHandler(handler)
    logger.setLevel(logging.DEBUG)
    return handler


def complain(message: str, hint: str) -> None:
    """Prints an error and what to type next."""
    click.echo(f"error: {message}", err=True)
    if hint:
        click.echo(f"hint: {hint}", err=True)


def usage_hint(error: click.ClickException) -> str:
    """Returns where the verb that was typed is explained; empty where none was."""
    ctx = error.ctx if isinstance(error, click.UsageError) else None
    return f"See `{ctx.command_path} --help`." if ctx else ""
