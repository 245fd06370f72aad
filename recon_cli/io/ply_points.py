"""Points with colours from a .ply, ASCII or binary of either byte order; faces are passed over."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import FormatError

_HEADER_LIMIT = 1 << 16  # bytes; a header that does not end by then is none
_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_PLACE, _COLOR = ("x", "y", "z"), ("red", "green", "blue")


@dataclass(frozen=True)
class _Header:
    """What comes before the data: the format's name, the rows and where they begin."""

    format: str
    count: int
    row: np.dtype[np.void]
    offset: int


def read_ply_points(path: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8] | None]:
    """Returns positions [P, 3] and RGB colours [P, 3], None where the file has no colours.

    Raises:
        FormatError: the file is missing, truncated, no .ply, or holds a place that is not finite.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise FormatError(f"{path} cannot be read: {error}.") from error
    header = _parse_header(data[:_HEADER_LIMIT], path)
    rows = _ascii_rows(data, header, path) if header.format == "ascii" else _binary_rows(
        data, header, path)
    points = np.stack([rows[name].astype(np.float64) for name in _PLACE], axis=1)
    if not np.isfinite(points).all():
        raise FormatError(f"{path} holds a point that is not finite.")
    if not set(_COLOR) <= set(header.row.names or ()):
        return points, None
    colors = np.stack([rows[name] for name in _COLOR], axis=1)
    if colors.dtype.kind == "f":  # in [0, 1], as some programs write them
        colors = np.rint(np.nan_to_num(colors).clip(0, 1) * 255)
    return points, colors.astype(np.uint8)


def _parse_header(head: bytes, path: Path) -> _Header:
    end = head.find(b"end_header")
    stop = head.find(b"\n", end)
    lines = [line.split() for line in head[:max(end, 0)].decode("ascii", "replace").splitlines()]
    lines = [line for line in lines if line and line[0] not in ("comment", "obj_info")]
    if end < 0 or stop < 0 or len(lines) < 3 or lines[0] != ["ply"] or len(lines[1]) != 3:
        raise FormatError(f"{path} is no .ply file.")
    kind = lines[1][1]
    vertex = lines[2]
    if kind not in _ORDERS or vertex[:2] != ["element", "vertex"] or not vertex[-1].isdecimal():
        raise FormatError(f"{path} does not begin with points: {' '.join(vertex)}.")
    fields = []
    for line in lines[3:]:
        if line[0] == "element":
            break
        if len(line) != 3 or line[1] not in _TYPES:
            raise FormatError(f"{path} has points with {' '.join(line)}, which is no number.")
        fields.append((line[2], _ORDERS[kind] + _TYPES[line[1]]))
    names = [name for name, _ in fields]
    if len(set(names)) != len(names) or not set(_PLACE) <= set(names):
        raise FormatError(f"{path} has points with the properties {', '.join(names)}.")
    return _Header(kind, int(vertex[-1]), np.dtype(fields), stop + 1)


def _binary_rows(data: bytes, header: _Header, path: Path) -> NDArray[np.void]:
    if len(data) - header.offset < header.count * header.row.itemsize:
        raise _short(path, header.count)
    return np.frombuffer(data, header.row, header.count, header.offset)


def _ascii_rows(data: bytes, header: _Header, path: Path) -> NDArray[np.void]:
    lines = data[header.offset:].decode("ascii", "replace").splitlines()
    lines = [line for line in lines if line.strip()][:header.count]
    if len(lines) < header.count:
        raise _short(path, header.count)
    rows = np.zeros(header.count, header.row)
    width = len(header.row.names or ())
    try:
        table = np.array([line.split() for line in lines], np.float64)
        table = table.reshape(header.count, width)
    except ValueError as error:
        raise FormatError(f"{path} has points that are not {width} numbers.") from error
    for at, name in enumerate(header.row.names or ()):
        kind = header.row[name]
        if kind.kind in "ui" and not _fits(table[:, at], kind):
            raise FormatError(f"{path} has values of {name} that are no {kind.name}.")
        rows[name] = table[:, at]
    return rows


def _fits(values: NDArray[np.float64], kind: np.dtype[Any]) -> bool:
    limits = np.iinfo(kind)
    return bool(((values >= limits.min) & (values <= limits.max)).all())


def _short(path: Path, count: int) -> FormatError:
    return FormatError(
        f"{path} promises {count} points, but ends before: it is truncated.",
        hint="Copy the file again.")
