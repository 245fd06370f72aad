"""Writing of the mesh and of the plan of its room, and the check of what was written."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.export.coordinate_frame import RoomFrame
from recon_cli.export.measures import measure_room
from recon_cli.export.mesh.build import MeshResult
from recon_cli.export.plan_svg import describe, draw_plan
from recon_cli.export.verify import verify_mesh
from recon_cli.io.meshes import write_mesh
from recon_cli.io.splats.glb import nearest_axes
from recon_cli.workspace.atomic import write_bytes, write_json

MEASURES = "measures.json"

logger = logging.getLogger("recon")


def write_mesh_file(path: Path, result: MeshResult, up: NDArray[np.float64]) -> Path:
    """Writes a mesh and compares what reads back; a .glb gets the axes of glTF."""
    axes = nearest_axes(up) if path.suffix == ".glb" else None
    write_mesh(path, result.mesh, axes=axes)
    verify_mesh(path, result.mesh, axes)
    logger.info("%s: %s", path.name, result.describe())
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
