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
in the header describes it, and the reader turns it into a backdrop again.
"""

from __future__ import annotations

import dataclasses
import logging
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import FormatError, InputError, name_command
from recon_cli.scene.backdrop import SPHERE_GAUSSIANS, Backdrop
from recon_cli.scene.splat_arrays import SH_C0, TERMS, SplatArrays
from recon_cli.scene.statistics import ROUNDING
from recon_cli.splats.foreign import (
    FLAT,
    NOT_GAUSSIANS_HINT,
    add_filter,
    count_terms,
    drop_not_finite,
    find_origin,
    undo_activations,
)
from recon_cli.splats.format import LoadedScene, SplatFormat, WriteSettings
from recon_cli.splats.ply_tables import (
    Header,
    format_header,
    read_elements,
    read_header,
    read_tables,
)
from recon_cli.splats.values import refuse_not_finite, sigmoid, splats_from_arrays, to_arrays
from recon_cli.workspace.atomic import replacing, write_bytes

if TYPE_CHECKING:
    from recon_cli.scene.splats import Splats

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
_SHAPE = ("opacity", "scale_0", "rot_0")  # that any Gaussian has, and no point
_FILTER = "filter_3D"
# Properties of SpaceTimeGaussian, 4D-GS and others whose Gaussians move, turn or fade with time.
_MOVING = re.compile(r"t|scale_t|rot_r_\d+|trbf_\w+|motion_\d+|omega_\d+|velocity\w*|deform\w*")
# For an opacity of exactly 1 or 0, which splat-transform makes of 255 and 0: middle of that step.
_MAX_LOGIT = math.log(254.75 / 0.25)
MIN_OPACITY = 0.5  # fainter Gaussians are rarely surfaces
# the comment in the header: how many rows at the end show a backdrop, and its numbers
_BACKDROP = re.compile(r"backdrop (\d{1,9})((?: \S+){7})")
_POSITION, _COLOR = ("x", "y", "z"), ("red", "green", "blue")

logger = logging.getLogger("recon")


def write_ply(
    path: Path, splats: Splats | SplatArrays,
    extra: Mapping[str, NDArray[np.float32]] | None = None, *,
    comments: Sequence[str] = (),
) -> None:
    """Writes `splats` to `path`, whole or not at all, with more `comments` in the header.

    `extra` are further properties [N] by name, after all others; readers that do not know them
    skip them. Those of the backdrop's sphere, which has none of its own, are the greatest.
    """
    backdrop, splats = splats.backdrop, splats.with_sphere()
    arrays = splats.as_arrays()
    n, rest = len(arrays), arrays.sh_rest if len(arrays.sh_rest) else arrays.sh_rest[:, :0]
    extra = {name: np.pad(values, (0, n - len(values)), constant_values=values.max(initial=0.0))
             for name, values in (extra or {}).items()}
    coefficients = np.zeros((n, 3, rest.shape[1]), np.float32)
    coefficients[:len(rest)] = rest.transpose(0, 2, 1)
    columns = {**arrays.parameters(), "normals": np.zeros((n, 3), np.float32),
               "sh_rest": coefficients.reshape(n, 3 * rest.shape[1])}
    table = np.column_stack([*(columns[name] for name in _GROUPS), *extra.values()])
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(_header(n, TERMS.index(rest.shape[1]), tuple(extra), backdrop, comments))
        file.write(np.ascontiguousarray(table, dtype="<f4").tobytes())


def _properties(sh_degree: int) -> list[str]:
    rest = _REST[: 3 * TERMS[sh_degree]]
    return [name for group in (_GROUPS | {"sh_rest": rest}).values() for name in group]


def _header(
    n: int, sh_degree: int, extra: Sequence[str] = (), backdrop: Backdrop | None = None,
    comments: Sequence[str] = (),
) -> bytes:
    names = (*_properties(sh_degree), *extra)
    if backdrop is not None:
        numbers = " ".join(map(repr, backdrop.numbers))
        comments = [*comments, f"backdrop {SPHERE_GAUSSIANS} {numbers}"]
    return format_header({"vertex": (n, [f"float {name}" for name in names])}, comments)


def describe_scene(up: str | None, *, antialiased: bool) -> list[str]:
    """Returns comments that tell other programs the up axis and the rasterizer.

    No comment means -y, and y alone would be taken for that of Brush, see `read_up`.
    """
    axis = {"z": "z", "y": "+y"}.get(up or "")
    return [*([f"Vertical Axis: {axis}"] if axis else []),
            *(["SplatRenderMode: mip"] if antialiased else [])]


def describe_settings(settings: WriteSettings) -> list[str]:
    """Returns the comments of `describe_scene` for a scene that is written."""
    return describe_scene(settings.up_axis, antialiased=settings.antialiased)


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
    """Returns the Gaussians of a .ply as float32 tensors; see `read_arrays`."""
    return read_arrays(path).as_tensors()


def read_arrays(path: Path) -> SplatArrays:
    """Returns the Gaussians of a .ply in float32, in the file's order, with their values.

    Those after the last one with a coefficient other than zero are of degree 0. The sphere of a
    backdrop, unless another program has changed it, becomes one again. Elements besides
    the vertices are ignored. Infinite logits of opacities, scales of 0 and a missing third scale
    become finite, and a warning counts them. FormatError if the file is missing, truncated, of
    another kind of .ply, or holds other values that are not finite.
    """
    header = read_header(path)
    columns = _read_columns(header)
    with np.errstate(over="ignore"):  # overflow becomes infinite, which is refused
        columns["means"] = columns["means"].astype(np.float32)
    refuse_not_finite(path, _by_property(columns))
    return _without_sphere(splats_from_arrays(path, columns), _read_backdrop(header))


def load_ply(path: Path) -> LoadedScene:
    """Returns the scene in a .ply of any program, whose values may be written in other ways.

    Gaussians that are not finite are dropped, opacities and sizes that are not logits or logarithms
    are converted, each with a warning. Positions that float32 would round are moved to the origin.
    The errors are those of `read_ply`, but up to half of the Gaussians may be not finite.
    """
    header = read_header(path)
    columns = _read_columns(header)
    columns = drop_not_finite(path, columns, _by_property(columns))
    origin = None
    if len(columns["means"]):
        columns = undo_activations(path, columns)
        origin = find_origin(columns["means"], columns["log_scales"])
    if origin is not None:
        columns["means"] = columns["means"].astype(np.float64) - origin.point
    splats = _without_sphere(splats_from_arrays(path, columns), _read_backdrop(header))
    return LoadedScene(
        splats, read_up(header), is_antialiased(header), origin, describe_writer(header))


def read_up(header: Header) -> str | None:
    """Returns the axis that is up by a comment `Vertical Axis`; None if none says so.

    Brush writes y whatever is up, and -y is up in its scenes, so that y says nothing.
    """
    found = [text.partition(":")[2].strip().lower() for text in header.comments
             if text.lower().startswith("vertical axis:")]
    axis = found[-1] if found else ""
    return {"z": "z", "+z": "z", "-y": "-y", "+y": "y"}.get(axis)


def is_antialiased(header: Header) -> bool:
    """Returns whether a comment of Brush or Postshot says that antialiasing was trained with."""
    found = False
    for text in header.comments:  # the last one counts
        words = text.lower().replace(":", " ").split()
        if words[:1] == ["splatrendermode"]:
            found = "mip" in words[1:]
        elif words[:1] == ["antialiased"] and len(words) == 2:
            found = words[1] in ("1", "true")
    return found


def describe_writer(header: Header) -> str:
    """Returns the comments of a file, which name programs and settings; no backdrop's numbers."""
    return "; ".join(text for text in header.comments if text and not _BACKDROP.fullmatch(text))


