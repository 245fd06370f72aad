"""How every command talks: the log and errors on stderr, as text or JSON, and --json's object.

A record of the log may carry an `event`: progress or start (of a stage), of `recon_cli.progress`,
output (with --json, a line of `say`), or an `outcome`, of a stage that is done.
"""

from __future__ import annotations

import json
import logging
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from typing import TYPE_CHECKING, Any, TextIO

import click

from recon_cli import progress
from recon_cli.errors import ExitCode
from recon_cli.progress import hide_bars

if TYPE_CHECKING:
    from recon_cli.pipeline.plan import Outcome

LOG_FORMATS = ("auto", "bars", "lines", "json")
_MOST_LINES = 4  # of a stage in a minute, without notices
_MINUTE = 60.0

logger = logging.getLogger("recon")


@dataclass
class Style:
    """How a command talks, as -v, -q, --log-format and --json say."""

    verbose: bool = False
    quiet: bool = False
    log_format: str = "auto"
    as_object: bool = False  # stdout gets one JSON object and nothing else
    output: list[str] = field(default_factory=list)  # lines that stdout would have got instead

    @property
    def form(self) -> str:
        """The format of the log, chosen by whether stderr is a terminal: bars, lines or json."""
        if self.log_format != "auto":
            return self.log_format
        return "bars" if sys.stderr.isatty() else "lines"


@dataclass(frozen=True)
class Failure:
    """Why a command ended without success."""

    message: str
    hint: str
    exit_code: int

    def text(self, *, prefix: str = "error: ") -> str:
        """Returns the lines that a person reads."""
        return f"{prefix}{self.message}" + (f"\nhint: {self.hint}" if self.hint else "")


class Log(logging.StreamHandler[TextIO]):
    """Writes records on stderr in the style of the command, and keeps what --json reports."""

    def __init__(self, style: Style) -> None:
        super().__init__()
        self._style = style
        self.notices: list[str] = []
        self.outcomes: list[Outcome] = []
        self._shown: dict[str, list[float]] = {}  # when lines of each stage were written

    def emit(self, record: logging.LogRecord) -> None:
        """Writes a record on a line of its own; the outcome of a stage is a line of stdout."""
        outcome: Outcome | None = getattr(record, "outcome", None)
        if outcome:
            self.outcomes.append(outcome)
        elif record.levelno == logging.WARNING:
            self.notices.append(record.getMessage())
        if not self._is_shown(record) or not (outcome or self._has_room(record)):
            return
        with hide_bars():
            if outcome and not self._style.as_object:
                click.echo(record.getMessage())
            if not outcome or self._style.as_object or self._style.form == "json":
                super().emit(record)

    def _is_shown(self, record: logging.LogRecord) -> bool:
        if self._style.quiet:
            return record.levelno >= logging.ERROR
        return record.levelno >= logging.INFO or self._style.verbose or (
            self._style.form == "json" and hasattr(record, "event"))

    def _has_room(self, record: logging.LogRecord) -> bool:
        """Returns whether a line is one of the few that a stage writes in a minute."""
        stage = progress.current_stage()
        if not stage or self._style.form != "lines" or self._style.verbose:
            return True
        times = [one for one in self._shown.get(stage, ()) if record.created - one < _MINUTE]
        fits = len(times) < _MOST_LINES or record.levelno >= logging.WARNING
        self._shown[stage] = [*times, record.created] if fits else times
        return fits

    def format(self, record: logging.LogRecord) -> str:
        """Returns a line of text or JSON; `notice:` stands before warnings."""
        text = super().format(record)
        stage = getattr(record, "stage", progress.current_stage())
        if self._style.form == "json":
            return _json_line(record.created, record.levelname.lower(), stage,
                              getattr(record, "event", "log"), text, record)
        text = f"notice: {text}" if record.levelno == logging.WARNING else text
        if self._style.form == "bars":
            return text
        named = f"{stage}: " if stage and hasattr(record, "event") else ""
        return f"{time.strftime('%Y-%m-%d %H:%M:%S', time.localtime(record.created))} {named}{text}"

    def fail(self, failure: Failure, *, prefix: str = "error: ") -> None:
        """Writes why the command failed; in text without a time, for these are its last lines."""
        if self._style.form == "json":
            extra = logging.makeLogRecord({"hint": failure.hint, "exit_code": failure.exit_code})
            click.echo(_json_line(
                time.time(), "error", "", "error", failure.message, extra), err=True)
        else:
            click.echo(failure.text(prefix=prefix), err=True)


def _json_line(
    created: float, level: str, stage: str, event: str, message: str, more: logging.LogRecord
) -> str:
    """Returns one line of --log-format json; docs/scripts.md names its fields."""
    fields: dict[str, Any] = {
        "time": datetime.fromtimestamp(created).astimezone().isoformat(timespec="milliseconds"),
        "level": level, "stage": stage or None, "event": event,
        "done": getattr(more, "done", None), "total": getattr(more, "total", None),
        "message": message}
    fields |= {name: getattr(more, name) for name in ("seconds", "hint", "exit_code")
               if hasattr(more, name)}
    return json.dumps(fields, ensure_ascii=False)


def say(text: str) -> None:
    """Prints a text on stdout; with --json its lines go into the object, and into the log."""
    call = click.get_current_context().ensure_object(Style)
    if not call.as_object:
        click.echo(text)
        return
    for line in text.split("\n"):
        call.output.append(line)
        progress.logger.info("%s", line, extra={"event": "output"})


@contextmanager
def show_log(style: Style) -> Iterator[Log]:
    """Shows the log on stderr while the block runs."""
    handler = Log(style)
    progress.choose_bars(lambda: style.form == "bars" and not style.quiet)
    loggers = (logger, progress.logger)
    for one in loggers:
        one.addHandler(handler)
        one.setLevel(logging.DEBUG)
    try:
        yield handler
    finally:
        for one in loggers:
            one.removeHandler(handler)
        progress.choose_bars()


def result_object(
    verb: str, workspace: str | None, log: Log, output: list[str], seconds: float,
    failure: Failure | None,
) -> str:
    """Returns the object of --json as text; docs/scripts.md names its fields."""
    fields: dict[str, Any] = {
        "verb": verb, "exit_code": failure.exit_code if failure else int(ExitCode.DONE),
        "workspace": workspace, "seconds": round(seconds, 3)}
    if failure:
        fields |= {"error": failure.message, "hint": failure.hint}
    stages = [{"name": outcome.stage, "ran": outcome.ran,
               "seconds": outcome.manifest.run.seconds, "summary": outcome.manifest.run.summary}
              for outcome in log.outcomes]
    files = [f"{outcome.stage.partition('.')[0]}/{name}" for outcome in log.outcomes if outcome.ran
             for name in outcome.manifest.outputs]
    return json.dumps({**fields, "stages": stages, "files": files, "notices": log.notices,
                       "output": output}, indent=1)


def drop_output() -> None:
    """Drops pending output where the reader of stdout or stderr is gone, or its disk is full."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, stream.fileno())
            os.close(nowhere)
