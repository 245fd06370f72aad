"""Triangle meshes with colours: .ply, .glb and .obj, and their simplification by COLMAP."""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon_cli.errors import FormatError
from recon_cli.io.colmap_library import pycolmap
from recon_cli.workspace.atomic import write_bytes

SUFFIXES = ("ply", "glb", "obj")


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh."""

    vertices: NDArray[np.float64]  # [V, 3]
    faces: NDArray[np.int64]  # [F, 3], counter-clockwise from outside
    colors: NDArray[np.uint8]  # [V, 3] RGB


def write_mesh(path: Path, mesh: Mesh, *, axes: NDArray[np.float64] | None = None) -> None:
    """Writes a mesh in the format of the file's suffix, whole or not at all.

    `axes` [3, 3] are the axes of the file in those of the mesh, as in `glb.write_glb`.
    """
    vertices = mesh.vertices if axes is None else mesh.vertices @ axes.T
    kind = path.suffix[1:].lower()
    whole = trimesh.Trimesh(
        vertices.astype(np.float32), mesh.faces, vertex_colors=mesh.colors, process=False)
    data = whole.export(file_type=kind)
    write_bytes(path, data.encode() if isinstance(data, str) else data)


def read_mesh(path: Path) -> Mesh:
    """Returns the mesh of a file as it is there; FormatError if it is damaged or holds none."""
    try:
        mesh = trimesh.load_mesh(str(path), process=False)
        if isinstance(mesh, trimesh.Scene):
            mesh = mesh.to_mesh()
        vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
        colors = np.asarray(mesh.visual.vertex_colors, np.uint8)[:, :3]
    except Exception as error:  # of trimesh and what it calls, of many kinds
        raise FormatError(f"{path} cannot be read as a mesh: {error}.") from error
    if not len(faces) or not np.isfinite(vertices).all() or faces.max() >= len(vertices):
        raise FormatError(f"{path} holds no triangles, or broken ones.")
    return Mesh(vertices, faces, colors)


def simplify(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], most: int, threads: int
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Returns at most `most` triangles by quadric error metrics (Garland and Heckbert 1997).

    Rims keep their place. Returned as it was if it is small enough.
    """
    if len(faces) <= most:
        return vertices, faces
    with tempfile.TemporaryDirectory(prefix="recon-mesh-") as folder:
        before, after = os.path.join(folder, "before.ply"), os.path.join(folder, "after.ply")
        middle = vertices.mean(axis=0)  # float32 keeps more digits near the origin
        trimesh.Trimesh(vertices - middle, faces, process=False).export(before)
        options = pycolmap.MeshSimplificationOptions()
        options.num_threads = threads
        options.target_face_ratio = most / len(faces)
        level, pycolmap.logging.minloglevel = pycolmap.logging.minloglevel, 2
        try:
            pycolmap.simplify_mesh(before, after, options)
        finally:
            pycolmap.logging.minloglevel = level
        small = trimesh.load_mesh(after, process=False)
    return np.asarray(small.vertices, np.float64) + middle, np.asarray(small.faces, np.int64)