def _read_columns(header: Header) -> dict[str, NDArray[Any]]:
    """Returns the parameters in a file by their names in `Splats`; means in their own precision."""
    path, table = header.path, _vertices(header)
    names = table.dtype.names or ()
    rest = [name for name in names if name.startswith("f_rest_")]
    terms = count_terms(path, len(rest))
    if set(rest) != {f"f_rest_{at}" for at in range(3 * terms)}:
        raise FormatError(f"{path} has {len(rest)} f_rest properties that are not numbered from 0.")
    rest = [f"f_rest_{at}" for at in range(3 * terms)]
    groups = {name: _GROUPS[name] for name in _GROUPS if name != "normals"} | {"sh_rest": rest}
    plain = not set(_GROUPS["sh_dc"]) & set(names) and set(_COLOR) <= set(names)
    if plain:
        groups["sh_dc"] = list(_COLOR)
    missing = [name for group in groups.values() for name in group if name not in names]
    if set(_SHAPE) <= set(missing):
        raise FormatError(f"{path} holds a point cloud, not Gaussians: {', '.join(names)[:80]}.",
                          hint=NOT_GAUSSIANS_HINT)
    moving = [name for name in names if _MOVING.fullmatch(name)]
    if moving:
        raise FormatError(
            f"{path} holds moving Gaussians ({', '.join(moving)[:80]}), which are not supported.",
            hint="Export one moment as a plain .ply from the program that it came from.")
    if missing and missing != ["scale_2"]:
        raise FormatError(f"{path} lacks the properties {', '.join(missing)} of Gaussians.")
    with np.errstate(over="ignore"):  # overflow becomes infinite, which is refused
        columns = {name: table[name].astype(np.float32)
                   for group in groups.values() for name in group
                   if name not in (*missing, *_POSITION)}
    if missing:
        columns["scale_2"] = np.full(len(table), -np.inf, np.float32)
    if plain:
        columns |= _read_colors(path, table)
    _make_finite(path, columns)
    values: dict[str, NDArray[Any]] = {
        key: np.stack([columns[name] for name in group], axis=1) for key, group in groups.items()
        if key not in ("means", "sh_rest")}
    by_channel = np.stack([columns[name] for name in rest], axis=1) if rest else np.zeros(
        (len(table), 0), np.float32)
    kept = min(terms, TERMS[-1])
    precise = any(table.dtype[name].itemsize > 4 for name in _POSITION)
    values["means"] = np.stack([table[name].astype(np.float64 if precise else np.float32)
                                for name in _POSITION], axis=1)
    values["logit_opacities"] = values["logit_opacities"][:, 0]
    values["sh_rest"] = by_channel.reshape(len(table), 3, terms)[:, :, :kept].transpose(0, 2, 1)
    if _FILTER in names:
        add_filter(path, values, table[_FILTER])
    return values


