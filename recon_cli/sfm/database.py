"""COLMAP's database through Python's SQLite: whether it is intact, and how much it holds.

pycolmap brings its own SQLite, and two of them in one process drop each other's locks: nothing here
may run in a process while pycolmap has the database open.
"""

from __future__ import annotations

import sqlite3
import zlib
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.workspace import layout
from recon_cli.workspace.steps import SUFFIX, StepFolder

KEYPOINT_COLUMNS = 6  # x, y and the 2x2 matrix of its shape, which COLMAP writes for SIFT
_ROWS = "rows"  # the step that leaves the rows of a database
_TABLES = {"features": "descriptors", "matches": "two_view_geometries"}
# A pair of images is numbered first * this + second (COLMAP, src/colmap/util/types.h).
_PAIR_BASE = 2**31 - 1
# Values of COLMAP's TwoViewGeometry::ConfigurationType that say "a homography explains this pair".
_HOMOGRAPHIES = (4, 5, 6)  # planar, panoramic, planar or panoramic


def is_sound(path: Path, names: Sequence[str], cameras: int) -> bool:
    """Returns whether a database is intact and holds so many cameras and exactly these images."""
    try:
        with closing(_connect(path)) as connection:
            (verdict,), *_ = connection.execute("PRAGMA quick_check")
            (count,), = connection.execute("SELECT count(*) FROM cameras")
            images = sorted(name for name, in connection.execute("SELECT name FROM images"))
    except sqlite3.DatabaseError:
        return False
    return verdict == "ok" and count == cameras and images == sorted(names)


# Each table's column that numbers the image or pair of a row.
_CONTENT = {"keypoints": "image_id", "descriptors": "image_id", "matches": "pair_id",
            "two_view_geometries": "pair_id"}
_FOUND = {"features": ("keypoints", "descriptors"), "matches": ("matches", "two_view_geometries")}


def record_rows(path: Path) -> None:
    """Records the digests of all rows of a database beside it, for `restore_rows`."""
    try:
        with closing(_connect(path)) as connection:
            digests = _digest_rows(connection)
    except sqlite3.DatabaseError:  # whoever reads it next finds no digest that fits
        return
    _log(path).finish(_ROWS, digests)


def forget_rows(path: Path) -> None:
    """Deletes the digests of a database that no later run continues."""
    layout.remove(path.with_suffix(SUFFIX))


def restore_rows(path: Path) -> str | None:
    """Deletes what was written to a database since `record_rows`, as in a step that was killed.

    Returns the first step whose recorded rows were damaged since: "features", "matches", or None.
    """
    try:
        recorded = _log(path).result(_ROWS)
        with closing(_connect(path)) as connection, connection:
            found = _digest_rows(connection)
            for step, tables in _FOUND.items():
                if step == "features" and found["rest"] != recorded["rest"]:
                    return step
                if any(found[step].get(row) != digest for row, digest in recorded[step].items()):
                    return step
                for row in found[step].keys() - recorded[step].keys():
                    for table in tables:
                        connection.execute(
                            f"DELETE FROM {table} WHERE {_CONTENT[table]} = ?", (int(row),))
    except (sqlite3.DatabaseError, KeyError, TypeError, AttributeError, ValueError):
        return "features"
    return None


def clear_matches(path: Path) -> None:
    """Deletes all matches."""
    with closing(_connect(path)) as connection, connection:
        for table in _FOUND["matches"]:
            connection.execute(f"DELETE FROM {table}")


def _digest_rows(connection: sqlite3.Connection) -> dict[str, Any]:
    """Returns the CRC-32 of what was found of each image and pair, by number, and of the rest."""
    tables = [name for name, in connection.execute(
        "SELECT name FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite_%' "
        "ORDER BY name")]
    digests: dict[str, Any] = {step: {} for step in _FOUND}
    digests["rest"] = 0
    for table in tables:
        step = next((step for step, names in _FOUND.items() if table in names), None)
        cursor = connection.execute(f"SELECT * FROM {table} ORDER BY 1")
        columns = [column for column, *_ in cursor.description]
        for row in cursor:
            if step is None:
                digests["rest"] = _crc(row, digests["rest"])
            else:
                number = str(row[columns.index(_CONTENT[table])])
                digests[step][number] = _crc(row, digests[step].get(number, 0))
    return digests


