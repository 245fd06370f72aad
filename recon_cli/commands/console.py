"""How every command talks: the log and errors on stderr, as text or JSON, and --json's object.

Text for people goes to stdout as before. A record of the log may carry an `event`: progress or
start (of a stage), of `recon_cli.progress`, or an `outcome`, of a stage that is done.
"""

from __future__ import annotations

import dataclasses
import io
import json
import logging
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, Any, TextIO

import click

from recon_cli import progress
from recon_cli.config.settings import GONE, SECTIONS, SUCCESSORS
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
    output: CapturedOutput | None = None  # what stdout would have got instead

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

    def __init__(self, style: Style, complete: Callable[[str], str]) -> None:
        super().__init__()
        self._style, self._complete = style, complete
        self.notices: list[str] = []
        self.outcomes: list[Outcome] = []
        self._shown: dict[str, list[float]] = {}  # when lines of each stage were written

    def emit(self, record: logging.LogRecord) -> None:
        """Writes a record on a line of its own; the outcome of a stage is a line of stdout."""
        outcome: Outcome | None = getattr(record, "outcome", None)
        if outcome:
            self.outcomes.append(outcome)
        elif record.levelno == logging.WARNING:
            self.notices.append(self._complete(record.getMessage()))
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
        text = self._complete(super().format(record))
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


@contextmanager
def show_log(style: Style, *, complete: Callable[[str], str] = str) -> Iterator[Log]:
    """Shows the log on stderr while the block runs.

    `complete` completes the commands in messages (see `hints.name_workspace`).
    """
    handler = Log(style, complete)
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


class CapturedOutput(io.StringIO):
    """Stands for stdout with --json: keeps the lines, and shows each in the log."""

    def write(self, text: str) -> int:
        """Keeps the text; lines that are complete are logged."""
        before = len(self.lines)
        written = super().write(text)
        for line in self.lines[before:]:
            progress.logger.info("%s", line, extra={"event": "output"})
        return written

    @property
    def lines(self) -> list[str]:
        """The complete lines."""
        return self.getvalue().split("\n")[:-1]


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


class HintedUsageError(click.UsageError):
    """A wrong command line, with what to type instead."""

    def __init__(self, message: str, *, hint: str, ctx: click.Context | None = None) -> None:
        super().__init__(message, ctx)
        self.hint = hint


def usage_hint(error: click.ClickException) -> str:
    """Returns what to type instead, or which --help explains the verb; empty where none was."""
    if isinstance(error, HintedUsageError):
        return error.hint
    if isinstance(error, click.NoSuchOption):
        found = _gone(error) or _setting(error)
        if found:
            return found
    ctx = error.ctx if isinstance(error, click.UsageError) else None
    return f"See `{ctx.command_path} --help`." if ctx else ""


def _gone(error: click.NoSuchOption) -> str:
    """Returns what to do about an option that earlier versions had; empty for any other."""
    name = error.option_name.lstrip("-").replace("-", "_")
    section = next((each for each, fields in GONE.items() if name in fields), None)
    if section is None:
        return ""
    instead = SUCCESSORS.get((section, name), "Leave it out.")
    return f"recon no longer has {error.option_name}. {instead}"


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


def drop_output() -> None:
    """Drops pending output where the reader of stdout or stderr is gone, or its disk is full."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, stream.fileno())
            os.close(nowhere)
