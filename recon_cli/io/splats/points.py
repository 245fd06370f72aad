"""A plain coloured point cloud as a .ply: what MeshLab and CloudCompare open."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import InputError
from recon_cli.io.splats.values import arrays, sigmoid
from recon_cli.scene.splats import SH_C0, Splats
from recon_cli.workspace.atomic import write_bytes

MIN_OPACITY = 0.5  # what is fainter is rarely a surface
_ROW = np.dtype([(name, "<f4") for name in "xyz"]
                + [(name, "u1") for name in ("red", "green", "blue")])


def write_points(path: Path, splats: Splats, *, min_opacity: float = MIN_OPACITY) -> int:
    """Writes the centres and plain colours of Gaussians, whole or not at all.

    Args:
        path: of the .ply.
        splats: of which those count that are opaque enough.
        min_opacity: in [0, 1].

    Returns:
        How many points were written.

    Raises:
        InputError: no Gaussian is opaque enough, or a value is not finite.
    """
    table = arrays(splats, ".ply")
    chosen = sigmoid(table["logit_opacities"]) >= min_opacity
    if not chosen.any():
        raise InputError(
            f"None of {len(splats)} Gaussians has an opacity of {min_opacity:g} or more.",
            hint="Ask for a lower one.")
    colors = (SH_C0 * table["sh_dc"][chosen] + 0.5).clip(0, 1)
    write_point_cloud(path, table["means"][chosen], np.rint(colors * 255).astype(np.uint8))
    return int(chosen.sum())


def write_point_cloud(
    path: Path,
    points: NDArray[np.floating],  # [P, 3]
    colors: NDArray[np.uint8],  # [P, 3]
) -> None:
    """Writes points and their RGB colours, whole or not at all: float32 and uchar."""
    rows = np.empty(len(points), _ROW)
    for at, name in enumerate(("x", "y", "z")):
        rows[name] = points[:, at]
    for at, name in enumerate(("red", "green", "blue")):
        rows[name] = colors[:, at]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}",
             *(f"property float {name}" for name in "xyz"),
             *(f"property uchar {name}" for name in ("red", "green", "blue")), "end_header", ""]
    write_bytes(path, "\n".join(lines).encode("ascii") + rows.tobytes())
