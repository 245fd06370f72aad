"""A .glb that lies about anything is refused, before memory is taken for the lie."""

import contextlib
import json
import struct
import warnings

import archive_splats
import damage
import numpy as np
import pytest
import torch
from examples import examples
from facts import assert_facts, raises
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from recon_cli.errors import FormatError
from recon_cli.splats.glb import load_glb, pack_glb, write_glb

EXT = "KHR_gaussian_splatting"
COUNT = 20


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """The JSON and the binary chunk of a file."""
    path = tmp_path_factory.mktemp("glb") / "a.glb"
    write_glb(path, archive_splats.room(COUNT, degree=1))
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20:20 + length]), data[28 + length:]


def edited(good, edit):
    value = json.loads(json.dumps(good[0]))
    edit(value)
    return pack_glb(value, good[1])


def refused(tmp_path, data, said):
    (tmp_path / "a.glb").write_bytes(data)
    with pytest.raises(FormatError, match=said), damage.little_memory():
        load_glb(tmp_path / "a.glb")


def head(length, *chunks):
    data = b"".join(struct.pack("<I4s", len(text), kind) + text for kind, text in chunks)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(data) if length is None else length) + data


def of(value, group, name):
    """Returns the accessor or view of an attribute."""
    at = value["meshes"][0]["primitives"][0]["attributes"][name]
    return value[group][at]


@pytest.mark.parametrize(("data", "said"), [
    (b"", "not a .glb"), (b"glTF", "not a .glb"), (b"PK\x03\x04" + bytes(50), "not a .glb"),
    (struct.pack("<4sIIII", b"glTF", 1, 20, 0, 0), "version 1"),
    (head(1 << 31, (b"JSON", b"{} ")), "header promises 2147483648"),
    (head(10, (b"JSON", b"{} ")), "header promises"),
    (head(None, (b"BIN\0", b"{} ")), "needed is JSON"),
    (head(None, (b"JSON", b"{}  "), (b"JSON", b"{}  ")), "needed is BIN"),
    (head(None, (b"JSON", b"[]  ")), "not an object"),
    (head(None, (b"JSON", b"{}  ")), "no scenes 0"),
    (head(None, (b"JSON", b"{")), "cannot be read"),
    (head(None, (b"JSON", b"\xff\xff")), "cannot be read"),
    (head(None, (b"JSON", b"[" * 100_000)), "cannot be read"),
    (head(None, (b"JSON", b'{"a":' * 100_000)), "cannot be read"),
    (head(None, (b"JSON", b'{"a":NaN}')), "NaN is not a number"),
    (head(None, (b"JSON", b"9" * 5000)), "cannot be read"),
    (head(None, (b"JSON", b"[" + b"{}," * 2_000_000 + b"0]")), "6000003 bytes, needed is JSON"),
    (struct.pack("<4sIII4s", b"glTF", 2, 20, 1 << 31, b"JSON"), "ends after the file"),
    (head(None, (b"JSON", b"{}")) + bytes(12), "header promises"),
    (head(25, (b"JSON", b"{}")) + b"abc", "cut short"),
])
def test_what_is_no_glb_is_refused(tmp_path, data, said):
    refused(tmp_path, data, said)


def test_a_missing_file_is_refused(tmp_path):
    with raises(FormatError):
        load_glb(tmp_path / "none.glb")


@pytest.mark.parametrize(("key", "number", "said"), [
    ("count", 10**9, "end after their buffer"), ("count", 2**70, "count = "),
    ("count", 0, "count = 0"), ("count", 20.0, "count = 20.0"), ("count", None, "count = None"),
    ("count", 19, "different lengths"), ("count", 21, "end after their buffer"),
    ("byteOffset", 1, "end after their buffer"), ("byteOffset", -4, "byteOffset = -4"),
    ("bufferView", 99, "no bufferViews 99"), ("bufferView", None, "no bufferViews None"),
    ("bufferView", -1, "no bufferViews -1"), ("componentType", 5130, "an accessor of"),
    ("componentType", [5126], "an accessor of"), ("type", "VEC4", "an accessor of"),
    ("sparse", {"count": 1}, "an accessor of")])
