"""Meshes as .obj, with the .mtl and the image of a texture beside it."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.io.images import decode_file, encode_image
from recon_cli.io.mesh_data import Mesh, Texture
from recon_cli.workspace.atomic import write_bytes


def write_obj(path: Path, mesh: Mesh, tint: tuple[float, float, float] | None) -> None:
    """Writes a mesh; `tint` is the colour of the material `inferred`."""
    texture, text = mesh.texture, io.StringIO()
    library, image = path.with_suffix(".mtl"), None
    if texture is not None:
        image = path.with_suffix(f".{texture.kind}")
        write_bytes(image, encode_image(texture.image, texture.kind))
    materials = texture is not None or mesh.inferred is not None
    if materials:
        text.write(f"mtllib {library.name}\n")
    rows = np.concatenate([mesh.vertices.astype(np.float32), mesh.colors / 255], axis=1)
    np.savetxt(text, rows, "v %.9g %.9g %.9g %.6f %.6f %.6f")
    if texture is not None:
        np.savetxt(text, texture.corners * (1, -1) + (0, 1), "vt %.8f %.8f")
    inferred = mesh.inferred_faces
    for name, chosen in (("surface", ~inferred), ("inferred", inferred)):
        if not chosen.any():
            continue
        if materials:
            text.write(f"g {name}\nusemtl {name}\n")
        numbers = mesh.faces[chosen] + 1
        if texture is not None:
            np.savetxt(text, numbers.repeat(2, axis=1), "f %d/%d %d/%d %d/%d")
        else:
            np.savetxt(text, numbers, "f %d %d %d")
    if materials:
        names = ["surface", *(["inferred"] if inferred.any() else [])]
        write_bytes(library, _library(
            names, image.name if image else None, tint).encode())
    write_bytes(path, text.getvalue().encode())


def _library(
    names: Sequence[str], image: str | None, tint: tuple[float, float, float] | None
) -> str:
    lines = []
    for name in names:
        red, green, blue = tint if tint is not None and name == "inferred" else (1.0, 1.0, 1.0)
        # illum 0: the colour itself, without lights
        lines += [f"newmtl {name}", "illum 0", f"Kd {red:g} {green:g} {blue:g}"]
        lines += [f"map_Kd {image}"] if image else []
    return "\n".join(lines) + "\n"


def read_obj(path: Path) -> Mesh:
    """Returns the mesh of an .obj as `write_obj` writes it; errors of many kinds if it is none."""
    kinds: dict[str, list[str]] = {"v": [], "vt": [], "f": []}
    materials: list[int] = []  # faces that were there when one began
    names: list[str] = []
    for line in path.read_text(encoding="utf-8").splitlines():
        kind, _, rest = line.partition(" ")
        if kind in kinds:
            kinds[kind].append(rest)
        elif kind == "usemtl":
            names.append(rest)
            materials.append(len(kinds["f"]))
    vertices = _numbers(kinds["v"], 6)
    faces = _numbers([line.replace("/", " ") for line in kinds["f"]], 6 if kinds["vt"] else 3)
    if len(faces) and not (faces >= 1).all() & (faces <= np.iinfo(np.int32).max).all():
        raise ValueError("numbers of vertices are broken")
    faces = faces[:, ::2] if kinds["vt"] else faces
    triangles = faces.astype(np.int64) - 1
    marks = None
    if "inferred" in names:
        marks = np.zeros(len(vertices), bool)
        for name, first, last in zip(names, materials, [*materials[1:], len(faces)], strict=True):
            if name == "inferred":
                marks[triangles[first:last]] = True
    texture = _read_texture(path, _numbers(kinds["vt"], 2)) if kinds["vt"] else None
    return Mesh(vertices[:, :3], triangles, np.rint(255 * vertices[:, 3:]).astype(np.uint8), marks,
                texture)


def _numbers(lines: Sequence[str], width: int) -> NDArray[np.float64]:
    """Returns a row of `width` numbers of each line."""
    return np.array(" ".join(lines).split(), np.float64).reshape(len(lines), width)


def _read_texture(path: Path, corners: NDArray[np.float64]) -> Texture:
    library = path.with_suffix(".mtl").read_text(encoding="utf-8")
    [name] = {line.partition(" ")[2] for line in library.splitlines() if line.startswith("map_Kd")}
    pixels = decode_file(path.with_name(name), cv2.IMREAD_COLOR)
    if pixels is None:
        raise ValueError(f"{name} is not an image")
    return Texture(np.ascontiguousarray(pixels[:, :, ::-1]), corners * (1, -1) + (0, 1),
                   Path(name).suffix[1:])
