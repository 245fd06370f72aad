"""What an archive of images (.sog) or a glTF file of Gaussians can have wrong."""

from __future__ import annotations

import io
import json
import struct
import warnings
import zipfile
from collections.abc import Callable

import numpy as np
from PIL import Image
from splat_damages import MIB, Case, Change

from recon_cli.splats.glb import pack_glb
from recon_cli.splats.sog import encode_webp


def zipped(
    entries: dict[str, bytes | str] | list[tuple[str, bytes]], method: int = zipfile.ZIP_DEFLATED
) -> bytes:
    data = io.BytesIO()
    with warnings.catch_warnings():  # of names that are there twice
        warnings.simplefilter("ignore")
        with zipfile.ZipFile(data, "w", method) as archive:
            for name, content in entries.items() if isinstance(entries, dict) else entries:
                archive.writestr(name, content)
    return data.getvalue()


def entries_of(data: bytes) -> dict[str, bytes | str]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def entry(name: str, content: bytes | str) -> Change:
    return lambda data: zipped({**entries_of(data), name: content})


def meta(edit: Callable[[dict], object]) -> Change:
    def change(data: bytes) -> bytes:
        value = json.loads(entries_of(data)["meta.json"])
        edit(value)
        return entry("meta.json", json.dumps(value))(data)

    return change


def flat(width: int, height: int, channels: int = 3, value: int = 0) -> bytes:
    return encode_webp(np.full((height, width, channels), value, np.uint8))


def claimed(width: int, height: int) -> bytes:
    """An image of 9x8 pixels that says that it is larger."""
    data = bytearray(flat(9, 8))
    assert data[12:16] == b"VP8L"
    bits = int.from_bytes(data[21:25], "little")
    assert bits & 0xFFFFFFF == 8 | 7 << 14
    data[21:25] = (bits >> 28 << 28 | width - 1 | height - 1 << 14).to_bytes(4, "little")
    return bytes(data)


def image(form: str, values: tuple[int, ...] = (0,), **options: object) -> bytes:
    first, *more = [Image.fromarray(np.full((8, 9, 3), value, np.uint8)) for value in values]
    data = io.BytesIO()
    first.save(data, form, **({"save_all": True, "append_images": more} if more else {}), **options)
    return data.getvalue()


def lying_size(size: int) -> Change:
    def change(data: bytes) -> bytes:
        packed = bytearray(entry("sh0.webp", ZEROS)(data))
        at = packed.rindex(b"PK\x01\x02", 0, packed.rindex(b"sh0.webp"))
        struct.pack_into("<I", packed, at + 24, size)
        return bytes(packed)

    return change


def wrong_checksum(data: bytes) -> bytes:
    entries = entries_of(data)
    stored = bytearray(zipped(entries, zipfile.ZIP_STORED))
    stored[stored.index(entries["quats.webp"]) + 40] ^= 1
    return bytes(stored)


def millions(data: bytes) -> bytes:
    """A Gaussian takes at least a byte."""
    entries = entries_of(meta(lambda value: value.update(count=16_000_000))(data))
    one = claimed(4000, 4000)
    return zipped({name: one if name.endswith(".webp") else old for name, old in entries.items()})


