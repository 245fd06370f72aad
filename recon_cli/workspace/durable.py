"""Flushing and renaming, as each system allows them.

Windows flushes only what is open for writing, has no way to flush a folder, and refuses for a
moment to rename or replace what another program (a virus scanner, an indexer) has open.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

ON_WINDOWS = os.name == "nt"
_WAITS = (0.01, 0.05, 0.2, 0.5, 1.0)  # seconds before each further try; scanners take less


def flush(path: Path) -> None:
    """Flushes a file, or the entries of a folder where the system can."""
    if ON_WINDOWS:
        if not path.is_dir():
            with suppress(PermissionError), path.open("rb+") as file:  # one that is read-only
                os.fsync(file.fileno())
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def rename(source: Path, target: Path) -> None:
    """Renames a file or folder to where nothing is."""
    _retry(lambda: source.rename(target))


def replace(source: Path, target: Path) -> None:
    """Renames a file to where another may be, which it replaces."""
    _retry(lambda: source.replace(target))


def _retry(act: Callable[[], object]) -> None:
    """Acts, on Windows again for two seconds while another program is in the way."""
    for seconds in _WAITS if ON_WINDOWS else ():
        try:
            act()
            return
        except PermissionError:
            time.sleep(seconds)
    act()
