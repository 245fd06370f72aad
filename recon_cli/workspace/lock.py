"""One writer a workspace: a lock that the system drops when its holder dies, and says who it is."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

from filelock import FileLock, Timeout

from recon_cli.errors import FormatError, WorkspaceError
from recon_cli.workspace.atomic import read_json, write_json

LOCK = ".lock"
HOLDER = ".lock.json"  # beside the lock, because a locked file cannot be read everywhere


@contextmanager
def hold(root: Path, verb: str, *, other: str = "another workspace with -w") -> Iterator[None]:
    """Holds the lock of the workspace at `root` for as long as the block runs.

    Args:
        root: an existing folder.
        verb: what the user typed, for the message to a second process.
        other: what to give instead, for its hint.

    Raises:
        WorkspaceError: another process holds the lock; the message says which.
    """
    lock = FileLock(root / LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        raise WorkspaceError(
            f"{root} is in use by {_describe_holder(root)}.",
            hint=f"Wait until it is done, or give {other}.") from error
    try:
        write_json(root / HOLDER, {
            "pid": os.getpid(), "host": socket.gethostname(), "verb": verb,
            "since": datetime.now().astimezone().isoformat(timespec="seconds"),
        })
        yield
    finally:
        with contextlib.suppress(OSError):  # the error that led here says more
            (root / HOLDER).unlink(missing_ok=True)
        lock.release()


def _describe_holder(root: Path) -> str:
    try:
        holder = read_json(root / HOLDER)
        return (f"`recon {holder['verb']}`, process {holder['pid']} on {holder['host']} "
                f"since {holder['since']}")
    except (FormatError, KeyError, TypeError):
        return "another process"
