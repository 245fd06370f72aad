"""What the mapping process says to its parent: one JSON object a line.

A line is one of three: a phase begins, so many of its units are done, or an error that the parent
shall raise in its own name.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import BinaryIO

from recon_cli.errors import ConfigError, FormatError, ReconError, SfmError, WorkspaceError

_ERRORS: dict[str, type[ReconError]] = {
    kind.__name__: kind for kind in (SfmError, ConfigError, FormatError, WorkspaceError)
}


@dataclass(frozen=True)
class Phase:
    """A phase of the work begins.

    Attributes:
        name: "features", "matches", "mapping" or "undistorted".
        total: how many units it has.
        done: how many of them an interrupted run had done.
    """

    name: str
    total: int
    done: int


@dataclass(frozen=True)
class Done:
    """So many units of the current phase are done.

    Attributes:
        count: units, counted from the beginning of the phase.
    """

    count: int


@dataclass(frozen=True)
class Failed:
    """The process gives up.

    Attributes:
        error: what the parent shall raise.
    """

    error: ReconError | OSError


Event = Phase | Done | Failed


class Reporter:
    """The mapping process' end of the line.

    Args:
        stream: binary, read by the parent.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream

    def phase(self, name: str, total: int, *, done: int = 0) -> None:
        """Says that a phase begins; see `Phase`."""
        self._send({"phase": name, "total": total, "done": done})

    def done(self, count: int) -> None:
        """Says how many units of the phase are done."""
        self._send({"count": count})

    def failed(self, error: ReconError | OSError) -> None:
        """Hands an error over."""
        if isinstance(error, OSError):
            self._send({"errno": error.errno, "text": error.strerror, "file": error.filename})
        else:
            self._send(
                {"error": type(error).__name__, "message": error.message, "hint": error.hint})

    def _send(self, value: dict[str, object]) -> None:
        self._stream.write(json.dumps(value).encode() + b"\n")
        self._stream.flush()


def parse(line: bytes) -> Event:
    """Returns the event that `Reporter` wrote as one line."""
    value = json.loads(line)
    if "phase" in value:
        return Phase(value["phase"], value["total"], value["done"])
    if "count" in value:
        return Done(value["count"])
    if "errno" in value:
        return Failed(OSError(value["errno"], value["text"], value["file"]))
    return Failed(_ERRORS[value["error"]](value["message"], hint=value["hint"]))
