"""The log, errors and hints that every command prints on stderr."""

from __future__ import annotations

import dataclasses
import logging
import os
import sys
from collections.abc import Callable
from typing import TextIO

import click

from recon_cli.config.settings import SECTIONS
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


class HintedUsageError(click.UsageError):
    """A wrong command line, with what to type instead."""

    def __init__(self, message: str, *, hint: str) -> None:
        super().__init__(message)
        self.hint = hint


def usage_hint(error: click.ClickException) -> str:
    """Returns what to type instead, or which --help explains the verb; empty where none was."""
    if isinstance(error, HintedUsageError):
        return error.hint
    if isinstance(error, click.NoSuchOption):
        found = _setting(error)
        if found:
            return found
    ctx = error.ctx if isinstance(error, click.UsageError) else None
    return f"See `{ctx.command_path} --help`." if ctx else ""


def _setting(error: click.NoSuchOption) -> str:
    """Returns how an option of a stage is set in a verb that runs many; empty where it has none."""
    if error.ctx is None or not any(
            parameter.name == "assigned" for parameter in error.ctx.command.params):
        return ""
    name = error.option_name.lstrip("-").replace("-", "_")
    sections = [section for section, config in SECTIONS.items()
                if name in {item.name for item in dataclasses.fields(config)}]
    if not sections:
        return ""
    ways = " or ".join(f"--set {section}.{name}=VALUE" for section in sections)
    return f"{error.ctx.command_path} sets it by {ways}."


def silence() -> None:
    """Drops pending output: the reader of stdout or stderr is gone."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except BrokenPipeError:
            os.dup2(nowhere, stream.fileno())
