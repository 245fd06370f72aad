"""COLMAP's database as seen from outside: whether it can be trusted, and how far it has got.

This reads the file through Python's SQLite. pycolmap brings an SQLite of its own, and two of them
in one process drop each other's locks: nothing here may run in a process in which pycolmap has the
database open.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

_TABLES = {"features": "descriptors", "matches": "two_view_geometries"}
# Values of COLMAP's TwoViewGeometry::ConfigurationType that say "a homography explains this pair".
_HOMOGRAPHIES = (4, 5, 6)  # planar, panoramic, planar or panoramic


def is_sound(path: Path, names: Sequence[str], cameras: int) -> bool:
    """Returns whether a database is intact and holds so many cameras and exactly these images."""
    try:
        with closing(_opened(path)) as connection:
            (verdict,), *_ = connection.execute("PRAGMA quick_check")
            (found,), = connection.execute("SELECT count(*) FROM cameras")
            images = sorted(name for name, in connection.execute("SELECT name FROM images"))
    except sqlite3.DatabaseError:
        return False
    return verdict == "ok" and found == cameras and images == sorted(names)


def progress(path: Path, step: str) -> int:
    """Returns how many images ("features") or pairs ("matches") are finished.

    That is 0 where the file cannot be read: it is locked, broken or not there yet.
    """
    try:
        with closing(_opened(path)) as connection:
            (count,), = connection.execute(f"SELECT count(*) FROM {_TABLES[step]}")
    except sqlite3.DatabaseError:
        return 0
    return int(count)


def keypoint_counts(path: Path) -> dict[str, int]:
    """Returns the number of keypoints of each image whose features were found."""
    with closing(_opened(path)) as connection:
        return dict(connection.execute(
            "SELECT name, rows FROM images JOIN keypoints USING (image_id)"))


def inlier_counts(path: Path) -> tuple[int, int, int]:
    """Returns (verified pairs, verified matches, those of pairs that a homography explains)."""
    with closing(_opened(path)) as connection:
        rows = connection.execute(
            "SELECT config, rows FROM two_view_geometries WHERE rows > 0").fetchall()
    flat = sum(matches for config, matches in rows if config in _HOMOGRAPHIES)
    return len(rows), sum(matches for _, matches in rows), flat


def remove(path: Path) -> None:
    """Deletes a database together with SQLite's side files."""
    for suffix in ("", "-wal", "-shm", "-journal"):
        path.with_name(path.name + suffix).unlink(missing_ok=True)


def _opened(path: Path) -> sqlite3.Connection:
    """Returns a connection that makes no file.

    It may write, because the last one to close takes SQLite's side files away, and one that can
    only read would leave them.
    """
    return sqlite3.connect(f"{path.resolve().as_uri()}?mode=rw", uri=True, timeout=1.0)
