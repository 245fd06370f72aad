"""Meshes come back as they were, and are simplified to what was asked for."""

from __future__ import annotations

import json
import struct
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from recon_cli.errors import FormatError
from recon_cli.io.mesh_data import TINT, joined
from recon_cli.io.meshes import SUFFIXES, Mesh, Texture, read_mesh, simplify, write_mesh
from recon_cli.room.files import write_mesh_file
from recon_cli.splats.glb import Z_UP

pytestmark = pytest.mark.floors


def ball(subdivisions: int = 3) -> Mesh:
    sphere = trimesh.creation.icosphere(subdivisions)
    colors = np.rint(127 + 120 * sphere.vertices).astype(np.uint8)
    return Mesh(np.asarray(sphere.vertices) + 5, np.asarray(sphere.faces, np.int64), colors)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_mesh_comes_back_with_its_colours(suffix, tmp_path):
    mesh = ball()
    path = tmp_path / f"mesh.{suffix}"
    write_mesh(path, mesh)
    back = read_mesh(path)
    assert np.allclose(back.vertices, mesh.vertices, atol=1e-5)
    assert np.array_equal(back.faces, mesh.faces)
    assert np.abs(back.colors.astype(int) - mesh.colors).max() <= 1


def test_a_glb_is_in_the_axes_of_gltf(tmp_path):
    write_mesh(tmp_path / "mesh.glb", ball(), axes=Z_UP)
    data = (tmp_path / "mesh.glb").read_bytes()
    length, kind = struct.unpack_from("<I4s", data, 12)
    assert (data[:4], kind) == (b"glTF", b"JSON")
    gltf = json.loads(data[20:20 + length])
    primitive = gltf["meshes"][0]["primitives"][0]
    assert {"POSITION", "COLOR_0"} <= primitive["attributes"].keys()
    assert np.allclose(read_mesh(tmp_path / "mesh.glb").vertices, ball().vertices @ Z_UP.T)


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("up", [[0, 0, 1], [0, -1, 0], [0, 1, 0]])
def test_up_is_y_in_a_glb_and_an_obj_as_in_the_scene_in_a_ply(tmp_path, suffix, up):
    mesh, up = ball(), np.array(up, float)
    path = write_mesh_file(tmp_path / f"mesh.{suffix}", mesh, up)
    wanted = mesh.vertices @ up  # heights
    found = read_mesh(path).vertices @ (up if suffix == "ply" else np.array([0, 1, 0]))
    assert np.allclose(found, wanted, atol=1e-5)


def test_a_glb_holds_linear_colours_that_no_light_changes(tmp_path):
    faces = np.array([[i, i + 1, i + 2] for i in range(0, 255, 3)])
    codes = np.arange(256).repeat(3).reshape(-1, 3).astype(np.uint8)
    codes[:, 1] = codes[::-1, 1]
    places = np.random.default_rng(0).normal(size=(256, 3))
    write_mesh(tmp_path / "mesh.glb", Mesh(places, faces, codes))
    data = (tmp_path / "mesh.glb").read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    gltf = json.loads(data[20:20 + length])
    primitive = gltf["meshes"][0]["primitives"][0]
    accessor = gltf["accessors"][primitive["attributes"]["COLOR_0"]]
    assert (accessor["componentType"], accessor["type"]) == (5126, "VEC4")
    start = gltf["bufferViews"][accessor["bufferView"]]["byteOffset"]
    stored = np.frombuffer(data, "<f4", 4 * 256, 28 + length + start).reshape(-1, 4)
    share = codes / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    assert np.abs(stored[:, :3] - linear).max() <= 1e-7
    # as a second reader has them
    [read] = trimesh.load(tmp_path / "mesh.glb", process=False).geometry.values()
    read = read.visual.vertex_attributes["color"]
    assert np.abs(read[:, :3] - linear).max() <= 1e-7
    assert (stored[:, 3] == 1).all()
    material = gltf["materials"][primitive["material"]]
    assert material["extensions"] == {"KHR_materials_unlit": {}}
    assert material["pbrMetallicRoughness"]["metallicFactor"] == 0
    assert gltf["extensionsUsed"] == ["KHR_materials_unlit"]
    assert np.array_equal(read_mesh(tmp_path / "mesh.glb").colors, codes)  # dark ones, too


@pytest.mark.parametrize("content", [b"", b"ply\n", b"glTF" + bytes(40), b"v 1 2\nf 1 2 9\n"])
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_damaged_mesh_is_refused(content, suffix, tmp_path):
    path = tmp_path / f"mesh.{suffix}"
    path.write_bytes(content)
    with pytest.raises(FormatError):
        read_mesh(path)