def test_an_accessor_that_lies_is_refused(tmp_path, good, key, number, said):
    refused(tmp_path, edited(good, lambda value: of(value, "accessors", f"{EXT}:SCALE").update(
        {key: number})), said)


@pytest.mark.parametrize(("key", "number", "said"), [
    ("byteLength", 10**9, "ends after the"), ("byteLength", 0, "byteLength = 0"),
    ("byteOffset", 10**9, "ends after the"), ("byteOffset", -1, "byteOffset = -1"),
    ("byteStride", 1 << 20, "end after their buffer"), ("byteStride", 4, "byteStride = 4"),
    ("byteStride", 0, "byteStride = 0"), ("buffer", 1, "no buffers 1"),
    ("buffer", "0", "no buffers '0'")])
def test_a_view_that_lies_is_refused(tmp_path, good, key, number, said):
    refused(tmp_path, edited(good, lambda value: of(value, "bufferViews", "POSITION").update(
        {key: number})), said)


@pytest.mark.parametrize(("edit", "said"), [
    (lambda value: value["buffers"][0].update(uri="http://a.b/c"), "in another file"),
    (lambda value: value["nodes"][0].update(children=[0]), "node 0 twice"),
    (lambda value: value["scenes"][0].update(nodes=[0, 0]), "node 0 twice"),
    (lambda value: value["scenes"][0].update(nodes=[7]), "no nodes 7"),
    (lambda value: value["scenes"][0].update(nodes={}), "numbers of nodes"),
    (lambda value: value["nodes"][0].update(scale=[1, 2, 1]), "stretches"),
    (lambda value: value["nodes"][0].update(scale=[-1, 1, 1]), "mirrors"),
    (lambda value: value["nodes"][0].update(scale=[0, 0, 0]), "stretches"),
    (lambda value: value["nodes"][0].update(rotation=[0, 0, 0, 9]), None),
    (lambda value: value["nodes"][0].update(rotation=[1, 0, 0, 1]), "stretches"),
    (lambda value: value["nodes"][0].update(matrix=[1e38] * 16), "stretches"),
    (lambda value: value["nodes"][0].update(matrix=[1, 2]), "16 finite numbers"),
    (lambda value: value["nodes"][0].update(translation=["a", 0, 0]), "3 finite numbers"),
    (lambda value: value["nodes"][0].update(translation=[3e38, 3e38, 3e38]), None),
    (lambda value: value.update(extensionsRequired=["EXT_meshopt_compression"]), "meshopt"),
    (lambda value: value.update(extensionsRequired=[{}]), "needs the extensions"),
    (lambda value: value["meshes"][0].update(primitives=0), "without primitives"),
    (lambda value: value["meshes"][0].update(primitives=[0]), "a malformed primitive"),
    (lambda value: value["meshes"][0]["primitives"][0].update(mode=4), "not points"),
    (lambda value: value["meshes"][0]["primitives"][0]["extensions"][EXT].update(
        extensions={"KHR_gaussian_splatting_compression_spz_2": {}}), "spz_2"),
    (lambda value: value["meshes"][0]["primitives"][0]["extensions"][EXT].update(
        kernel="box"), "kernel 'box'"),
    (lambda value: value["meshes"][0]["primitives"][0]["extensions"][EXT].update(
        colorSpace="lin_rec709_display"), "colorSpace 'lin"),
    (lambda value: value["meshes"][0]["primitives"][0]["attributes"].pop(f"{EXT}:SCALE"),
     "without KHR_gaussian_splatting:SCALE"),
    (lambda value: value["meshes"][0]["primitives"][0]["attributes"].pop(
        f"{EXT}:SH_DEGREE_1_COEF_1"), "2 coefficients"),
    (lambda value: value["meshes"][0]["primitives"][0]["attributes"].update(
        {f"{EXT}:SCALE": of(value, "accessors", "POSITION")["bufferView"]}), "scales below 0"),
])
def test_a_scene_that_is_none_is_refused(tmp_path, good, edit, said):
    data = edited(good, edit)
    if said is None:  # unusual, and fine
        (tmp_path / "a.glb").write_bytes(data)
        assert len(load_glb(tmp_path / "a.glb").splats) == COUNT
    else:
        refused(tmp_path, data, said)


