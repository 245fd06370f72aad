"""The .ply of INRIA's 3D Gaussian Splatting, and the point cloud of its opaque Gaussians.

It is written as binary little endian float32: x y z nx ny nz f_dc_0..2 f_rest opacity scale_0..2
rot_0..3. f_rest is channel-major, opacity a logit, scale a natural logarithm, rot wxyz. f_rest has
the coefficients of the scene's degree, as INRIA's trainer writes it: f_rest_0..44 at degree 3, to
23 at degree 2, to 8 at degree 1, none at degree 0. Gaussians of degree 0 in a scene of another
have zeros there.

The reader accepts ASCII and both byte orders, float and double, the properties in any order, and
ignores unknown ones. Two infinities that other programs write are made finite: the logit of an
opacity of exactly 0 or 1, and the logarithm of a scale of 0.
"""

from __future__ import annotations

import logging
import math
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from recon_cli.errors import FormatError, InputError
from recon_cli.io.ply_table import Header, read_header, read_tables
from recon_cli.io.splats.values import refuse_not_finite, sigmoid, splats_from_arrays, to_arrays
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
# For an opacity of exactly 1 or 0, which PlayCanvas' splat-transform makes of the bytes 255 and 0:
# the middle of such a step, as `values.decode_opacities` decodes those bytes.
_MAX_LOGIT = math.log(254.75 / 0.25)
# The third log scale of a flat Gaussian, as SuperSplat sets it for files of 2D Gaussian Splatting,
# which lack scale_2: a thousandth of a millimetre in metres.
_FLAT = math.log(1e-6)
MIN_OPACITY = 0.5  # fainter Gaussians are rarely surfaces

logger = logging.getLogger("recon")


def write_ply(path: Path, splats: Splats) -> None:
    """Writes `splats` to `path`, whole or not at all."""
    n = len(splats)
    if not len(splats.sh_rest):
        splats = splats.with_degree(0)
    rest = _REST[: 3 * TERMS[splats.sh_degree]]
    raw = {name: value.detach().cpu().float() for name, value in splats.parameters().items()}
    columns = {
        **raw, "normals": torch.zeros(n, 3),
        "sh_rest": with_rows(raw["sh_rest"], n).transpose(1, 2).reshape(n, len(rest)),
        "logit_opacities": raw["logit_opacities"][:, None],
    }
    table = torch.cat([columns[name] for name in _GROUPS], dim=1).numpy()
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(_header(n, splats.sh_degree))
        file.write(np.ascontiguousarray(table, dtype="<f4").tobytes())


def _properties(sh_degree: int) -> list[str]:
    rest = _REST[: 3 * TERMS[sh_degree]]
    return [name for group in (_GROUPS | {"sh_rest": rest}).values() for name in group]


def _header(n: int, sh_degree: int) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {n}",
             *(f"property float {name}" for name in _properties(sh_degree)), "end_header", ""]
    return "\n".join(lines).encode("ascii")


def max_gaussians(size: int, sh_degree: int) -> int:
    """Returns how many Gaussians of a degree fit into a .ply of `size` bytes."""
    each = 4 * len(_properties(sh_degree))
    count = max(0, (size - len(_header(0, sh_degree))) // each)
    while count and len(_header(count, sh_degree)) + each * count > size:  # the count has digits
        count -= 1
    return count


def read_ply(path: Path) -> Splats:
    """Returns the Gaussians of a .ply as float32 tensors, in the file's order.

    Those after the last one with a coefficient other than zero are of degree 0. Elements besides
    the vertices are ignored. Infinite logits of opacities, scales of 0 and a missing third scale
    become finite, and a warning counts them.

    Raises:
        FormatError: the file is missing, truncated, of another kind of .ply, or holds other values
            that are not finite.
    """
    table = _vertices(read_header(path))
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
    return splats_from_arrays(path, values | {
        "logit_opacities": values["logit_opacities"][:, 0],
        "sh_rest": by_channel.transpose(0, 2, 1)})


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

    Raises:
        InputError: no Gaussian is opaque enough, or a value is not finite.
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
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}",
             *(f"property {kind} {name}" for name, (kind, _) in kinds.items()), "end_header", ""]
    write_bytes(path, "\n".join(lines).encode("ascii") + rows.tobytes())