def test_simplified_triangles_stay_on_the_surface():
    mesh = ball(4)
    vertices, faces = simplify(mesh.vertices, mesh.faces, 500, threads=1)
    assert 300 < len(faces) <= 500
    assert np.abs(np.linalg.norm(vertices - 5, axis=1) - 1).max() < 0.03
    same = simplify(mesh.vertices, mesh.faces, len(mesh.faces), threads=1)
    assert same == (mesh.vertices, mesh.faces)


def test_few_triangles_are_as_many_as_were_asked_for():
    mesh = ball()
    vertices, faces = simplify(mesh.vertices, mesh.faces, 10, threads=1)
    assert 0 < len(faces) <= 10
    assert faces.max() < len(vertices)


def plate(z: float, inferred: bool, size: int = 8) -> Mesh:
    """A textured square whose vertices all have a place of their own in the image."""
    vertices = np.array([[0, 0, z], [1, 0, z], [1, 1, z], [0, 1, z]], float)
    image = np.random.default_rng(1).integers(0, 256, (size, size, 3)).astype(np.uint8)
    image = np.kron(image, np.ones((16, 16, 1), np.uint8))  # what .jpg keeps, too
    return Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]]), np.full((4, 3), 200, np.uint8),
                np.full(4, inferred), Texture(image, vertices[:, :2] * (0.5, 0.25) + 0.125))


def walls(kind: str = "png") -> Mesh:
    """A square that views show, and one that is inferred."""
    one, other = plate(0.0, False), plate(1.0, True)
    both = joined(one, other)
    corners = np.concatenate([one.texture.corners, other.texture.corners[::-1]])
    return replace(both, texture=Texture(one.texture.image, corners, kind))


@pytest.mark.parametrize("kind", ["png", "jpg"])
@pytest.mark.parametrize("suffix", ["glb", "obj"])
def test_a_texture_comes_back_with_its_places(suffix, kind, tmp_path):
    mesh = walls(kind)
    write_mesh(tmp_path / f"mesh.{suffix}", mesh)
    back = read_mesh(tmp_path / f"mesh.{suffix}")
    assert np.array_equal(back.faces, mesh.faces)
    assert np.allclose(back.vertices, mesh.vertices)
    assert np.allclose(back.texture.corners, mesh.texture.corners, atol=1e-6)
    off = np.abs(back.texture.image.astype(int) - mesh.texture.image)
    assert off.max() == 0 if kind == "png" else off.mean() < 8
    assert back.texture.kind == kind
    assert back.inferred.tolist() == [False] * 4 + [True] * 4


@pytest.mark.skipif(
    not hasattr(trimesh, "load_scene"), reason="older versions join the materials of an .obj")
@pytest.mark.parametrize("suffix", ["glb", "obj"])
def test_trimesh_reads_texture_and_inferred_surface_by_name(suffix, tmp_path):
    mesh = walls()
    path = tmp_path / f"mesh.{suffix}"
    write_mesh(path, mesh, tint=True)
    scene = trimesh.load_scene(str(path), process=False)
    parts = {part.visual.material.name: part for part in scene.geometry.values()}
    assert sorted(parts) == ["inferred", "surface"]
    for part, row in ((parts["surface"], 0), (parts["inferred"], 1)):
        corners = mesh.texture.corners[4 * row:4 * row + 4]
        places = mesh.vertices[4 * row:4 * row + 4]
        nearest = [int(np.linalg.norm(places - vertex, axis=1).argmin())
                   for vertex in part.vertices]
        assert np.allclose(part.visual.uv[:, 0], corners[nearest, 0], atol=1e-6)
        assert np.allclose(1 - part.visual.uv[:, 1], corners[nearest, 1], atol=1e-6)
        material = part.visual.material
        image = getattr(material, "baseColorTexture", None) or material.image
        assert np.array_equal(np.asarray(image.convert("RGB")), mesh.texture.image)


def test_inferred_surface_is_marked_and_tinted_in_a_ply(tmp_path):
    path = tmp_path / "mesh.ply"
    write_mesh(path, walls(), tint=True)
    back = read_mesh(path)
    assert back.inferred.tolist() == [False] * 4 + [True] * 4
    assert (back.colors[:4] == 200).all()
    assert (back.colors[4:] == np.rint(np.multiply(200, TINT))).all()


def test_the_tint_of_a_glb_is_in_the_material_alone(tmp_path):
    for tint in (False, True):
        write_mesh(tmp_path / "mesh.glb", walls(), tint=tint)
        data = (tmp_path / "mesh.glb").read_bytes()
        (length,) = struct.unpack_from("<I", data, 12)
        surface, inferred = json.loads(data[20:20 + length])["materials"]
        assert "baseColorFactor" not in surface["pbrMetallicRoughness"]
        assert ("baseColorFactor" in inferred["pbrMetallicRoughness"]) == tint
        assert read_mesh(tmp_path / "mesh.glb").texture is not None
