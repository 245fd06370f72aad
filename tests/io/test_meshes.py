"""Meshes come back as they were, and are simplified to what was asked for."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest
import trimesh

from recon_cli.errors import FormatError
from recon_cli.io.meshes import SUFFIXES, Mesh, read_mesh, simplify, write_mesh
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
    assert (accessor["componentType"], accessor["type"], accessor["normalized"]) == (
        5123, "VEC4", True)
    start = gltf["bufferViews"][accessor["bufferView"]]["byteOffset"]
    stored = np.frombuffer(data, "<u2", 4 * 256, 28 + length + start).reshape(-1, 4) / 65535
    share = codes / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    assert np.abs(stored[:, :3] - linear).max() <= 0.5 / 65535 + 1e-9
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
