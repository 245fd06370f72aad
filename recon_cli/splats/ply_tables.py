"""The container of a .ply: its header with comments, and the tables of its elements.

ASCII and both byte orders are read, and any type of number. The promises of a header are
compared with the size of the file before anything is allocated.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import FormatError
from recon_cli.splats.foreign import NOT_GAUSSIANS_HINT, accept_surplus
from recon_cli.workspace.paths import refuse_special

_HEADER_LIMITS = (1 << 16, 1 << 20)  # bytes; of most headers, and of those that are not refused
_END = re.compile(rb"\nend_header[ \t]*\r?\n")
_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_DIGITS = 15  # of a count; larger ones fit on no disk
_OF_MESHES = ("face", "tristrips", "edge")


def format_header(
    elements: Mapping[str, tuple[int, Sequence[str]]], comments: Sequence[str] = ()
) -> bytes:
    """Returns the header of a binary .ply, by element its count and its properties with types."""
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {text}" for text in comments)]
    for name, (count, properties) in elements.items():
        lines += [f"element {name} {count}", *(f"property {text}" for text in properties)]
    return "\n".join([*lines, "end_header", ""]).encode("ascii")


@dataclass(frozen=True)
class Element:
    """A table of the file."""

    name: str  # as the header has it
    count: int  # how many rows the header promises
    row: np.dtype[np.void] | None  # the type of a row; None where a property is a list


@dataclass(frozen=True)
class Header:
    """The header: name of the format, elements, offset of the data, and comments."""

    path: Path
    format: str
    elements: tuple[Element, ...]
    offset: int
    comments: tuple[str, ...] = ()  # texts of its lines `comment`


def read_header(path: Path) -> Header:
    """Returns the header of a .ply; FormatError if the file cannot be read or is not a .ply."""
    refuse_special(path)
    try:
        with path.open("rb") as file:
            head, end, size = b"", None, os.fstat(file.fileno()).st_size
            for limit in _HEADER_LIMITS:
                if end is None:
                    head += file.read(min(limit, size) - len(head))
                    end = _END.search(head)
    except OSError as error:
        raise FormatError(f"{path} cannot be read: {error}.") from error
    if not head.startswith((b"ply\n", b"ply\r\n")) or not end:
        raise FormatError(f"{path} is not a .ply file.")
    texts = head[:end.start()].decode("ascii", "replace").splitlines()
    lines = [text.split() for text in texts]
    lines = [line for line in lines[1:] if line and line[0] not in ("comment", "obj_info")]
    if not lines or len(lines[0]) != 3 or lines[0][0] != "format" or lines[0][1] not in _ORDERS:
        raise FormatError(
            f"{path} is neither an ASCII nor a binary .ply.",
            hint="Convert it in the program it came from.")
    kind = lines[0][1]
    starts = [i for i, line in enumerate(lines) if line[0] == "element"]
    if starts[:1] != [1]:
        raise FormatError(f"{path} is a .ply without elements.")
    elements = tuple(_element(lines[start:stop], kind, path)
                     for start, stop in zip(starts, [*starts[1:], len(lines)], strict=True))
    if len({element.name for element in elements}) != len(elements):
        raise FormatError(f"{path} names an element twice.")
    comments = tuple(text[8:].strip() for text in texts if text.startswith("comment "))
    return Header(path, kind, elements, end.end(), comments)


def _element(lines: list[list[str]], kind: str, path: Path) -> Element:
    """Returns the element of a line `element` and the lines `property` below it."""
    head, *properties = lines
    if len(head) != 3 or not head[2].isdecimal() or len(head[2]) > _DIGITS:
        raise FormatError(f"{path} has a malformed line in its header: {' '.join(head)[:80]}.")
    name, count = head[1], int(head[2])
    for line in properties:
        is_list = line[0] == "property" and line[1:2] == ["list"] and len(line) == 5
        if not is_list and (line[0] != "property" or len(line) != 3 or line[1] not in _TYPES):
            raise FormatError(
                f"{path} has a {name} with {' '.join(line)[:80]}, which is not a number.")
    names = [line[-1] for line in properties]
    if len(set(names)) != len(names):
        raise FormatError(f"{path} names a property of {name} twice.")
    if not properties:
        raise FormatError(f"{path} has a {name} without properties.")
    if any(len(line) == 5 for line in properties):
        return Element(name, count, None)
    types = [_ORDERS[kind] + _TYPES[line[1]] for line in properties]
    return Element(name, count, np.dtype(list(zip(names, types, strict=True))))


def read_tables(header: Header) -> dict[str, NDArray[np.void]]:
    """Returns the rows of every element by its name.

    FormatError if the size differs from that in the header, or an element is lists, as in a mesh.
    """
    for element in header.elements:
        if element.count and element.row is None:
            content = "a mesh" if element.name in _OF_MESHES else "lists"
            raise FormatError(
                f"{header.path} holds {content}, not Gaussians: {element.count} of {element.name} "
                "besides vertices.", hint=NOT_GAUSSIANS_HINT)
    return read_elements(header, header.elements, exact=True)


def read_elements(
    header: Header, elements: tuple[Element, ...], *, exact: bool
) -> dict[str, NDArray[np.void]]:
    """Returns the rows of the first elements; `exact` demands that no further row follows."""
    rows = [(each.name, each.count, each.row) for each in elements if each.row is not None]
    is_text = header.format == "ascii"
    try:
        with header.path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size - header.offset
            if is_text:  # a number takes a digit and a space, except at the end
                fits = sum(2 * count * len(row.names or ()) for _, count, row in rows) <= size + 1
            else:
                promised = sum(count * row.itemsize for _, count, row in rows)
                # a row or a property that the header lacks takes at least as much
                least = max((max(1, min(row.itemsize, count)) for _, count, row in rows),
                            default=1)
                fits = promised <= size and not (exact and size >= promised + least)
            if not fits:
                listed = ", ".join(
                    f"{count} of {name} of {row.itemsize} bytes" for name, count, row in rows)
                raise _wrong_size(header, listed, f"{size} bytes of data")
            if exact and not is_text:
                accept_surplus(header.path, size - promised)
            file.seek(header.offset)
            data = file.read(size if is_text else promised)
    except OSError as error:
        raise FormatError(f"{header.path} cannot be read: {error}.") from error
    if is_text:
        return _text_tables(header, rows, data, exact=exact)
    tables, start = {}, 0
    for name, count, row in rows:
        tables[name] = np.frombuffer(data[start:start + count * row.itemsize], row)
        start += count * row.itemsize
    return tables


def _wrong_size(header: Header, promised: str, actual: str) -> FormatError:
    return FormatError(
        f"{header.path} promises {promised} but holds {actual}: it is truncated or damaged.",
        hint="Write or copy the file again.")


def _text_tables(
    header: Header, rows: list[tuple[str, int, np.dtype[np.void]]], data: bytes, *, exact: bool
) -> dict[str, NDArray[np.void]]:
    lines = [line for line in data.decode("ascii", "replace").splitlines() if line.strip()]
    promised = sum(count for _, count, _ in rows)
    if len(lines) < promised or (exact and len(lines) > promised):
        raise _wrong_size(header, f"{promised} rows", f"{len(lines)}")
    tables, start = {}, 0
    for name, count, row in rows:
        try:
            tables[name] = _parse_rows(lines[start:start + count], row)
        except ValueError as error:
            raise FormatError(
                f"{header.path} has rows of {name} that are not {len(row.names or ())} numbers: "
                f"{error}.") from error
        start += count
    return tables


def _parse_rows(lines: list[str], row: np.dtype[np.void]) -> NDArray[np.void]:
    """Returns rows of numbers, or raises ValueError."""
    table = np.zeros(len(lines), row)
    if not lines:
        return table  # numpy warns of nothing to load
    names = row.names or ()
    columns = np.loadtxt(lines, comments=None, ndmin=2).reshape(len(lines), len(names)).T
    for name, values in zip(names, columns, strict=True):
        kind = row[name]
        if kind.kind in "ui":
            limits = np.iinfo(kind)
            if not ((values >= limits.min) & (values <= limits.max)).all():  # NaN fails too
                raise ValueError(f"{name} is not a {kind.name}")
        with np.errstate(over="ignore"):  # values beyond float32 become infinite
            table[name] = values
    return table
