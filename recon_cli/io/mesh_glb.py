"""Meshes as .glb: colours by vertex or a texture, without lights, and inferred surface apart."""

from __future__ import annotations

import struct
from collections.abc import MutableMapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.io.images import encode_image
from recon_cli.io.mesh_data import Mesh, Texture
from recon_cli.workspace.atomic import parse_json

_UNLIT = "KHR_materials_unlit"  # the photos hold the light of the room already
# Linear light of each sRGB code (IEC 61966-2-1), which glTF wants in COLOR_0: 8 bits would merge
# the dark codes, and of 16 trimesh and MeshLab read the lower 8
_CODES = np.arange(256) / 255
_LIGHT = np.where(
    _CODES <= 0.04045, _CODES / 12.92, ((_CODES + 0.055) / 1.055) ** 2.4).astype(np.float32)
_MIMES = {"png": "image/png", "jpg": "image/jpeg"}
# Linear filters, with mipmaps, without wrapping; codes of WebGL.
_SAMPLER = {"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}
_TYPES = {5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
# trimesh writes colours in 8 bits alone and turns texture coordinates, so both go in as attributes
# of other names
_RENAMED = {"_COLOR": "COLOR_0", "_CORNERS": "TEXCOORD_0"}


def glb_bytes(mesh: Mesh, tint: tuple[float, float, float] | None) -> bytes:
    """Returns a .glb that is shown as it is, without lights.

    Inferred surface is a mesh of its own with the material `inferred`, whose colour is `tint` if
    given, and its vertices have the attribute `_INFERRED` of 1.
    """
    import trimesh

    scene = trimesh.Scene()
    names = []
    for name, part in mesh.parts():
        attributes: dict[str, NDArray[Any]] = {}
        if part.inferred is not None:
            attributes["_INFERRED"] = part.inferred.astype(np.float32)
        if part.texture is not None:
            attributes["_CORNERS"] = part.texture.corners.astype(np.float32)
        else:
            opaque = np.ones((len(part.colors), 1), np.float32)
            attributes["_COLOR"] = np.concatenate([_LIGHT[part.colors], opaque], axis=1)
        scene.add_geometry(trimesh.Trimesh(
            part.vertices.astype(np.float32), part.faces, vertex_attributes=attributes,
            process=False), geom_name=name, node_name=name)
        names.append(name)

    def add_image(buffers: MutableMapping[Any, bytes], tree: dict[str, Any]) -> None:
        if mesh.texture is None:
            return
        data = encode_image(mesh.texture.image, mesh.texture.kind)
        buffers["image"] = data + bytes(-len(data) % 4)
        tree["images"] = [
            {"bufferView": len(buffers) - 1, "mimeType": _MIMES[mesh.texture.kind]}]
        tree["samplers"] = [_SAMPLER]
        tree["textures"] = [{"source": 0, "sampler": 0}]

    def add_materials(tree: dict[str, Any]) -> None:
        for number, row in enumerate(tree["meshes"]):
            primitive = row["primitives"][0]
            attributes = primitive["attributes"]
            for name in set(attributes) & _RENAMED.keys():
                attributes[_RENAMED[name]] = attributes.pop(name)
            primitive["material"] = number
        tree["materials"] = [_material(name, mesh.texture, tint) for name in names]
        tree["extensionsUsed"] = [*tree.get("extensionsUsed", ()), _UNLIT]

    data: bytes = trimesh.exchange.gltf.export_glb(
        scene, buffer_postprocessor=add_image, tree_postprocessor=add_materials)
    return data


def _material(
    name: str, texture: Texture | None, tint: tuple[float, float, float] | None
) -> dict[str, Any]:
    look: dict[str, Any] = {"metallicFactor": 0, "roughnessFactor": 1}  # not metal, as by default
    if texture is not None:
        look["baseColorTexture"] = {"index": 0}
    if name == "inferred" and tint is not None:
        look["baseColorFactor"] = [*tint, 1.0]
    return {"name": name, "pbrMetallicRoughness": look, "extensions": {_UNLIT: {}}}


def read_glb(path: Path) -> Mesh:
    """Returns the mesh of a .glb as `glb_bytes` writes it; errors of many kinds if it is none."""
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    tree = parse_json(data[20:20 + length], dict)
    start = 28 + length

    def values(number: int) -> NDArray[Any]:
        accessor = tree["accessors"][number]
        view = tree["bufferViews"][accessor["bufferView"]]
        width = _WIDTHS[accessor["type"]]
        found = np.frombuffer(
            data, _TYPES[accessor["componentType"]], width * accessor["count"],
            start + view.get("byteOffset", 0) + accessor.get("byteOffset", 0))
        if accessor.get("normalized"):
            found = found / np.iinfo(found.dtype).max
        return found.reshape(-1, width) if width > 1 else found

    columns: dict[str, list[NDArray[Any]]] = {}
    faces, count = [], 0
    for row in tree["meshes"]:
        primitive = row["primitives"][0]
        faces.append(values(primitive["indices"]).reshape(-1, 3).astype(np.int64) + count)
        for name, number in primitive["attributes"].items():
            columns.setdefault(name, []).append(values(number))
        count += len(columns["POSITION"][-1])
    found = {name: np.concatenate(parts) for name, parts in columns.items()}
    texture = None
    if "TEXCOORD_0" in found:
        [image] = tree["images"]
        view = tree["bufferViews"][image["bufferView"]]
        first = start + view.get("byteOffset", 0)
        pixels: NDArray[np.uint8] = np.asarray(cv2.imdecode(
            np.frombuffer(data, np.uint8, view["byteLength"], first), cv2.IMREAD_COLOR), np.uint8)
        kind = next(kind for kind, mime in _MIMES.items() if mime == image["mimeType"])
        texture = Texture(np.ascontiguousarray(pixels[:, :, ::-1]), found[
            "TEXCOORD_0"].astype(np.float64), kind)
    colors = (_codes(found["COLOR_0"][:, :3]) if "COLOR_0" in found
              else np.zeros((count, 3), np.uint8))
    marks = found["_INFERRED"] > 0 if "_INFERRED" in found else None
    return Mesh(found["POSITION"].astype(np.float64), np.concatenate(faces), colors, marks, texture)


def _codes(light: NDArray[np.floating[Any]]) -> NDArray[np.uint8]:
    """Returns the sRGB codes of linear light, which trimesh would round to 8 bits."""
    middles = (_LIGHT[1:].astype(np.float64) + _LIGHT[:-1]) / 2
    return np.searchsorted(middles, light).astype(np.uint8)