ZEROS = bytes(64 * MIB)
IMAGES = ("means_l", "means_u", "scales", "quats", "sh0", "shN_centroids", "shN_labels")
SOG: list[Case] = [
    (lambda _: zipped({}), [".sog"]), (lambda _: zipped({"a": ""}), ["entry", "'meta.json'"]),
    *((lambda data, text=text: entry("meta.json", text)(data), facts) for text, facts in (
        ("{", ["JSON"]), ("[" * 100_000, ["JSON"]),
        ('{"version":' + "9" * 5000 + "}", ["JSON"]), ("[]", ["object"]),
        ("{}", ["version", None]), (b"\xff\xfe", ["JSON"]),
        ('{"version": 2, "count": NaN}', ["NaN"]), ('{"means": {"shape": [1, 3]}}', ["version 1"]),
        ('{"version": 3}', ["version 3"]), (" " * (2 * MIB), [MIB]))),
    (lambda _: zipped({f"{at}": "" for at in range(70)}), [64]),
    *((entry(name, b"x"), ["leaves"]) for name in (
        "../evil", "/etc/evil", "a/../../evil", "..\\evil", "C:\\evil", "C:evil")),
    (lambda data: zipped([*entries_of(data).items(), ("sh0.webp", b"other")]), ["two", "name"]),
    *((lambda data, method=method: zipped(entries_of(data), method), ["compressed"])
      for method in (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)),
    (wrong_checksum, ["unpacked"]),
    *((lambda data, name=name: zipped({
        key: value for key, value in entries_of(data).items() if key != name}),
       ["entry", f"'{name}'"])
      for name in ("means_u.webp", "sh0.webp", "shN_centroids.webp", "meta.json")),
    (entry("means_l.webp", flat(9, 7)), ["9x7", 70]),
    (entry("scales.webp", flat(8, 9)), ["8x9", "9x8"]),
    (entry("quats.webp", claimed(16383, 16383)), ["16383x16383", 70]),
    (entry("means_l.webp", claimed(16383, 16383)), ["16383x16383", 70]),
    (entry("means_l.webp", claimed(1000, 1000)), []),
    (entry("shN_centroids.webp", flat(64 * 8, 1)), ["512x1", 960]),
    (entry("shN_centroids.webp", flat(64 * 15, 2)), ["960x2", "960x1"]),
    (entry("sh0.webp", b"RIFF1234WEBPVP8Lxxxx"), ["image"]), (entry("sh0.webp", b""), ["image"]),
    (entry("sh0.webp", b"GIF89a" + bytes(20)), ["image"]),
    (entry("quats.webp", flat(9, 8, 4)), ["greatest"]),
    (entry("shN_labels.webp", flat(9, 8, 3, 255)), ["label", 65535]),
    (entry("sh0.webp", image("WEBP", quality=90)), ["lossy"]),
    (entry("sh0.webp", image("WEBP", (0, 200), lossless=True)), ["single"]),
    *((meta(lambda value, count=count: value.update(count=count)), facts) for count, facts in (
        (0, ["count", 0]), (-1, ["count", -1]), (True, ["count", True]), (70.0, ["count", 70.0]),
        ("70", ["count", "'70'"]), (73, ["9x8", 73]), (10**9, ["count", 10**9]),
        (200_000_000, [200_000_000]), (2**70, ["count"]))),
    (meta(lambda value: value["means"].update(mins=[0, 0])), ["mins"]),
    (meta(lambda value: value["means"].update(mins=[0, 0, 1e300])), ["mins"]),
    (meta(lambda value: value["means"].update(maxs=[0, 0, 90])), ["finite", "means"]),
    (meta(lambda value: value["means"].update(files=["means_l.webp"])), [2, "names"]),
    (meta(lambda value: value["scales"].update(codebook=[1.0])), ["codebook", 1]),
    (meta(lambda value: value["scales"].update(codebook=[0.0] * 257)), [256]),
    (meta(lambda value: value["sh0"].update(codebook=["a"] * 256)), [256, "finite"]),
    (meta(lambda value: value["sh0"].update(codebook={})), [256]),
    (meta(lambda value: value["shN"].update(bands=4)), ["bands", 4]),
    (meta(lambda value: value["shN"].update(count=0)), ["count", 0]),
    (meta(lambda value: value["shN"].update(count=65537)), ["count", 65537]),
    (meta(lambda value: value["shN"].update(count=65536)), ["960x1", 983040]),
    (meta(lambda value: value["shN"].update(count=1)), ["palette", 1]),
    (meta(lambda value: value.update(quats=None)), ["quats"]),
    (meta(lambda value: value["quats"].update(files=["../../etc/passwd"])), ["entry"]),
    (millions, [16_000_000]),
]
SOG_BOMBS: list[Case] = [
    *((entry(f"{name}.webp", ZEROS), ["unpacks"]) for name in IMAGES),
    *((lying_size(size), []) for size in (0, 5, 1 << 31)),
]


