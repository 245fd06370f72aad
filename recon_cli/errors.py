"""The errors that a user can act on, each with its exit code, and the commands that they name.

Programming mistakes stay ValueError or AssertionError and leave the CLI with exit code 1.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import KW_ONLY, dataclass
from enum import IntEnum
from pathlib import Path
from typing import ClassVar

# Environment variable with the verb that was typed and `-w DIR`, where that must be typed again.
# Processes that recon starts inherit it, so that their messages name the workspace as well.
IN_USE = "RECON_IN_USE"
WITHOUT_WORKSPACE = ("batch", "bench", "convert", "info", "setup", "study")

MOST_CHARACTERS = 200  # of a value or path that a message repeats
MOST_NAMED = 5  # things that a message lists, where a record or a log has all


class ExitCode(IntEnum):
    """Exit codes of every command; docs/scripts.md."""

    DONE = 0
    BUG = 1
    USAGE = 2
    INPUT = 3
    STAGE = 4
    RECONSTRUCTION = 5
    BACKEND = 6
    WORKSPACE = 7
    SIGNAL = 128  # plus the number of the signal that ended it, as in a shell
    HANGUP = 129
    INTERRUPTED = 130
    KILLED = 137
    BROKEN_PIPE = 141
    TERMINATED = 143


def use_workspace(verb: str, workspace: Path | None) -> None:
    """Names the verb and the workspace that `name_command` has in mind from here on."""
    usual = os.environ.get("RECON_WORKSPACE") or "workspace"
    is_named = workspace is not None and os.path.abspath(workspace) != os.path.abspath(usual)
    os.environ[IN_USE] = f"{verb} -w {shlex.quote(str(workspace))}" if is_named else verb


def command_line(words: str) -> str:
    """Returns `recon WORDS` as it must be typed where the user works: with -w if that is needed.

    Who types `recon run` is told to run, not to ingest, another input.
    """
    verb, _, rest = words.partition(" ")
    typed, _, workspace = os.environ.get(IN_USE, "").partition(" ")
    if verb == "ingest" and typed == "run" and rest and not rest.startswith("-"):
        words = f"run {rest}"
    ending = f" {workspace}" if workspace and verb not in WITHOUT_WORKSPACE else ""
    return f"recon {words}{ending}"


def name_command(words: str) -> str:
    """Returns `command_line` in backticks, for a message."""
    return f"`{command_line(words)}`"


@dataclass(frozen=True)
class Hint:
    """A command of recon to type; as text, a sentence."""

    verb: str
    words: str = ""  # options and arguments, as they are typed
    _: KW_ONLY
    again: bool = False  # from nothing, although there is a result
    then: str = ""  # how the sentence continues

    def __str__(self) -> str:
        words = filter(None, (self.verb, self.words, "--again" * self.again))
        return f"Run {name_command(' '.join(words))}{self.then}."


class ReconError(Exception):
    """A failure that the user can act on; `hint` names the command to type or the change."""

    exit_code: ExitCode = ExitCode.BUG
    # of a class whose members all call for the same; others give one each
    usual_hint: ClassVar[str | Hint] = ""

    def __init__(self, message: str, *, hint: str | Hint = "") -> None:
        super().__init__(message)
        self.message = message
        self.hint = str(hint or self.usual_hint)


class ConfigError(ReconError):
    """An option or a configuration file holds a value that cannot be used."""

    exit_code = ExitCode.USAGE


class InputError(ReconError):
    """The capture cannot be read or does not hold enough."""

    exit_code = ExitCode.INPUT


class StageError(ReconError):
    """A stage needs the result of another one that is missing or stale."""

    exit_code = ExitCode.STAGE


class ReconstructionError(ReconError):
    """The input was read, but gave no reconstruction that can be trusted."""

    exit_code = ExitCode.RECONSTRUCTION


class SfmError(ReconstructionError):
    """Structure from motion found no usable cameras."""


class TrainingError(ReconstructionError):
    """Training diverged or has nothing to fit, or not enough memory."""


class BackendError(ReconError):
    """The rasterizer or device that was asked for is not available."""

    exit_code = ExitCode.BACKEND


class WorkspaceError(ReconError):
    """The workspace cannot be read, written or locked."""

    exit_code = ExitCode.WORKSPACE


class ManifestError(WorkspaceError):
    """A manifest is truncated, edited by hand, or of an unknown version."""

    usual_hint = Hint("status", then=", and the damaged stages again with --again")


class FormatError(InputError):
    """A file does not conform to its format."""

    usual_hint = "Copy the file again, or write it anew with the program that made it."


def list_names(names: Sequence[str], most: int = MOST_NAMED) -> str:
    """Returns the first names and the number of the others."""
    more = len(names) - most
    return ", ".join(names[:most]) + (f" and {more} more" if more > 0 else "")


def format_count(number: int, noun: str) -> str:
    """Returns a number with its noun in singular or plural."""
    ending = "" if number == 1 else "es" if noun.endswith(("ch", "x")) else "s"
    return f"{number:,} {noun}{ending}"


def causes(error: BaseException) -> Iterator[BaseException]:
    """Yields an error, its cause, and so on."""
    at: BaseException | None = error
    while at is not None:
        yield at
        at = at.__cause__ or (None if at.__suppress_context__ else at.__context__)
