"""The .ply: tables, the Gaussians of INRIA's 3D Gaussian Splatting, and point clouds.

Gaussians are written as binary little endian float32: x y z nx ny nz f_dc_0..2 f_rest opacity
scale_0..2 rot_0..3. f_rest is channel-major, opacity a logit, scale a natural logarithm, rot wxyz.
f_rest has the coefficients of the scene's degree, as INRIA's trainer writes it: f_rest_0..44 at
degree 3, to 23 at degree 2, to 8 at degree 1, none at degree 0. Gaussians of degree 0 in a scene of
another have zeros there.

The reader accepts ASCII and both byte orders, float and double, the properties in any order, and
ignores unknown ones. Two infinities that other programs write are made finite: the logit of an
opacity of exactly 0 or 1, and the logarithm of a scale of 0.

A scene with a backdrop ends with the sphere of Gaussians that shows it in other programs; a comment
in the header says what it is, and the reader makes a backdrop of it again.
"""

from __future__ import annotations

import dataclasses
import logging
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from recon_cli.errors import FormatError, InputError
from recon_cli.io.splats.values import refuse_not_finite, sigmoid, splats_from_arrays, to_arrays
from recon_cli.scene.backdrop import SPHERE_GAUSSIANS, Backdrop
from recon_cli.scene.splats import SH_C0, TERMS, Splats, with_rows
from recon_cli.workspace.atomic import replacing, write_bytes

_REST = [f"f_rest_{i}" for i in range(3 * TERMS[-1])]
_GROUPS = {
    "means": ["x", "y", "z"],
    "normals": ["nx", "ny", "nz"],
    "sh_dc": [f"f_dc_{i}" for i in range(3)],
    "sh_rest": _REST,
    "logit_opacities": ["opacity"],
    "log_scales": [f"scale_{i}" for i in range(3)],
    "quats": [f"rot_{i}" for i in range(4)],
}
# For an opacity of exactly 1 or 0, which splat-transform makes of 255 and 0: middle of that step.
_MAX_LOGIT = math.log(254.75 / 0.25)
# The third log scale of a flat Gaussian (2D Gaussian Splatting), as SuperSplat sets it.
_FLAT = math.log(1e-6)
MIN_OPACITY = 0.5  # fainter Gaussians are rarely surfaces
_HEADER_LIMIT = 1 << 16  # bytes; a longer header is refused
_END = re.compile(rb"\nend_header[ \t]*\r?\n")
_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
# the comment in the header: how many rows at the end show a backdrop, and its numbers
_BACKDROP = re.compile(r"comment backdrop (\d{1,9})((?: \S+){7})")
_ROUNDING = 1e-6  # of a value: what two machines may compute apart
_DIGITS = 15  # of a count; larger ones fit on no disk
_OF_MESHES = ("face", "tristrips", "edge")
_POSITION, _COLOR = ("x", "y", "z"), ("red", "green", "blue")

logger = logging.getLogger("recon")


def write_ply(
    path: Path, splats: Splats, extra: Mapping[str, NDArray[np.float32]] | None = None
) -> None:
    """Writes `splats` to `path`, whole or not at all.

    `extra` are further properties [N] by name, after all others; readers that do not know them
    skip them. Those of the backdrop's sphere, which has none of its own, are the greatest.
    """
    backdrop, splats = splats.backdrop, splats.with_sphere()
    n = len(splats)
    extra = {name: np.pad(values, (0, n - len(values)), constant_values=values.max(initial=0.0))
             for name, values in (extra or {}).items()}
    if not len(splats.sh_rest):
        splats = splats.with_degree(0)
    rest = _REST[: 3 * TERMS[splats.sh_degree]]
    raw = {name: value.detach().cpu().float() for name, value in splats.parameters().items()}
    columns = {
        **raw, "normals": torch.zeros(n, 3),
        "sh_rest": with_rows(raw["sh_rest"], n).transpose(1, 2).reshape(n, len(rest)),
        "logit_opacities": raw["logit_opacities"][:, None],
    }
    table = np.column_stack([
        torch.cat([columns[name] for name in _GROUPS], dim=1).numpy(), *extra.values()])
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(_header(n, splats.sh_degree, tuple(extra), backdrop))
        file.write(np.ascontiguousarray(table, dtype="<f4").tobytes())


def _properties(sh_degree: int) -> list[str]:
    rest = _REST[: 3 * TERMS[sh_degree]]
    return [name for group in (_GROUPS | {"sh_rest": rest}).values() for name in group]


def _header(
    n: int, sh_degree: int, extra: Sequence[str] = (), backdrop: Backdrop | None = None
) -> bytes:
    names = (*_properties(sh_degree), *extra)
    comments = [] if backdrop is None else [
        f"backdrop {SPHERE_GAUSSIANS} {' '.join(map(repr, backdrop.numbers))}"]
    return format_header({"vertex": (n, [f"float {name}" for name in names])}, comments)


def format_header(
    elements: Mapping[str, tuple[int, Sequence[str]]], comments: Sequence[str] = ()
) -> bytes:
    """Returns the header of a binary .ply, by element its count and its properties with types."""
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {text}" for text in comments)]
    for name, (count, properties) in elements.items():
        lines += [f"element {name} {count}", *(f"property {text}" for text in properties)]
    return "\n".join([*lines, "end_header", ""]).encode("ascii")


