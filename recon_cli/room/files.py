"""Writing of the mesh and of the plan of its room, and the check of the written files."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import WorkspaceError, name_command
from recon_cli.io.meshes import Mesh, read_mesh, write_mesh
from recon_cli.room.measures import RoomFrame, measure_room
from recon_cli.room.mesh import MeshResult
from recon_cli.room.plan_svg import describe, draw_plan
from recon_cli.scene.statistics import ROUNDING
from recon_cli.splats.glb import nearest_axes
from recon_cli.workspace.atomic import write_bytes, write_json
from recon_cli.workspace.export_formats import MEASURES

logger = logging.getLogger("recon")


def write_mesh_file(
    path: Path, mesh: Mesh, up: NDArray[np.float64], *, tint: bool = False
) -> Path:
    """Writes a mesh, reads it back and compares; a .glb and an .obj get the axes of glTF.

    Blender and game engines take y for up in an .obj as well.
    """
    axes = nearest_axes(up) if path.suffix in (".glb", ".obj") else None
    write_mesh(path, mesh, axes=axes, tint=tint)
    _verify_mesh(path, mesh, axes, tint)
    return path


def write_plan(
    out: Path, result: MeshResult, centers: NDArray[np.float64], frame: RoomFrame
) -> Path:
    """Writes plan.svg and measures.json; `centers` [C, 3] are the cameras in the exported world."""
    measures = measure_room(result.mesh, result.planes, centers, frame.up, frame.scale_error)
    write_json(out / MEASURES, measures.to_json())
    write_bytes(out / "plan.svg", draw_plan(measures).encode())
    for line in describe(measures):
        logger.info("%s", line)
    return out / "plan.svg"


def _verify_mesh(
    path: Path, mesh: Mesh, axes: NDArray[np.float64] | None, tint: bool
) -> None:
    """Raises WorkspaceError unless a file reads back as this mesh, in the axes of the file."""
    back = read_mesh(path)
    vertices = mesh.vertices if axes is None else mesh.vertices @ axes.T
    size = float(np.abs(vertices).max())
    same = (np.array_equal(back.faces, mesh.faces) and back.vertices.shape == vertices.shape
            and np.abs(back.vertices - vertices).max() <= ROUNDING * size
            and _same_look(back, mesh, tint and path.suffix == ".ply"))
    if not same:
        raise WorkspaceError(
            f"{path} does not read back as the mesh that was written.",
            hint=f"Check the disk, then run {name_command('export --again')}.")


def _same_look(back: Mesh, mesh: Mesh, tinted: bool) -> bool:
    """Returns whether marks and either texture or colours are the same; `tinted` ones may differ.

    A .jpg has other pixels, and a .ply has no texture.
    """
    marks, marked = (
        np.zeros(len(each.vertices), bool) if each.inferred is None else each.inferred
        for each in (back, mesh))
    if not np.array_equal(marks, marked):
        return False
    if back.texture is not None and mesh.texture is not None:
        image, other = back.texture.image, mesh.texture.image
        return bool(image.shape == other.shape
                    and np.abs(back.texture.corners - mesh.texture.corners).max() <= ROUNDING
                    and (mesh.texture.kind != "png" or np.array_equal(image, other)))
    seen = ~mesh.inferred if tinted and mesh.inferred is not None else slice(None)
    return bool(np.abs(back.colors[seen].astype(int) - mesh.colors[seen]).max() <= 1)
