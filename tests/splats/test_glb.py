"""A .glb comes back as it was, and is the same scene in the axes of glTF."""

import json
import struct
from dataclasses import replace

import archive_splats
import numpy as np
import pytest
import torch
from facts import assert_facts, raises
from scenes import camera_at, with_harmonics

from recon_cli.errors import FormatError, InputError
from recon_cli.render.registry import render
from recon_cli.scene.similarity import Similarity
from recon_cli.scene.splats import SH_C0, transformed
from recon_cli.splats.glb import Y_DOWN, Y_UP, Z_UP, load_glb, nearest_axes, pack_glb, write_glb

EXT = "KHR_gaussian_splatting"
EXACT = 1e-6
UNTURNED = np.eye(3)


def parts(path):
    """Returns the JSON and the bytes of a .glb."""
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20:20 + length]), data[28 + length:]


def attribute(path, name):
    value, data = parts(path)
    (primitive,) = value["meshes"][0]["primitives"]
    accessor = value["accessors"][primitive["attributes"][name]]
    view = value["bufferViews"][accessor["bufferView"]]
    kind = {5126: "<f4", 5123: "<u2"}[accessor["componentType"]]
    return np.frombuffer(data[view["byteOffset"]:][:view["byteLength"]], kind).reshape(
        accessor["count"], -1)


def changed(path, edit):
    value, data = parts(path)
    edit(value)
    path.write_bytes(pack_glb(value, data))


def assert_same(splats, back):
    assert torch.equal(back.means, splats.means)  # axes that are swapped and turned round
    assert archive_splats.apart(back.quats, splats.quats).max() < EXACT
    assert torch.equal(back.sh_dc, splats.sh_dc)
    assert len(back.sh_rest) == len(splats.sh_rest)
    torch.testing.assert_close(back.sh_rest, splats.sh_rest, rtol=EXACT, atol=3 * EXACT)
    assert (back.opacities - splats.opacities).abs().max() < EXACT
    # exp and log of float32; below the least number of float32 a Gaussian is flat
    torch.testing.assert_close(
        back.log_scales, splats.log_scales.clamp(min=-87.3366), rtol=EXACT, atol=EXACT)


@pytest.mark.parametrize("axes", [Z_UP, Y_DOWN, UNTURNED])
@pytest.mark.parametrize("make", [
    lambda: archive_splats.extremes(), lambda: archive_splats.room(300)])
def test_a_scene_comes_back_as_it_was(tmp_path, make, axes):
    splats = make()
    write_glb(tmp_path / "a.glb", splats, axes=axes)
    assert_same(splats, load_glb(tmp_path / "a.glb", axes=axes).splats)


@pytest.mark.parametrize("colored", [0, 1, 12, 30])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_any_degree_and_share_comes_back(tmp_path, degree, colored):
    splats = with_harmonics(archive_splats.room(30), degree, colored)
    write_glb(tmp_path / "a.glb", splats)
    back = load_glb(tmp_path / "a.glb").splats
    assert back.sh_degree == (degree if colored else 0)
    assert_same(splats if degree and colored else with_harmonics(splats, 0, 0), back)


def test_what_was_up_is_y(tmp_path):
    splats = archive_splats.splats_of(
        means=[[1, 2, 3]], quats=[[1, 0, 0, 0]], log_scales=[[0, 1, 2]],
        logit_opacities=[0], sh_dc=[[0, 0, 0]], sh_rest=np.zeros((0, 0, 3)))
    write_glb(tmp_path / "a.glb", splats)
    assert attribute(tmp_path / "a.glb", "POSITION").tolist() == [[1, 3, -2]]
    write_glb(tmp_path / "b.glb", splats, axes=Y_DOWN)
    assert attribute(tmp_path / "b.glb", "POSITION").tolist() == [[1, -2, -3]]


def test_the_attributes_are_what_the_extension_says(tmp_path):
    splats = archive_splats.room(40)
    write_glb(tmp_path / "a.glb", splats, axes=UNTURNED)
    found = {name: attribute(tmp_path / "a.glb", f"{EXT}:{name}") for name in (
        "SCALE", "ROTATION", "OPACITY", "SH_DEGREE_0_COEF_0", "SH_DEGREE_1_COEF_2",
        "SH_DEGREE_3_COEF_6")}
    np.testing.assert_allclose(found["SCALE"], splats.scales, rtol=1e-6)
    np.testing.assert_allclose(found["OPACITY"][:, 0], splats.opacities, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(found["ROTATION"], axis=1), 1, atol=1e-6)
    turned = found["ROTATION"][:, [3, 0, 1, 2]]
    assert archive_splats.apart(torch.tensor(turned), splats.quats).max() < EXACT
    np.testing.assert_array_equal(found["SH_DEGREE_0_COEF_0"], splats.sh_dc)
    np.testing.assert_array_equal(found["SH_DEGREE_1_COEF_2"], splats.sh_rest[:, 2])
    np.testing.assert_array_equal(found["SH_DEGREE_3_COEF_6"], splats.sh_rest[:, 14])
    colors = attribute(tmp_path / "a.glb", "COLOR_0")
    shown = (SH_C0 * splats.sh_dc + 0.5).clip(0, 1).double()
    # sRGB into linear light, as glTF has colours of vertices (IEC 61966-2-1)
    linear = torch.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    wanted = torch.cat([linear, splats.opacities[:, None]], dim=1)
    assert colors.dtype == np.float32  # of 16 bits trimesh and MeshLab read the lower 8
    np.testing.assert_allclose(colors, wanted, atol=1e-6)