def max_gaussians(size: int, sh_degree: int, backdrop: Backdrop | None = None) -> int:
    """Returns how many Gaussians of a degree fit into a .ply of `size` bytes with a backdrop."""
    each, sphere = 4 * len(_properties(sh_degree)), 0 if backdrop is None else SPHERE_GAUSSIANS

    def header(count: int) -> int:
        return len(_header(count, sh_degree, backdrop=backdrop))

    count = max(0, (size - header(0)) // each)
    while count and header(count) + each * count > size:  # the count has digits
        count -= 1
    return max(0, count - sphere)


def read_ply(path: Path) -> Splats:
    """Returns the Gaussians of a .ply as float32 tensors, in the file's order.

    Those after the last one with a coefficient other than zero are of degree 0. The sphere of a
    backdrop, unless another program has changed it, becomes one again. Elements besides
    the vertices are ignored. Infinite logits of opacities, scales of 0 and a missing third scale
    become finite, and a warning counts them. FormatError if the file is missing, truncated, of
    another kind of .ply, or holds other values that are not finite.
    """
    header = read_header(path)
    table = _vertices(header)
    names = table.dtype.names or ()
    rest = [name for name in _REST if name in names]
    if len(rest) not in [3 * terms for terms in TERMS] or rest != _REST[: len(rest)]:
        raise FormatError(
            f"{path} has {len(rest)} f_rest properties; 0, 9, 24 or 45, numbered from 0, make a "
            "degree.")
    groups = {name: _GROUPS[name] for name in _GROUPS if name != "normals"} | {"sh_rest": rest}
    missing = [name for group in groups.values() for name in group if name not in names]
    if missing and missing != ["scale_2"]:
        raise FormatError(f"{path} lacks the properties {', '.join(missing)}: no Gaussians.")
    with np.errstate(over="ignore"):  # overflow becomes infinite, which is refused
        columns = {name: table[name].astype(np.float32)
                   for group in groups.values() for name in group if name not in missing}
    if missing:
        columns["scale_2"] = np.full(len(table), -np.inf, np.float32)
    _make_finite(path, columns)
    refuse_not_finite(path, columns)
    values = {key: np.stack([columns[name] for name in group], axis=1) if group
              else np.zeros((len(table), 0), np.float32) for key, group in groups.items()}
    by_channel = values["sh_rest"].reshape(len(table), 3, len(rest) // 3)
    splats = splats_from_arrays(path, values | {
        "logit_opacities": values["logit_opacities"][:, 0],
        "sh_rest": by_channel.transpose(0, 2, 1)})
    return _without_sphere(splats, header.backdrop)


def _without_sphere(splats: Splats, told: tuple[int, Backdrop] | None) -> Splats:
    """Returns splats whose last rows show a backdrop with it in place of those rows."""
    if told is None or told[0] > len(splats):
        return splats
    count, backdrop = told
    near = splats.select(torch.arange(len(splats) - count))
    found = dataclasses.replace(near, backdrop=backdrop)
    ours = found.with_sphere().parameters()
    same = all(ours[name].shape == value.shape and torch.allclose(ours[name], value, rtol=_ROUNDING)
               for name, value in splats.parameters().items())
    return found if same else splats


def _make_finite(path: Path, columns: dict[str, NDArray[np.float32]]) -> None:
    """Replaces the infinities that mean opaque, invisible and flat, and logs how many."""
    logits = columns["opacity"]
    certain = np.isinf(logits)
    logits[certain] = np.copysign(np.float32(_MAX_LOGIT), logits[certain])
    if certain.any():
        logger.warning("%s: %s opacities of exactly 0 or 1 are read as %.3f and %.3f", path.name,
                       f"{certain.sum():,}", 0.25 / 255, 254.75 / 255)
    flat = 0
    for name in _GROUPS["log_scales"]:
        is_flat = np.isneginf(columns[name])
        columns[name][is_flat] = _FLAT
        flat += int(is_flat.sum())
    if flat:
        logger.warning("%s: %s scales of 0 are read as %g units", path.name, f"{flat:,}",
                       math.exp(_FLAT))


def _vertices(header: Header) -> NDArray[np.void]:
    """Returns the rows of a .ply whose vertices may be plain Gaussians."""
    names = {element.name: element.row for element in header.elements}
    row = names.get("vertex")
    if "vertex" not in names:
        raise FormatError(f"{header.path} holds {', '.join(names)}, but no vertices.")
    if row is not None and "packed_position" in (row.names or ()):
        raise FormatError(
            f"{header.path} is a compressed .ply, which has another layout.",
            hint="Convert it to a plain .ply, for example in SuperSplat.")
    tables = read_tables(header)
    if row is None:
        raise FormatError(f"{header.path} holds properties of a type that Gaussians do not have.")
    return tables["vertex"]


def write_points(path: Path, splats: Splats) -> None:
    """Writes centres and plain colours of the opaque Gaussians as a point cloud.

    InputError if no Gaussian is opaque enough, FormatError if a value is not finite.
    """
    table = to_arrays(splats, ".ply")
    opaque = sigmoid(table["logit_opacities"]) >= MIN_OPACITY
    if not opaque.any():
        raise InputError(
            f"None of {len(splats)} Gaussians has an opacity of {MIN_OPACITY:g} or more.")
    colors = np.rint((SH_C0 * table["sh_dc"][opaque] + 0.5).clip(0, 1) * 255).astype(np.uint8)
    names = (*"xyz", "red", "green", "blue")
    kinds = {name: ("float", "<f4") if name in "xyz" else ("uchar", "u1") for name in names}
    rows = np.empty(len(colors), [(name, kind) for name, (_, kind) in kinds.items()])
    for name, column in zip(names, (*table["means"][opaque].T, *colors.T), strict=True):
        rows[name] = column
    properties = [f"{kind} {name}" for name, (kind, _) in kinds.items()]
    write_bytes(path, format_header({"vertex": (len(rows), properties)}) + rows.tobytes())


@dataclass(frozen=True)
class Element:
    """A table of the file."""

    name: str  # as the header has it
    count: int  # how many rows the header promises
    row: np.dtype[np.void] | None  # the type of a row; None where a property is a list


@dataclass(frozen=True)
class Header:
    """The header: name of the format, elements, offset of the data, and backdrop."""

    path: Path
    format: str
    elements: tuple[Element, ...]
    offset: int
    backdrop: tuple[int, Backdrop] | None = None  # that a comment tells of, after its rows


def read_header(path: Path) -> Header:
    """Returns the header of a .ply; FormatError if the file cannot be read or is none."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEADER_LIMIT)
    except OSError as error:
        raise FormatError(f"{path} cannot be read: {error}.") from error
    end = _END.search(head)
    if not head.startswith((b"ply\n", b"ply\r\n")) or not end:
        raise FormatError(f"{path} is no .ply file.")
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
    return Header(path, kind, elements, end.end(), _told_backdrop(texts))


def _told_backdrop(texts: Sequence[str]) -> tuple[int, Backdrop] | None:
    """Returns the backdrop that a comment tells of; None where none does, or it cannot be read."""
    for found in filter(None, map(_BACKDROP.fullmatch, texts)):
        try:
            return int(found[1]), Backdrop.of([float(text) for text in found[2].split()])
        except ValueError:
            return None
    return None


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
                f"{path} has a {name} with {' '.join(line)[:80]}, which is no number.")
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

    FormatError if the size is not what the header says, or an element holds lists, as in a mesh.
    """
    for element in header.elements:
        if element.count and element.row is None:
            content = "a mesh" if element.name in _OF_MESHES else "lists"
            raise FormatError(
                f"{header.path} holds other elements than vertices: {element.count} of "
                f"{element.name}, which is {content}, not Gaussians.")
    return _read(header, header.elements, exact=True)


def _read(
    header: Header, elements: tuple[Element, ...], *, exact: bool
) -> dict[str, NDArray[np.void]]:
    """Returns the rows of the first elements; `exact` demands that nothing follows."""
    rows = [(each.name, each.count, each.row) for each in elements if each.row is not None]
    is_text = header.format == "ascii"
    try:
        with header.path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size - header.offset
            if is_text:  # a number takes a digit and a space, except at the end
                fits = sum(2 * count * len(row.names or ()) for _, count, row in rows) <= size + 1
            else:
                promised = sum(count * row.itemsize for _, count, row in rows)
                fits = promised == size if exact else promised <= size
            if not fits:
                listed = ", ".join(
                    f"{count} of {name} of {row.itemsize} bytes" for name, count, row in rows)
                raise _wrong_size(header, listed, f"{size} bytes of data")
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
                raise ValueError(f"{name} is no {kind.name}")
        with np.errstate(over="ignore"):  # what is beyond float32 becomes infinite
            table[name] = values
    return table


def read_ply_points(path: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8] | None]:
    """Returns positions [P, 3] and RGB colours [P, 3], None where the file has no colours.

    FormatError if the file is missing, truncated, no .ply, or holds a position that is not finite.
    """
    header = read_header(path)
    first = header.elements[0]
    if first.name != "vertex":
        raise FormatError(f"{path} does not begin with points, but with {first.name}.")
    if first.row is None:
        raise FormatError(f"{path} has a list in {first.name}.")
    names = first.row.names or ()
    if not set(_POSITION) <= set(names):
        raise FormatError(f"{path} has points with the properties {', '.join(names)}.")
    rows = _read(header, (first,), exact=False)[first.name]
    points = np.stack([rows[name].astype(np.float64) for name in _POSITION], axis=1)
    if not np.isfinite(points).all():
        raise FormatError(f"{path} holds a point that is not finite.")
    if not set(_COLOR) <= set(names):
        return points, None
    colors = np.stack([rows[name] for name in _COLOR], axis=1)
    if colors.dtype.kind == "f":  # in [0, 1], as some programs write them
        colors = np.rint(np.nan_to_num(colors).clip(0, 1) * 255)
    return points, colors.astype(np.uint8)
