"""The log, errors and hints that every command prints on stderr."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable
from typing import TextIO

import click

from recon_cli.progress import hide_bars

logger = logging.getLogger("recon")


class _NoticeFormatter(logging.Formatter):
    """Puts `notice:` before warnings and completes their commands; the rest stays as it is."""

    def __init__(self, complete: Callable[[str], str]) -> None:
        super().__init__()
        self._complete = complete

    def format(self, record: logging.LogRecord) -> str:
        """Returns the message, after `notice:` where it is a warning."""
        text = super().format(record)
        return f"notice: {self._complete(text)}" if record.levelno >= logging.WARNING else text


class _BarAwareHandler(logging.StreamHandler[TextIO]):
    """Writes on stderr, where progress bars are hidden meanwhile."""

    def emit(self, record: logging.LogRecord) -> None:
        """Writes a record on a line of its own."""
        with hide_bars():
            super().emit(record)


def show_log(
    *, detailed: Callable[[], bool], complete: Callable[[str], str] = str
) -> logging.Handler:
    """Shows the log on stderr, debug messages where `detailed()`, and returns the handler.

    `complete` completes the commands in notices (see `hints.name_workspace`).
    """
    handler = _BarAwareHandler()
    handler.setFormatter(_NoticeFormatter(complete))
    handler.addFilter(lambda record: record.levelno >= logging.INFO or detailed())
    logger.addHandler(handler)
    logger.setLevel(logging.DEBUG)
    return handler


def print_error(message: str, hint: str) -> None:
    """Prints an error and the hint."""
    click.echo(f"error: {message}", err=True)
    if hint:
        click.echo(f"hint: {hint}", err=True)


def usage_hint(error: click.ClickException) -> str:
    """Returns which --help explains the verb that was typed; empty where none was."""
    ctx = error.ctx if isinstance(error, click.UsageError) else None
    return f"See `{ctx.command_path} --help`." if ctx else ""


def silence() -> None:
    """Drops pending output: the reader of stdout or stderr is gone."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except BrokenPipeError:
            os.dup2(nowhere, stream.fileno())