def _crc(row: Sequence[Any], value: int) -> int:
    for item in row:
        value = zlib.crc32(item if isinstance(item, bytes) else repr(item).encode(), value)
    return value


def _log(path: Path) -> StepFolder:
    return StepFolder(path.parent, path.with_suffix(SUFFIX))


def progress(path: Path, step: str) -> int:
    """Returns how many images ("features") or pairs ("matches") are finished; 0 if unreadable."""
    try:
        with closing(_connect(path)) as connection:
            (count,), = connection.execute(f"SELECT count(*) FROM {_TABLES[step]}")
    except sqlite3.DatabaseError:
        return 0
    return int(count)


def keypoint_counts(path: Path) -> dict[str, int]:
    """Returns the number of keypoints of each image whose features were found."""
    with closing(_connect(path)) as connection:
        return dict(connection.execute(
            "SELECT name, rows FROM images JOIN keypoints USING (image_id)"))


def scales(keypoints: NDArray[np.float32]) -> NDArray[np.float64]:
    """Returns the size of keypoints [K, 6] (x, y and a 2x2 shape), in pixels, [K]."""
    _, _, a, b, c, d = keypoints.astype(np.float64).T
    size: NDArray[np.float64] = np.sqrt(np.abs(a * d - b * c))
    return size


def count_inliers(path: Path) -> list[tuple[int, int, int]]:
    """Returns (verified pairs, verified matches, those of pairs that a homography explains).

    Pairs are counted by their distance in order of names: 1, 2 to 3, 4 to 7, ... Distances without
    a verified pair are left out.
    """
    with closing(_connect(path)) as connection:
        images = [image for image, in connection.execute(
            "SELECT image_id FROM images ORDER BY name")]
        rows = connection.execute(
            "SELECT pair_id, config, rows FROM two_view_geometries WHERE rows > 0").fetchall()
    place = {image: index for index, image in enumerate(images)}
    counts: dict[int, tuple[int, int, int]] = {}
    for pair, config, matches in rows:
        first, second = (place[image] for image in divmod(pair, _PAIR_BASE))
        apart = abs(first - second).bit_length()
        pairs, total, flat = counts.get(apart, (0, 0, 0))
        flat += matches if config in _HOMOGRAPHIES else 0
        counts[apart] = (pairs + 1, total + matches, flat)
    return [counts[apart] for apart in sorted(counts)]


def pair_names(path: Path) -> set[tuple[str, str]]:
    """Returns the pairs of images that are finished, verified or not, each in order of names."""
    with closing(_connect(path)) as connection:
        names = dict(connection.execute("SELECT image_id, name FROM images"))
        ids = connection.execute("SELECT pair_id FROM two_view_geometries").fetchall()
    pairs = ((names[pair // _PAIR_BASE], names[pair % _PAIR_BASE]) for pair, in ids)
    return {(min(pair), max(pair)) for pair in pairs}


def matched_ids(path: Path) -> list[tuple[int, int]]:
    """Returns the ids of the two images of each pair that was matched, successfully or not."""
    with closing(_connect(path)) as connection:
        return [divmod(pair, _PAIR_BASE)
                for pair, in connection.execute("SELECT pair_id FROM matches")]


def remove(path: Path) -> None:
    """Deletes a database together with SQLite's side files and its digests."""
    forget_rows(path)
    for suffix in ("", "-wal", "-shm", "-journal"):
        layout.remove(path.with_name(path.name + suffix))


def _connect(path: Path) -> sqlite3.Connection:
    """Returns a connection that creates no file, but may write, to remove SQLite's side files."""
    return sqlite3.connect(f"{path.resolve().as_uri()}?mode=rw", uri=True, timeout=1.0)
