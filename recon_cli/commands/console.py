"""What every command prints on stderr: the log, errors and hints."""

from __future__ import annotations

import logging
import re
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import TextIO

import click

from recon_cli.progress import hide_bars

DEFAULT_WORKSPACE = Path("workspace")
_WITHOUT_WORKSPACE = ("batch", "bench", "study")

logger = logging.getLogger("recon")


class _NoticeFormatter(logging.Formatter):
    """Puts `notice:` before warnings; everything else is printed as it is."""

    def format(self, record: logging.LogRecord) -> str:
        """Returns the message, after `notice:` where it is a warning."""
        text = super().format(record)
        return f"notice: {text}" if record.levelno >= logging.WARNING else text


class _BarAwareHandler(logging.StreamHandler[TextIO]):
    """Writes on stderr, where progress bars are hidden meanwhile."""

    def emit(self, record: logging.LogRecord) -> None:
        """Writes a record on a line of its own."""
        with hide_bars():
            super().emit(record)


def show_log(*, detailed: Callable[[], bool]) -> logging.Handler:
    """Shows the log on stderr, debug messages where `detailed()`, and returns the handler."""
    handler = _BarAwareHandler()
    handler.setFormatter(_NoticeFormatter())
    handler.addFilter(lambda record: record.levelno >= logging.INFO or detailed())
    logger.addHandler(handler)
    logger.setLevel(logging.DEBUG)
    return handler


def print_error(message: str, hint: str) -> None:
    """Prints an error and what to type next."""
    click.echo(f"error: {message}", err=True)
    if hint:
        click.echo(f"hint: {hint}", err=True)


def name_workspace(hint: str, workspace: Path) -> str:
    """Returns a hint whose commands name the workspace, where that is not the default one."""
    if workspace == DEFAULT_WORKSPACE:
        return hint

    def complete(found: re.Match[str]) -> str:
        command, verb = found[1], found[2]
        if verb in _WITHOUT_WORKSPACE or re.search(r" (-w|--workspace)\b", command):
            return found[0]
        return f"`{command} -w {shlex.quote(str(workspace))}`"

    return re.sub(r"`(recon ([a-z]+)[^`]*)`", complete, hint)


def usage_hint(error: click.ClickException) -> str:
    """Returns which --help explains the verb that was typed; empty where none was."""
    ctx = error.ctx if isinstance(error, click.UsageError) else None
    return f"See `{ctx.command_path} --help`." if ctx else ""
