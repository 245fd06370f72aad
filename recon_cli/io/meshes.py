"""Triangle meshes with colours: .ply, .glb and .obj, their simplification by COLMAP; points."""

from __future__ import annotations

import os
import struct
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon_cli.errors import FormatError
from recon_cli.io.colmap_library import pycolmap
from recon_cli.workspace.atomic import parse_json, write_bytes

SUFFIXES = ("ply", "glb", "obj")
_UNLIT = "KHR_materials_unlit"  # the photos hold the light of the room already
# Linear light of each sRGB code (IEC 61966-2-1), which glTF wants in COLOR_0, in 16 bits: 8 would
# merge the dark codes
_CODES = np.arange(256) / 255
_LIGHT = np.rint(65535 * np.where(
    _CODES <= 0.04045, _CODES / 12.92, ((_CODES + 0.055) / 1.055) ** 2.4)).astype(np.uint16)


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh."""

    vertices: NDArray[np.float64]  # [V, 3]
    faces: NDArray[np.int64]  # [F, 3], counter-clockwise from outside
    colors: NDArray[np.uint8]  # [V, 3] RGB


def write_mesh(path: Path, mesh: Mesh, *, axes: NDArray[np.float64] | None = None) -> None:
    """Writes a mesh in the format of the file's suffix, atomically.

    `axes` [3, 3] are the axes of the file in those of the mesh, as in `glb.write_glb`.
    """
    vertices = mesh.vertices if axes is None else mesh.vertices @ axes.T
    kind, places = path.suffix[1:].lower(), vertices.astype(np.float32)
    if kind == "glb":
        write_bytes(path, _glb_bytes(places, mesh.faces, mesh.colors))
        return
    whole = trimesh.Trimesh(places, mesh.faces, vertex_colors=mesh.colors, process=False)
    data = whole.export(file_type=kind)
    write_bytes(path, data.encode() if isinstance(data, str) else data)


def _glb_bytes(
    vertices: NDArray[np.float32], faces: NDArray[np.int64], colors: NDArray[np.uint8]
) -> bytes:
    """Returns a .glb whose colours are shown as they are, without lights.

    trimesh writes colours in 8 bits alone, so they go in as an attribute that is renamed.
    """
    opaque = np.full((len(colors), 1), 65535, np.uint16)
    light = np.concatenate([_LIGHT[colors], opaque], axis=1)
    whole = trimesh.Trimesh(
        vertices, faces, vertex_attributes={"_COLOR_0": light}, process=False)

    def add_material(tree: dict[str, Any]) -> None:
        primitive = tree["meshes"][0]["primitives"][0]
        primitive["attributes"]["COLOR_0"] = primitive["attributes"].pop("_COLOR_0")
        tree["accessors"][primitive["attributes"]["COLOR_0"]]["normalized"] = True
        primitive["material"] = 0
        tree["materials"] = [{  # not metallic, as the default would be
            "pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1},
            "extensions": {_UNLIT: {}}}]
        tree["extensionsUsed"] = [*tree.get("extensionsUsed", ()), _UNLIT]

    data: bytes = trimesh.exchange.gltf.export_glb(
        trimesh.Scene(whole), tree_postprocessor=add_material)
    return data


def write_point_cloud(
    path: Path, points: NDArray[np.float64], colors: NDArray[np.uint8]
) -> None:
    """Writes points [P, 3] with RGB colours [P, 3] as a .ply, atomically."""
    write_bytes(path, trimesh.PointCloud(points.astype(np.float32), colors).export(file_type="ply"))


def read_mesh(path: Path) -> Mesh:
    """Returns the mesh of a file as it is there; FormatError if it is damaged or holds none."""
    try:
        mesh = trimesh.load_mesh(str(path), process=False)
        if isinstance(mesh, trimesh.Scene):
            mesh = mesh.to_mesh()
        vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
        colors = (_read_glb_colors(path) if path.suffix.lower() == ".glb" else
                  np.asarray(mesh.visual.vertex_colors, np.uint8)[:, :3])
    except Exception as error:  # of trimesh and what it calls, of many kinds
        raise FormatError(f"{path} cannot be read as a mesh: {error}.") from error
    if not len(faces) or not np.isfinite(vertices).all() or faces.max() >= len(vertices):
        raise FormatError(f"{path} holds no triangles, or broken ones.")
    return Mesh(vertices, faces, colors)


def _read_glb_colors(path: Path) -> NDArray[np.uint8]:
    """Returns the colours [V, 3] of a .glb as `_glb_bytes` writes it: trimesh rounds to 8 bits."""
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    tree = parse_json(data[20:20 + length], dict)
    accessor = tree["accessors"][tree["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    view = tree["bufferViews"][accessor["bufferView"]]
    start = 28 + length + view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    light = np.frombuffer(data, "<u2", 4 * accessor["count"], start).reshape(-1, 4)[:, :3]
    after = np.searchsorted(_LIGHT, light).clip(1, 255)
    below = light - _LIGHT[after - 1].astype(int) < _LIGHT[after].astype(int) - light
    return np.asarray(after - below, np.uint8)


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