def test_the_container_is_what_its_format_says(tmp_path):
    splats = archive_splats.room(7)
    write_glb(tmp_path / "a.glb", splats)
    data = (tmp_path / "a.glb").read_bytes()
    value, binary = parts(tmp_path / "a.glb")
    assert struct.unpack_from("<4sII", data) == (b"glTF", 2, len(data))
    assert len(data) % 4 == 0
    assert value["buffers"] == [{"byteLength": len(binary)}]
    assert value["extensionsUsed"] == [EXT]
    (primitive,) = value["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    assert primitive["extensions"][EXT] == {
        "kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    place = value["accessors"][primitive["attributes"]["POSITION"]]
    written = attribute(tmp_path / "a.glb", "POSITION")
    assert place["min"] == written.min(axis=0).tolist()
    assert place["max"] == written.max(axis=0).tolist()
    assert len(data) / len(splats) < 240 + 800


def test_a_camera_that_turns_with_the_world_sees_the_same(tmp_path):
    splats, camera = archive_splats.room(400), camera_at()
    write_glb(tmp_path / "a.glb", splats)
    there = load_glb(tmp_path / "a.glb", axes=UNTURNED).splats  # as the file has it
    turned = Similarity(rotation=Z_UP).camera(camera)
    images = [render(one, at, torch.zeros(3), 3).rgb
              for one, at in ((splats, camera), (there, turned))]
    torch.testing.assert_close(*images, rtol=0, atol=2e-4)
    assert not torch.allclose(images[0], render(there, camera, torch.zeros(3), 3).rgb, atol=0.05)


def test_nodes_place_their_gaussians(tmp_path):
    splats = archive_splats.room(20)
    write_glb(tmp_path / "a.glb", splats, axes=UNTURNED)

    def nest(value):
        value["nodes"] = [
            {"children": [1], "translation": [1, 2, 3], "scale": [2, 2, 2]},
            {"mesh": 0, "rotation": [0, 0, np.sqrt(0.5), np.sqrt(0.5)]}]

    changed(tmp_path / "a.glb", nest)
    back = load_glb(tmp_path / "a.glb", axes=UNTURNED).splats
    wanted = transformed(splats, Similarity(
        2.0, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([1.0, 2, 3])))
    torch.testing.assert_close(back.means, wanted.means, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(back.log_scales, wanted.log_scales, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(back.sh_rest, wanted.sh_rest, rtol=1e-5, atol=1e-6)
    assert archive_splats.apart(back.quats, wanted.quats).max() < EXACT


def test_a_matrix_of_a_node_is_read_by_columns(tmp_path):
    write_glb(tmp_path / "a.glb", archive_splats.room(5), axes=UNTURNED)
    before = load_glb(tmp_path / "a.glb", axes=UNTURNED).splats
    changed(tmp_path / "a.glb", lambda value: value["nodes"][0].update(
        matrix=[0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1, 0, 5, 6, 7, 1]))
    back = load_glb(tmp_path / "a.glb", axes=UNTURNED).splats
    x, y, z = before.means.T
    torch.testing.assert_close(back.means, torch.stack([5 - y, 6 + x, 7 + z], dim=1))


def test_two_primitives_become_one_scene(tmp_path):
    splats = archive_splats.room(20)
    write_glb(tmp_path / "a.glb", splats)

    def twice(value):
        primitive = value["meshes"][0]["primitives"][0]
        plain = {name: at for name, at in primitive["attributes"].items()
                 if "SH_DEGREE" not in name or "DEGREE_0" in name}
        value["meshes"].append({"primitives": [
            {**primitive, "attributes": plain}, {"attributes": {"POSITION": 0}, "mode": 0}]})
        value["nodes"] = [{"mesh": 1}, {"mesh": 0}]
        value["scenes"][0]["nodes"] = [0, 1]

    changed(tmp_path / "a.glb", twice)
    back = load_glb(tmp_path / "a.glb").splats
    assert len(back) == 40
    assert len(back.sh_rest) == 20
    assert_same(splats, back.select(torch.arange(20)))
    assert_same(with_harmonics(splats, 3, 0), back.select(torch.arange(20, 40)))


@pytest.mark.parametrize(("component", "kind", "most"), [(5120, "i1", 127), (5122, "<i2", 32767)])
def test_rotations_in_few_bits_are_read(tmp_path, component, kind, most):
    splats = replace(archive_splats.room(9), sh_rest=torch.zeros(0, 0, 3))
    write_glb(tmp_path / "a.glb", splats, axes=UNTURNED)
    value, data = parts(tmp_path / "a.glb")
    packed = np.rint(archive_splats.unit(splats.quats)[:, [1, 2, 3, 0]].numpy() * most)
    at = value["meshes"][0]["primitives"][0]["attributes"][f"{EXT}:ROTATION"]
    value["accessors"][at] |= {"componentType": component, "normalized": True}
    packed = packed.astype(kind).tobytes()
    value["bufferViews"][at] |= {"byteOffset": len(data), "byteLength": len(packed)}
    value["buffers"][0]["byteLength"] += len(packed)
    (tmp_path / "a.glb").write_bytes(pack_glb(value, data + packed))
    back = load_glb(tmp_path / "a.glb", axes=UNTURNED).splats
    assert archive_splats.apart(back.quats, splats.quats).max() < 1.5 / most


def test_scenes_that_no_file_can_hold_are_refused(tmp_path):
    splats = archive_splats.room(5)
    with raises(InputError, "Gaussians"):
        write_glb(tmp_path / "a.glb", splats.select(torch.arange(0)))
    splats.log_scales[1] = 90
    with raises(InputError, "float32"):
        write_glb(tmp_path / "a.glb", splats)
    splats.log_scales[1] = torch.inf
    with raises(InputError, "log_scales"):
        write_glb(tmp_path / "a.glb", splats)
    assert list(tmp_path.iterdir()) == []


def test_a_file_without_gaussians_is_refused(tmp_path):
    write_glb(tmp_path / "a.glb", archive_splats.room(5))
    changed(tmp_path / "a.glb", lambda value: value["meshes"][0]["primitives"][0].update(
        extensions={}, attributes={"POSITION": 0}))
    with raises(FormatError, "Gaussians") as caught:
        load_glb(tmp_path / "a.glb")
    assert "again" not in caught.value.hint


def test_gaussians_whose_entry_a_program_left_out_are_read_with_a_warning(tmp_path, caplog):
    """gltf-transform and others drop extensions that they do not know, and keep attributes."""
    path, splats = tmp_path / "a.glb", archive_splats.room(40)
    write_glb(path, splats)
    wanted = load_glb(path)
    changed(path, lambda value: (value["meshes"][0]["primitives"][0].pop("extensions"),
                                 value.pop("extensionsUsed")))
    back = load_glb(path)
    for name, value in wanted.splats.parameters().items():
        assert torch.equal(getattr(back.splats, name), value), name
    assert back.up == wanted.up
    assert "KHR_gaussian_splatting" in caplog.text


def test_bytes_behind_the_container_are_left_out_with_a_warning(tmp_path, caplog):
    path = tmp_path / "a.glb"
    write_glb(path, archive_splats.room(5))
    with path.open("ab") as file:
        file.write(b"\n")
    assert len(load_glb(path).splats) == 5
    assert_facts(caplog.text, 1, "bytes", "data")


@pytest.mark.parametrize(("up", "axes"), [
    ([0, 0, 1], Z_UP), ([0, 1, 0], Y_UP), ([0, -1, 0], Y_DOWN), ([0.1, -0.2, 0.97], Z_UP),
    ([0.05, -0.99, 0.1], Y_DOWN)])
def test_axes_go_by_where_up_is(up, axes):
    assert nearest_axes(np.array(up)) is axes


@pytest.mark.parametrize("axes", [Z_UP, Y_DOWN, Y_UP])
def test_a_file_says_which_axes_the_scene_had(axes, tmp_path):
    splats = archive_splats.room(40)
    write_glb(tmp_path / "x.glb", splats, axes=axes)
    back = load_glb(tmp_path / "x.glb").splats
    assert torch.allclose(back.means, splats.means, atol=1e-5)


def test_axes_that_a_file_cannot_name_are_asked_for(tmp_path):
    turned = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    splats = archive_splats.room(40)
    write_glb(tmp_path / "x.glb", splats, axes=turned)
    back = load_glb(tmp_path / "x.glb", axes=turned).splats
    assert torch.allclose(back.means, splats.means, atol=1e-5)
    assert not torch.allclose(load_glb(tmp_path / "x.glb").splats.means, splats.means, atol=0.1)