EXT = "KHR_gaussian_splatting"


def head(length: int | None, *chunks: tuple[bytes, bytes]) -> Change:
    data = b"".join(struct.pack("<I4s", len(text), kind) + text for kind, text in chunks)
    size = 12 + len(data) if length is None else length
    return lambda _: struct.pack("<4sII", b"glTF", 2, size) + data


def text(content: bytes) -> Change:
    return head(None, (b"JSON", content))


def parts_of(data: bytes) -> tuple[dict, bytes]:
    """The JSON and the binary chunk of a file."""
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20:20 + length]), data[28 + length:]


def tree(edit: Callable[[dict], object]) -> Change:
    def change(data: bytes) -> bytes:
        value, binary = parts_of(data)
        edit(value)
        return pack_glb(value, binary)

    return change


def attribute(value: dict, group: str, name: str) -> dict:
    """Returns the accessor or view of an attribute."""
    at = value["meshes"][0]["primitives"][0]["attributes"][name]
    return value[group][at]


def scales(key: str, number: object) -> Change:
    return tree(lambda value: attribute(value, "accessors", f"{EXT}:SCALE").update({key: number}))


def positions(key: str, number: object) -> Change:
    return tree(lambda value: attribute(value, "bufferViews", "POSITION").update({key: number}))


def node(**fields: object) -> Change:
    return tree(lambda value: value["nodes"][0].update(fields))


def primitive(edit: Callable[[dict], object]) -> Change:
    return tree(lambda value: edit(value["meshes"][0]["primitives"][0]))


def number(name: str, content: bytes, at: int = 0) -> Change:
    """Puts a number, or as many as there are, into the values of an attribute."""
    def change(data: bytes) -> bytes:
        value, binary = parts_of(data)
        start = attribute(value, "bufferViews", name)["byteOffset"] + at
        return pack_glb(value, binary[:start] + content + binary[start + len(content):])

    return change


def crowd(value: dict) -> None:
    value["nodes"] = [{"mesh": 0} for _ in range(1000)]
    value["scenes"][0]["nodes"] = list(range(1000))


