"""Points with colours from a .ply, ASCII or binary of either byte order; faces are passed over."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import FormatError
from recon_cli.io.ply_table import Header, read_first_table, read_header

_PLACE, _COLOR = ("x", "y", "z"), ("red", "green", "blue")


def read_ply_points(path: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8] | None]:
    """Returns positions [P, 3] and RGB colours [P, 3], None where the file has no colours.

    Raises:
        FormatError: the file is missing, truncated, no .ply, or holds a place that is not finite.
    """
    rows = _rows(read_header(path))
    points = np.stack([rows[name].astype(np.float64) for name in _PLACE], axis=1)
    if not np.isfinite(points).all():
        raise FormatError(f"{path} holds a point that is not finite.")
    if not set(_COLOR) <= set(rows.dtype.names or ()):
        return points, None
    colors = np.stack([rows[name] for name in _COLOR], axis=1)
    if colors.dtype.kind == "f":  # in [0, 1], as some programs write them
        colors = np.rint(np.nan_to_num(colors).clip(0, 1) * 255)
    return points, colors.astype(np.uint8)


def _rows(header: Header) -> NDArray[np.void]:
    first = header.elements[0].name
    if first != "vertex":
        raise FormatError(f"{header.path} does not begin with points, but with {first}.")
    rows = read_first_table(header)
    names = rows.dtype.names or ()
    if not set(_PLACE) <= set(names):
        raise FormatError(f"{header.path} has points with the properties {', '.join(names)}.")
    return rows
