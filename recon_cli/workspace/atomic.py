"""Files that are either whole or not there: written beside, flushed, then renamed into place."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from recon_cli.errors import FormatError
from recon_cli.workspace.paths import refuse_special

_NAME = 40  # characters of a name that a temporary one keeps
LEFTOVERS = ".*.tmp*"  # files that `replacing` had not finished when it was killed


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yields a temporary path that replaces `path` when the block succeeds, else is removed.

    It is flushed before the rename, so that a crash leaves the old file or the new one.
    """
    # shortened, so that it is no longer than a name may be
    temporary = path.with_name(f".{path.name[:_NAME]}.tmp{os.getpid()}{path.suffix}")
    try:
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_bytes(path: Path, data: bytes) -> None:
    """Writes `data` to `path`, whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    """Writes text as UTF-8, whole or not at all; file names in it need not be UTF-8."""
    write_bytes(path, text.encode(errors="replace"))


def write_json(path: Path, value: Any) -> None:
    """Writes `value` to `path` as readable JSON, whole or not at all. NaN is refused."""
    write_bytes(path, (json.dumps(value, indent=1, allow_nan=False) + "\n").encode())


def read_json(path: Path) -> Any:
    """Returns what a JSON file holds.

    Raises:
        FormatError: the file is missing, truncated or no JSON.
    """
    refuse_special(path)
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise FormatError(f"{path} cannot be read as JSON: {error}.") from error


def clear_leftovers(folder: Path) -> None:
    """Deletes what was begun in a folder, and below it, when a process was killed."""
    for path in folder.rglob(LEFTOVERS):
        path.unlink()


def sync_folder(folder: Path) -> None:
    """Flushes a folder's entries, so that a rename in it survives a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