GLB: list[Case] = [
    (lambda _: struct.pack("<4sIIII", b"glTF", 1, 20, 0, 0), ["version 1"]),
    (head(1 << 31, (b"JSON", b"{} ")), [2147483648]), (head(10, (b"JSON", b"{} ")), ["promises"]),
    (head(None, (b"BIN\0", b"{} ")), ["JSON"]),
    (head(None, (b"JSON", b"{}  "), (b"JSON", b"{}  ")), ["BIN"]),
    *((text(content), facts) for content, facts in (
        (b"[]  ", ["object"]), (b"{}  ", ["scenes 0"]), (b"{", ["JSON"]), (b"\xff\xff", ["JSON"]),
        (b"[" * 100_000, ["JSON"]), (b'{"a":' * 100_000, ["JSON"]), (b'{"a":NaN}', ["NaN"]),
        (b"9" * 5000, ["JSON"]), (b"[" + b"{}," * 2_000_000 + b"0]", [6000003, "JSON"]))),
    (lambda _: struct.pack("<4sIII4s", b"glTF", 2, 20, 1 << 31, b"JSON"), ["ends"]),
    (lambda data: text(b"{}")(data) + bytes(12), ["promises"]),
    (lambda data: head(25, (b"JSON", b"{}"))(data) + b"abc", ["cut"]),
    (scales("count", 10**9), ["end"]), (scales("count", 2**70), ["count"]),
    (scales("count", 0), ["count", 0]), (scales("count", 20.0), ["count", 20.0]),
    (scales("count", None), ["count", None]), (scales("count", 19), ["lengths"]),
    (scales("count", 21), ["end"]), (scales("byteOffset", 1), ["end"]),
    (scales("byteOffset", -4), ["byteOffset", -4]), (scales("bufferView", 99), ["bufferViews 99"]),
    (scales("bufferView", None), ["bufferViews None"]),
    (scales("bufferView", -1), ["bufferViews -1"]), (scales("componentType", 5130), ["accessor"]),
    (scales("componentType", [5126]), ["accessor"]), (scales("type", "VEC4"), ["accessor"]),
    (scales("sparse", {"count": 1}), ["accessor"]),
    (positions("byteLength", 10**9), ["ends"]), (positions("byteLength", 0), ["byteLength", 0]),
    (positions("byteOffset", 10**9), ["ends"]), (positions("byteOffset", -1), ["byteOffset", -1]),
    (positions("byteStride", MIB), ["end"]), (positions("byteStride", 4), ["byteStride", 4]),
    (positions("byteStride", 0), ["byteStride", 0]), (positions("buffer", 1), ["buffers 1"]),
    (positions("buffer", "0"), ["buffers '0'"]),
    (tree(lambda value: value["buffers"][0].update(uri="http://a.b/c")), ["file"]),
    (node(children=[0]), ["node 0", "twice"]),
    (tree(lambda value: value["scenes"][0].update(nodes=[0, 0])), ["node 0", "twice"]),
    (tree(lambda value: value["scenes"][0].update(nodes=[7])), ["nodes 7"]),
    (tree(lambda value: value["scenes"][0].update(nodes={})), ["nodes"]),
    (node(scale=[1, 2, 1]), ["stretches"]), (node(scale=[-1, 1, 1]), ["mirrors"]),
    (node(scale=[0, 0, 0]), ["stretches"]), (node(rotation=[1, 0, 0, 1]), ["stretches"]),
    (node(matrix=[1e38] * 16), ["stretches"]), (node(matrix=[1, 2]), [16]),
    (node(translation=["a", 0, 0]), [3]),
    (tree(lambda value: value.update(extensionsRequired=["EXT_meshopt_compression"])),
     ["EXT_meshopt_compression"]),
    (tree(lambda value: value.update(extensionsRequired=[{}])), ["extensions"]),
    (tree(lambda value: value["meshes"][0].update(primitives=0)), ["primitives"]),
    (tree(lambda value: value["meshes"][0].update(primitives=[0])), ["primitive"]),
    (primitive(lambda value: value.update(mode=4)), ["points"]),
    (primitive(lambda value: value["extensions"][EXT].update(
        extensions={f"{EXT}_compression_spz_2": {}})), [f"{EXT}_compression_spz_2"]),
    (primitive(lambda value: value["extensions"][EXT].update(kernel="box")), ["'box'"]),
    (primitive(lambda value: value["extensions"][EXT].update(colorSpace="lin_rec709_display")),
     ["colorSpace"]),
    (primitive(lambda value: value["attributes"].pop(f"{EXT}:SCALE")), [f"{EXT}:SCALE"]),
    (primitive(lambda value: value["attributes"].pop(f"{EXT}:SH_DEGREE_1_COEF_1")), [2]),
    (tree(lambda value: value["meshes"][0]["primitives"][0]["attributes"].update({
        f"{EXT}:SCALE": attribute(value, "accessors", "POSITION")["bufferView"]})),
     ["scales", 0]),
    (tree(crowd), ["Gaussians"]),
    (number(f"{EXT}:SCALE", struct.pack("<f", -0.5), 8), ["scales", 0]),
    (number(f"{EXT}:OPACITY", struct.pack("<f", 1.5), 8), [0, 1]),
    (number(f"{EXT}:OPACITY", struct.pack("<f", -0.1), 8), [0, 1]),
    (number("POSITION", struct.pack("<I", 0x7FA00000) * 60), ["finite", "means"]),  # it signals
]
