"""The errors that a user can act on, each with its exit code.

Programming mistakes stay ValueError or AssertionError and leave the CLI with exit code 1.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from enum import IntEnum

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


class ReconError(Exception):
    """A failure that the user can act on; `hint` names the command to type or the change."""

    exit_code: ExitCode = ExitCode.BUG
    usual_hint = ""  # of a class whose members all call for the same; others give one each

    def __init__(self, message: str, *, hint: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint or self.usual_hint


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

    usual_hint = "Run the stage again with --again; `recon status` names those that are damaged."


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