def test_a_crowd_of_copies_is_refused(tmp_path, good):
    def crowd(value):
        value["nodes"] = [{"mesh": 0} for _ in range(1000)]
        value["scenes"][0]["nodes"] = list(range(1000))

    refused(tmp_path, edited(good, crowd), "Gaussians in")


@pytest.mark.parametrize(("name", "number", "said"), [
    (f"{EXT}:SCALE", -0.5, "scales below 0"), (f"{EXT}:OPACITY", 1.5, "beyond 0 to 1"),
    (f"{EXT}:OPACITY", -0.1, "beyond 0 to 1")])
def test_a_value_that_is_none_is_refused(tmp_path, good, name, number, said):
    value, data = good
    start = of(value, "bufferViews", name)["byteOffset"] + 8
    data = data[:start] + np.array([number], "<f4").tobytes() + data[start + 4:]
    refused(tmp_path, pack_glb(value, data), said)


@pytest.mark.parametrize(("name", "number"), [
    ("POSITION", np.nan), (f"{EXT}:SCALE", np.inf), (f"{EXT}:OPACITY", np.nan)])
def test_a_gaussian_that_is_not_finite_is_left_out_and_counted(
    tmp_path, good, name, number, caplog
):
    value, data = good
    pack = tmp_path / "good.glb"
    pack.write_bytes(pack_glb(value, data))
    whole = load_glb(pack).splats
    start = of(value, "bufferViews", name)["byteOffset"]
    data = data[:start] + np.array([number], "<f4").tobytes() + data[start + 4:]
    pack.write_bytes(pack_glb(value, data))
    left = load_glb(pack).splats
    assert torch.equal(left.means, whole.means[1:])
    assert torch.equal(left.sh_dc, whole.sh_dc[1:])
    assert_facts(caplog.text, 1, len(whole), "Gaussians", "left")


def test_nans_that_signal_are_refused_without_a_warning_where_most_are_bad(tmp_path, good):
    value, data = good
    view = of(value, "bufferViews", "POSITION")
    start, size = view["byteOffset"], view["byteLength"]
    data = data[:start] + (0x7FA00000).to_bytes(4, "little") * (size // 4) + data[start + size:]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        refused(tmp_path, pack_glb(value, data), "not finite in means")


def _survives(path, data):
    path.write_bytes(data)
    with contextlib.suppress(FormatError):
        splats = load_glb(path).splats
        assert all(value.isfinite().all() for value in splats.parameters().values())


CAREFUL = settings(
    max_examples=examples(100), suppress_health_check=[HealthCheck.function_scoped_fixture])


@CAREFUL
@given(st.data())
def test_no_bytes_give_anything_but_gaussians_or_a_reason(tmp_path, good, data):
    _survives(tmp_path / "a.glb", data.draw(damage.changed_bytes(pack_glb(*good))))


@CAREFUL
@given(st.data())
def test_no_json_gives_anything_but_gaussians_or_a_reason(tmp_path, good, data):
    value = data.draw(damage.changed_json(good[0]))
    _survives(tmp_path / "a.glb", pack_glb(value, good[1]))


@CAREFUL
@given(st.data())
def test_no_numbers_give_anything_but_gaussians_or_a_reason(tmp_path, good, data):
    _survives(tmp_path / "a.glb", pack_glb(good[0], data.draw(damage.changed_bytes(good[1]))))
