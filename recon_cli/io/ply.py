"""The .ply of INRIA's 3D Gaussian Splatting, which viewers agree on.

Binary little endian, float32: x y z nx ny nz f_dc_0..2 f_rest opacity scale_0..2 rot_0..3. f_rest
is channel-major, opacity a logit, scale a natural logarithm, rot wxyz. Of f_rest there is what the
scene's degree needs, as INRIA's trainer writes it: f_rest_0..44 at degree 3, up to 23 at degree 2,
up to 8 at degree 1, none at degree 0. Gaussians of degree 0 in a scene of another have zeros there.

Reading takes the properties in any order and ignores those that it does not know.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from recon_cli.atomic import replacing
from recon_cli.errors import FormatError
from recon_cli.scene.splats import TERMS, Splats, with_rows

_HEADER_LIMIT = 1 << 16  # bytes; a header that does not end by then is none
_TYPES = {
    "char": "i1", "uchar": "u1", "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4",
    "float": "<f4", "double": "<f8", "int8": "i1", "uint8": "u1", "int16": "<i2", "uint16": "<u2",
    "int32": "<i4", "uint32": "<u4", "float32": "<f4", "float64": "<f8",
}
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


def most_gaussians(size: int, sh_degree: int) -> int:
    """Returns how many Gaussians fit into a .ply of `size` bytes; 0 where not even one does.

    Args:
        size: of the file.
        sh_degree: of the Gaussians.
    """
    each = 4 * len(_properties(sh_degree))
    count = max(0, (size - len(_header(0, sh_degree))) // each)
    while count and len(_header(count, sh_degree)) + each * count > size:  # the count has digits
        count -= 1
    return count


def read_ply(path: Path) -> Splats:
    """Returns the Gaussians of a .ply as float32 tensors, in the file's order.

    Those behind the last one that has a coefficient other than zero are of degree 0.

    Raises:
        FormatError: the file is missing, truncated, of another kind of .ply, or holds values that
            are not finite.
    """
    try:
        with path.open("rb") as file:
            head = file.read(_HEADER_LIMIT)
            count, kind, offset = _parse_header(head, path)
            file.seek(offset)
            data = file.read()
    except OSError as error:
        raise FormatError(f"{path} cannot be read: {error}.") from error
    if len(data) != count * kind.itemsize:
        raise FormatError(
            f"{path} promises {count} Gaussians of {kind.itemsize} bytes but holds {len(data)} "
            "bytes of data: it is truncated or damaged.", hint="Write or copy the file again.")
    table = np.frombuffer(data, dtype=kind)
    return _to_splats(table, path)


def _parse_header(head: bytes, path: Path) -> tuple[int, np.dtype[np.void], int]:
    """Returns the vertex count, the row type and where the data begin."""
    end = head.find(b"end_header\n")
    if not head.startswith(b"ply") or end < 0:
        raise FormatError(f"{path} is no .ply file.")
    lines = [line.split() for line in head[:end].decode("ascii", "replace").splitlines()]
    lines = [line for line in lines if line and line[0] not in ("comment", "obj_info", "ply")]
    if ["format", "binary_little_endian", "1.0"] not in lines:
        raise FormatError(
            f"{path} is not binary little endian.", hint="Convert it in the program it came from.")
    elements = [line for line in lines if line[0] == "element"]
    properties = [line for line in lines if line[0] == "property"]
    if len(elements) != 1 or elements[0][1:2] != ["vertex"] or not elements[0][-1].isdigit():
        raise FormatError(f"{path} holds other elements than vertices: a mesh, not Gaussians.")
    if any(len(line) != 3 or line[1] not in _TYPES for line in properties):
        raise FormatError(f"{path} holds properties of a type that Gaussians do not have.")
    names = [line[2] for line in properties]
    if len(set(names)) != len(names):
        raise FormatError(f"{path} names a property twice.")
    kind = np.dtype([(line[2], _TYPES[line[1]]) for line in properties])
    return int(elements[0][-1]), kind, end + len(b"end_header\n")


def _to_splats(table: NDArray[np.void], path: Path) -> Splats:
    present = set(table.dtype.names or ())
    rest = [name for name in _REST if name in present]
    if len(rest) not in [3 * terms for terms in TERMS] or rest != _REST[: len(rest)]:
        raise FormatError(
            f"{path} has {len(rest)} f_rest properties; 0, 9, 24 or 45, numbered from 0, make a "
            "degree.")
    needed = [name for group, names in _GROUPS.items() if group not in ("normals", "sh_rest")
              for name in names]
    missing = [name for name in needed if name not in present]
    if missing:
        raise FormatError(f"{path} lacks the properties {', '.join(missing)}: no Gaussians.")

    def columns(names: list[str]) -> NDArray[np.float32]:
        if not names:
            return np.zeros((len(table), 0), np.float32)
        return np.stack([table[name].astype(np.float32) for name in names], axis=1)

    values = {name: columns(_GROUPS[name])
              for name in ("means", "quats", "log_scales", "logit_opacities", "sh_dc")}
    values["logit_opacities"] = values["logit_opacities"][:, 0]
    by_channel = columns(rest).reshape(len(table), 3, len(rest) // 3)
    colored = np.flatnonzero(by_channel.any(axis=(1, 2)))
    count = colored[-1] + 1 if len(colored) else 0
    values["sh_rest"] = by_channel[:count].transpose(0, 2, 1)
    bad = [name for name, value in values.items() if not np.isfinite(value).all()]
    if bad:
        raise FormatError(f"{path} holds values that are not finite in {', '.join(bad)}.")
    return Splats(**{name: torch.from_numpy(value.copy()) for name, value in values.items()})
