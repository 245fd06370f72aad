"""What the command line prints about results: one line a stage, the status table, the doctor."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, TextIO

import click

from recon_cli.commands.doctor import Findings
from recon_cli.evaluation.tables import format_duration
from recon_cli.pipeline.plan import StageStatus

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


def summary_line(stage: str, summary: Mapping[str, Any], seconds: float | None = None) -> str:
    """Returns a stage's summary on one line: numbers and words, no lists, nothing that is empty."""
    parts = [
        f"{name.replace('_', ' ')} {_shown(value)}" for name, value in summary.items()
        if value is not None and value != "" and not isinstance(value, (list, dict))
    ]
    text = f"{stage}: {', '.join(parts)}" if parts else stage
    return text if seconds is None else f"{text} ({format_duration(seconds)})"


def _shown(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    return f"{value:.4g}" if isinstance(value, float) else str(value)






def status_table(stages: Sequence[StageStatus]) -> str:
    """Returns stage, state, time, and what is worth knowing, one line a stage."""
    rows = [("stage", "state", "time", "")]
    for one in stages:
        state = f"partial ({one.how_far})" if one.state == "partial" else one.state
        told = "; ".join(one.reasons)
        if not told and one.summary:
            told = summary_line("", one.summary).removeprefix(": ")
        time = "" if one.seconds is None else format_duration(one.seconds)
        rows.append((one.name, state, time, told))
    widths = [max(len(row[column]) for row in rows) for column in range(3)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, [*widths, 0], strict=True))
             for row in rows]
    return "\n".join(line.rstrip() for line in lines)


def doctor_text(found: Findings) -> str:
    """Returns the doctor's findings, one line each."""
    lines = [f"{name:<13} {version}" for name, version in found.versions.items()]
    lines.append(f"{'device':<13} {found.device}")
    for backend in found.backends:
        state = f"missing: {backend.missing}" if backend.missing else (
            "runs on " + ", ".join(backend.devices))
        lines.append(f"{'backend':<13} {backend.name}: {state}")
    writable = "writable" if found.writable else "NOT writable"
    lines += [
        f"{'cores':<13} {found.cores}",
        f"{'memory':<13} {found.memory_free_bytes / 1e9:.1f} GB free of "
        f"{found.memory_total_bytes / 1e9:.1f} GB",
        f"{'disk':<13} {found.disk_free_bytes / 1e9:.1f} GB free",
        f"{'workspace':<13} {found.workspace} ({writable})",
    ]
    return "\n".join(lines)
