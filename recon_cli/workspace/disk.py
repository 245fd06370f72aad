"""A disk that is full, however the library says so that met it.

Only Python raises an OSError. Others raise an error of their own with the system's words in it, and
streams of C++ say nothing at all, so what was written by one has to be read again.
"""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
from pathlib import Path

from recon_cli.errors import MOST_CHARACTERS, ReconError, WorkspaceError, causes

_FULL = (errno.ENOSPC, errno.EDQUOT)
_WORDS = {
    **{words: number for number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
       if not (words := os.strerror(number)).startswith("Unknown error")},  # EDQUOT on Windows
    "database or disk is full": errno.ENOSPC,  # of SQLite
}
# What is wrong with a path or the system, not with recon.
_OUTSIDE = (errno.EACCES, errno.EPERM, errno.EROFS, errno.EIO, errno.ENAMETOOLONG, errno.EMFILE,
            errno.ENFILE, errno.ELOOP, errno.ENXIO, errno.ENODEV, errno.ESTALE)
_PROBE_BYTES = 1 << 20
_NO_TEMPORARY = "No usable temporary directory"  # of tempfile


def find_space_errno(error: BaseException) -> int | None:
    """Returns the number of the system's error for want of space behind an error, or None."""
    for each in causes(error):
        if isinstance(each, OSError) and each.errno in (*_FULL, errno.EFBIG):
            return each.errno
        text = str(each)
        for words, number in _WORDS.items():
            if words in text:
                return number
    return None


def refuse_full_disk(folder: Path) -> None:
    """Raises OSError where a folder has no room for a small file, by writing one."""
    descriptor, name = tempfile.mkstemp(dir=folder, prefix=".probe.", suffix=".tmp")
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(bytes(_PROBE_BYTES))
            file.flush()
            os.fsync(descriptor)
    finally:
        Path(name).unlink(missing_ok=True)


def explain(error: BaseException, root: Path, doing: str) -> ReconError | None:
    """Returns the error of a full disk while `doing`; None for any other error."""
    number = find_space_errno(error)
    if number in _FULL:
        place = _fullest(root)
        return WorkspaceError(
            f"The disk is full while {doing}: {_free(place) / 1e6:.1f} MB free at {place}.",
            hint="Free some space and run the same command again; finished work is kept.")
    if number == errno.EFBIG:  # a limit of the process, or of a file system such as FAT32
        return WorkspaceError(
            f"A file is larger than {root} can hold, while {doing}.",
            hint="Give a workspace on another disk with -w, or raise `ulimit -f`.")
    if isinstance(error, OSError) and _NO_TEMPORARY in str(error):
        return WorkspaceError(
            f"No folder for temporary files can be written while {doing}: they are full, or not "
            "writable.", hint="Free some space in /tmp, or set TMPDIR to a folder of yours.")
    return None


def explain_outside(error: BaseException) -> ReconError | None:
    """Returns the error for a fault of a path or the system; None for any other."""
    if not isinstance(error, OSError) or error.errno not in _OUTSIDE or error.filename is None:
        return None
    return WorkspaceError(
        f"{os.fsdecode(error.filename)[:MOST_CHARACTERS]} cannot be opened: {error.strerror}.",
        hint="Check its name, its permissions and its disk.")


def _fullest(root: Path) -> Path:
    """Returns which of the disks in use has the least space: that of `root` or of TMPDIR."""
    places = [next(path for path in (root, *root.parents) if path.exists())]
    try:
        places.append(Path(tempfile.gettempdir()))
    except OSError:  # none can be written
        return places[0]
    return min(places, key=_free)


def _free(path: Path) -> int:
    return shutil.disk_usage(path).free
