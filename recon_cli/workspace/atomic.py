"""Files that are either complete or absent: written beside, flushed, then renamed into place.

Of unfinished work each gets a digest as well, see `steps`. Here is also the one reader of JSON.
"""

from __future__ import annotations

import json
import math
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from recon_cli.errors import FormatError, Hint
from recon_cli.workspace import durable, steps
from recon_cli.workspace.paths import describe_special

MAX_TEXT_BYTES = 256 << 20  # of a JSON or TOML file; parsing takes some twenty times as much memory
_MOST_DIGITS = 20  # of an integer of 64 bits, with its sign
_NAME = 40  # characters of a name that a temporary one keeps
LEFTOVERS = ".*.tmp*"  # files that `replacing` had not finished when it was killed


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yields a temporary path that replaces `path` when the block succeeds, else is removed.

    It is flushed before the rename, so that a crash leaves the old file or the new one.
    """
    # shortened to the length that a name may have
    temporary = path.with_name(f".{path.name[:_NAME]}.tmp{os.getpid()}{path.suffix}")
    try:
        yield temporary
        _share(temporary)
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        steps.make_way(path)
        steps.expect(path, temporary)
        durable.replace(temporary, path)
        steps.confirm(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def _share(path: Path) -> None:
    """Gives a file that only its owner may read the permissions of any new file.

    Some libraries (safetensors) write private files, against the umask.
    """
    if stat.S_IMODE(path.stat().st_mode) & 0o077:
        return
    probe = path.with_name(f"{path.name}.mode")
    descriptor = os.open(probe, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)
    try:
        mode = stat.S_IMODE(os.fstat(descriptor).st_mode)
    finally:
        os.close(descriptor)
        probe.unlink()
    with suppress(OSError):  # of a file system without permissions
        path.chmod(mode)


def delete(path: Path) -> None:
    """Deletes a file of unfinished work, if it is there, so that a next run does not miss it."""
    if os.path.lexists(path):
        steps.expect_removal(path)
        path.unlink()


def write_bytes(path: Path, data: bytes) -> None:
    """Writes `data` to `path` atomically."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    """Writes text as UTF-8, atomically; file names in it need not be UTF-8."""
    write_bytes(path, text.encode(errors="replace"))


def write_json(path: Path, value: Any) -> None:
    """Writes `value` to `path` as readable JSON, atomically. NaN is refused."""
    write_bytes(path, (json.dumps(value, indent=1, allow_nan=False) + "\n").encode())


def read_json(
    path: Path, kind: type | None = None, *, hint: str | Hint = "", finite: bool = True
) -> Any:
    """Returns the value in a JSON file, of a `kind` (dict or list) if that is given.

    NaN and infinity are refused unless `finite` is off, for readers that say where they stand.

    Raises:
        FormatError: the file is missing, no plain file, too large, truncated, or not such JSON.
    """
    hint = hint or f"Make {path.name} again, or restore it from a copy."
    try:
        return parse_json(read_text(path), kind, finite=finite)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise FormatError(f"{path} cannot be read as JSON: {reason}.", hint=hint) from error


def parse_json(text: str | bytes, kind: type | None = None, *, finite: bool = True) -> Any:
    """Returns a JSON value of any origin: a value of a `kind` (dict or list), if that is given.

    Raises:
        ValueError: it is not JSON or not of that kind, is nested thousands deep, or where `finite`
            is asked for holds NaN, infinity, or a number that is too large for a float.
    """
    number = _finite if finite else float
    try:
        value = json.loads(text, parse_constant=number, parse_float=number, parse_int=_integer)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    if kind is not None and not isinstance(value, kind):
        what = "a list" if isinstance(value, list) else "an object" if isinstance(
            value, dict) else "a single value"
        raise ValueError(f"it holds {what}, not {'a list' if kind is list else 'an object'}")
    return value


def _integer(text: str) -> float:
    """Returns an integer, or the float next to one that no file of ours can mean."""
    return int(text) if len(text) <= _MOST_DIGITS else _finite(text)


def _finite(text: str) -> float:
    """Returns a number; ValueError for NaN, Infinity, and one too large for a float."""
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"it holds {text[:20]}, which is not a finite number")
    return number


def read_text(path: Path) -> str:
    """Returns the text of a file that a person may have written.

    Raises:
        OSError: it cannot be read.
        ValueError: it is not a plain file, too large, or not UTF-8.
    """
    return read_bytes(path, most=MAX_TEXT_BYTES).decode("utf-8")


def read_bytes(path: Path, *, most: int | None = None) -> bytes:
    """Returns the content of a file of at most `most` bytes.

    Raises:
        OSError: it cannot be read.
        ValueError: it is not a plain file, or too large.
    """
    special = describe_special(path)  # before it is opened: a FIFO would wait for its writer
    if special:
        raise ValueError(f"it is {special}, not a file")
    found = path.stat()
    if stat.S_ISDIR(found.st_mode):
        raise ValueError("it is a folder")
    if most is not None and found.st_size > most:
        raise ValueError(f"it has {found.st_size / 1e6:,.0f} MB, and "
                         f"{most / 1e6:,.0f} MB are the most that is read")
    return path.read_bytes()


def clear_leftovers(folder: Path) -> None:
    """Deletes the unfinished files that a killed process left in and below a folder."""
    for path in folder.rglob(LEFTOVERS):
        if path.is_symlink() or not path.is_dir():
            path.unlink()


def sync_folder(folder: Path) -> None:
    """Flushes a folder's entries, so that a rename in it survives a power cut."""
    durable.flush(folder)
