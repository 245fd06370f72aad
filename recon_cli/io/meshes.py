"""Triangle meshes with colours or a texture: .ply, .glb, .obj; simplification by COLMAP; points."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import FormatError
from recon_cli.io.mesh_data import TINT, Mesh, Texture
from recon_cli.io.mesh_glb import glb_bytes, read_glb
from recon_cli.io.mesh_obj import read_obj, write_obj
from recon_cli.workspace.atomic import write_bytes

__all__ = ["SUFFIXES", "Mesh", "Texture", "read_mesh", "simplify", "write_mesh",
           "write_point_cloud"]

SUFFIXES = ("ply", "glb", "obj")
_INFERRED = "inferred"  # property of the vertices of a .ply


def write_mesh(
    path: Path, mesh: Mesh, *, axes: NDArray[np.float64] | None = None, tint: bool = False
) -> None:
    """Writes a mesh in the format of the file's suffix, each file atomically.

    An .obj also gets an .mtl and its image beside it, if it has a texture or inferred surface; a
    .ply has no texture. `axes` [3, 3] are the axes of the file in those of the mesh, as in
    `glb.write_glb`. `tint` shows what is inferred in blue.
    """
    kind = path.suffix[1:].lower()
    if axes is not None:
        mesh = Mesh(mesh.vertices @ axes.T, mesh.faces, mesh.colors, mesh.inferred, mesh.texture)
    match kind:
        case "glb":
            write_bytes(path, glb_bytes(mesh, TINT if tint else None))
        case "obj":
            write_obj(path, mesh, TINT if tint else None)
        case _:
            write_bytes(path, _ply_bytes(mesh, tint))


def _ply_bytes(mesh: Mesh, tint: bool) -> bytes:
    import trimesh  # half a second, and more with SciPy

    colors = mesh.colors
    if mesh.inferred is not None and tint:
        colors = np.where(
            mesh.inferred[:, None], np.rint(colors * TINT), colors).astype(np.uint8)
    marks = {} if mesh.inferred is None else {_INFERRED: mesh.inferred.astype(np.uint8)}
    whole = trimesh.Trimesh(mesh.vertices.astype(np.float32), mesh.faces, vertex_colors=colors,
                            vertex_attributes=marks, process=False)
    data: bytes = whole.export(file_type="ply")
    return data


def write_point_cloud(
    path: Path, points: NDArray[np.float64], colors: NDArray[np.uint8]
) -> None:
    """Writes points [P, 3] with RGB colours [P, 3] as a .ply, atomically."""
    import trimesh

    write_bytes(path, trimesh.PointCloud(points.astype(np.float32), colors).export(file_type="ply"))


def read_mesh(path: Path) -> Mesh:
    """Returns the mesh of a file as it is there; FormatError if it is damaged or holds none."""
    readers = {".glb": read_glb, ".obj": read_obj}
    try:
        mesh = readers.get(path.suffix.lower(), _read_ply)(path)
    except Exception as error:  # of trimesh and what it calls, of many kinds
        raise FormatError(f"{path} cannot be read as a mesh: {error}.") from error
    if (not len(mesh.faces) or not np.isfinite(mesh.vertices).all() or mesh.faces.min() < 0
            or mesh.faces.max() >= len(mesh.vertices)):
        raise FormatError(f"{path} holds no triangles, or broken ones.")
    return mesh


def _read_ply(path: Path) -> Mesh:
    import trimesh

    mesh = trimesh.load_mesh(str(path), process=False)
    marks = mesh.metadata["_ply_raw"]["vertex"]["data"]
    return Mesh(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64),
                np.asarray(mesh.visual.vertex_colors, np.uint8)[:, :3],
                marks[_INFERRED].reshape(-1) > 0 if _INFERRED in marks.dtype.names else None)


def simplify(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], most: int, threads: int
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Returns at most `most` triangles by quadric error metrics (Garland and Heckbert 1997).

    Rims keep their place. Returned as it was if it is small enough.
    """
    if len(faces) <= most:
        return vertices, faces
    import trimesh

    from recon_cli.io.colmap_library import pycolmap

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
