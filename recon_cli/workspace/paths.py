"""Paths that cannot be read or replaced like a file, told before anything is opened."""

from __future__ import annotations

import errno
import os
import re
import shlex
import stat
from pathlib import Path, PurePosixPath

from recon_cli.errors import MOST_CHARACTERS, ConfigError, FormatError

# A drive of Windows is one letter; a `Path` has but one of the two slashes.
_ADDRESS = re.compile(r"[a-z][a-z0-9+.-]+:/", re.IGNORECASE)
_KINDS = {
    stat.S_ISFIFO: "a named pipe", stat.S_ISSOCK: "a socket", stat.S_ISCHR: "a device",
    stat.S_ISBLK: "a device"}


def is_plain_file(path: Path) -> bool:
    """Returns whether a file exists and is not a link, which another process may have put there."""
    try:
        return stat.S_ISREG(os.lstat(path).st_mode)
    except OSError:
        return False


def is_address(text: str) -> bool:
    """Returns whether a text is the address of something on a network, not a path."""
    return _ADDRESS.match(text) is not None and not os.path.lexists(text)


def leads_out(name: str) -> bool:
    """Returns whether a path in an archive or index would lead out of the folder it belongs in."""
    path = PurePosixPath(name.replace("\\", "/"))
    return path.is_absolute() or ".." in path.parts or ":" in name or "\0" in name


def refuse_special(path: Path, *, command: str = "") -> None:
    """Raises FormatError unless a path is a file, a folder, or not there.

    A pipe or a device would be waited for, or give bytes without end. ConfigError for an address;
    its hint names the `command` that takes the path.
    """
    if is_address(str(path)):
        name = shlex.quote(path.name) if path.suffix else "FILE"
        raise ConfigError(
            f"{str(path).replace(':/', '://', 1)} is an address, but recon reads files only.",
            hint=f"Download it, then {f'type `{command} {name}`' if command else 'give the file'}.")
    try:
        kind = describe_special(path)
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            raise FormatError(
                f"{str(path)[:MOST_CHARACTERS]}... is longer than a path or a name in it can be.",
                hint="Give a shorter one.") from error
        return
    if kind:
        raise FormatError(
            f"{path} is {kind}, not a file.",
            hint="Save its output to a file, and give the path of that file.")


def describe_special(path: Path) -> str:
    """Returns the kind of a path in words, empty for a file or folder; OSError if it is missing."""
    mode = os.stat(path).st_mode
    return next((kind for is_kind, kind in _KINDS.items() if is_kind(mode)), "")