def _by_property(columns: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Returns columns by the names of their properties; coefficients of one group as one."""
    named = {}
    for name, value in columns.items():
        group = _GROUPS[name]
        if name == "sh_rest" or value.ndim == 1:
            named["f_rest" if name == "sh_rest" else group[0]] = value
        else:
            named |= dict(zip(group, value.T, strict=True))
    return named


def _read_colors(path: Path, table: NDArray[np.void]) -> dict[str, NDArray[np.float32]]:
    """Returns the coefficients of degree 0 of plain colours by their names."""
    most = 1.0
    kind = table.dtype[_COLOR[0]]
    if kind.kind in "ui":
        most = float(np.iinfo(kind).max)
    elif any((table[name] > 1).any() for name in _COLOR):
        most = 255.0
    logger.warning("%s: colours are those of red, green and blue, from every side: there is no "
                   "f_dc", path.name)
    return {name: ((table[name].astype(np.float32) / most - 0.5) / SH_C0) for name in _COLOR}


def _without_sphere(
    splats: SplatArrays, header_backdrop: tuple[int, Backdrop] | None
) -> SplatArrays:
    """Returns splats whose last rows show a backdrop with it in place of those rows."""
    if header_backdrop is None or header_backdrop[0] > len(splats):
        return splats
    count, backdrop = header_backdrop
    found = dataclasses.replace(splats.first(len(splats) - count), backdrop=backdrop)
    ours = found.with_sphere().parameters()
    same = all(ours[name].shape == value.shape and np.allclose(ours[name], value, rtol=ROUNDING)
               for name, value in splats.parameters().items())
    return found if same else splats


def _read_backdrop(header: Header) -> tuple[int, Backdrop] | None:
    """Returns the backdrop that a comment describes, after its rows; None if it cannot be read."""
    for found in filter(None, map(_BACKDROP.fullmatch, header.comments)):
        try:
            return int(found[1]), Backdrop.from_numbers([float(text) for text in found[2].split()])
        except ValueError:
            return None
    return None


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
        columns[name][is_flat] = FLAT
        flat += int(is_flat.sum())
    if flat:
        logger.warning("%s: %s scales of 0 are read as %g units", path.name, f"{flat:,}",
                       math.exp(FLAT))


def _vertices(header: Header) -> NDArray[np.void]:
    """Returns the rows of a .ply whose vertices may be plain Gaussians."""
    names = {element.name: element.row for element in header.elements}
    row = names.get("vertex")
    if "vertex" not in names:
        raise FormatError(f"{header.path} holds {', '.join(names)}, but no vertices.")
    if row is not None and "packed_position" in (row.names or ()):
        raise FormatError(
            f"{header.path} is a compressed .ply, which has another layout.",
            hint=f"Use {name_command('import')} or {name_command('convert')}, which read it.")
    tables = read_tables(header)
    if row is None:
        raise FormatError(f"{header.path} holds vertices with lists, which Gaussians do not have.",
                          hint=NOT_GAUSSIANS_HINT)
    return tables["vertex"]


def write_points(path: Path, splats: Splats | SplatArrays) -> None:
    """Writes centres and plain colours of the opaque Gaussians as a point cloud.

    InputError if no Gaussian is opaque enough, FormatError if a value is not finite.
    """
    table = to_arrays(splats, ".ply")
    opaque = sigmoid(table["logit_opacities"]) >= MIN_OPACITY
    if not opaque.any():
        raise InputError(
            f"None of {len(splats)} Gaussians has an opacity of {MIN_OPACITY:g} or more.",
            hint="Leave points.ply out of --format, or train longer.")
    colors = np.rint((SH_C0 * table["sh_dc"][opaque] + 0.5).clip(0, 1) * 255).astype(np.uint8)
    names = (*"xyz", "red", "green", "blue")
    kinds = {name: ("float", "<f4") if name in "xyz" else ("uchar", "u1") for name in names}
    rows = np.empty(len(colors), [(name, kind) for name, (_, kind) in kinds.items()])
    for name, column in zip(names, (*table["means"][opaque].T, *colors.T), strict=True):
        rows[name] = column
    properties = [f"{kind} {name}" for name, (kind, _) in kinds.items()]
    write_bytes(path, format_header({"vertex": (len(rows), properties)}) + rows.tobytes())


def read_ply_points(path: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8] | None]:
    """Returns positions [P, 3] and RGB colours [P, 3], None where the file has no colours.

    FormatError if the file is missing, truncated, not a .ply, or a position is not finite.
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
    rows = read_elements(header, (first,), exact=False)[first.name]
    points = np.stack([rows[name].astype(np.float64) for name in _POSITION], axis=1)
    if not np.isfinite(points).all():
        raise FormatError(f"{path} holds a point that is not finite.")
    if not set(_COLOR) <= set(names):
        return points, None
    colors = np.stack([rows[name] for name in _COLOR], axis=1)
    if colors.dtype.kind == "f":  # in [0, 1], as some programs write them
        colors = np.rint(np.nan_to_num(colors).clip(0, 1) * 255)
    return points, colors.astype(np.uint8)


def _write_with(path: Path, splats: SplatArrays, settings: WriteSettings) -> None:
    write_ply(path, splats, comments=describe_settings(settings))


FORMAT = SplatFormat(load_ply, _write_with)
