"""What only one format of Gaussians can have wrong, and the facts of its refusal."""

from __future__ import annotations

import base64
import gzip
import re
import struct
from collections.abc import Callable

import numpy as np
import zstandard
from rad_writer import DEFAULT, N, chunk, rad, values

MIB = 1 << 20

Change = Callable[[bytes], bytes]
Case = tuple[Change, list[object]]

PLY: list[Case] = [
    (lambda data: data + bytes(20), ["truncated"]),
    (lambda data: data.replace(b"property float nx\n", b""), ["truncated"]),
    (lambda data: data.replace(b"vertex 20", b"vertex 2000000000"), ["truncated"]),
    (lambda data: data.replace(b"vertex 20", b"vertex -5"), ["vertex -5"]),
    (lambda data: data.replace(b"vertex 20", b"vertex " + b"9" * 5000), ["element vertex"]),
    (lambda data: data.replace(b"vertex 20", b"face 20"), ["face", "vertices"]),
    (lambda data: data.replace(b"vertex 20", b"vertex 20\nelement vertex 0"), ["properties"]),
    (lambda data: data.replace(b"end_header", b"element a 0\nproperty int x\nelement a 0\n"
                               b"property int x\nend_header"), ["element", "twice"]),
    (lambda data: data.replace(b"end_header", b"element a 1\nproperty int x\nend_header"),
     [1, "a", 4]),
    (lambda data: data.replace(b"binary_little_endian", b"binary_middle_endian"), ["neither"]),
    (lambda data: data.replace(b"format", b"from"), ["neither"]),
    (lambda _: b"ply\nformat ascii 1.0\nproperty int x\nend_header\n", ["elements"]),
    (lambda data: data.replace(b"float x\n", b"floot x\n"), ["floot x"]),
    (lambda data: data.replace(b"float x\n", b"uint packed_position\n"), ["compressed .ply"]),
    (lambda data: data.replace(b"float opacity", b"float opacite"), ["lacks", "opacity"]),
    (lambda data: data.replace(b"float x\n", b"list uchar int x\n"), ["lists"]),
    (lambda data: re.sub(rb"property float (opacity|scale_\d|rot_\d)\n", rb"property float a\1\n",
                         data), ["point cloud"]),
    *((lambda data, name=name: data.replace(b"float ny", b"float " + name), ["moving"])
      for name in (b"trbf_center", b"motion_0", b"t", b"scale_t", b"rot_r_0")),
    (lambda data: data.replace(b"f_rest_44", b"g_rest_44"), ["f_rest"]),
    (lambda data: re.sub(rb"f_rest_(\d\n|1\d|20)", rb"g_rest_\1", data), ["f_rest", 0]),
    (lambda data: data.replace(b"float ny", b"float nx"), ["twice"]),
    (lambda data: data[:-4] + np.float32(np.nan).tobytes(), ["finite", "rot_3 (1)"]),
]
ASCII_PLY: list[Case] = [
    (lambda text: text[:-300], [62]),
    (lambda text: text[:text[:-2].rindex(b"\n") + 1], [20, 19]),
    (lambda text: text + b"1 2 3\n", [20, 21]),
    (lambda text: text.replace(b"vertex 20", b"vertex 2000000000"), ["truncated"]),
    (lambda text: re.sub(rb"(end_header\n)[^ ]+", rb"\1word", text), [62]),
    (lambda text: re.sub(rb"(end_header\n)[^ ]+", rb"\1nan", text), ["x (1)"]),
    (lambda text: re.sub(rb"(end_header\n)[^ ]+", rb"\g<1>1e60", text), ["x (1)"]),
]
COMPRESSED: list[Case] = [
    (lambda data: data + bytes(9), ["truncated"]),
    (lambda data: data.replace(b"vertex 9", b"vertex 9000000000"), ["truncated"]),
    (lambda data: data.replace(b"chunk 1", b"chunk 2").replace(b"end_header\n", (
        b"end_header\n" + bytes(72))), [2, 256, 9]),
    (lambda data: data.replace(b"packed_scale", b"scale"), ["compressed"]),
    (lambda data: data.replace(b"min_y", b"min_w"), ["compressed"]),
    (lambda data: data.replace(b"min_g", b"min_q"), ["compressed"]),
    (lambda data: data.replace(b"uint packed_scale", b"float packed_scale"), ["compressed"]),
    (lambda data: data.replace(b"sh 9", b"sh 8")[:-9], ["degree"]),
    (lambda data: data.replace(b"uchar f_rest_8", b"char f_rest_8"), ["degree"]),
    (lambda data: data.replace(b"f_rest_8", b"f_rest_9"), ["degree"]),
    (lambda data: data.replace(b"binary_little_endian", b"ascii"), ["truncated"]),
    (lambda data: data.replace(b"end_header\n", b"end_header\n" + b"\xff" * 4, 1)[:-4],
     ["finite", "means"]),
    # a signalling NaN, of which a cast complains
    (lambda data: data.replace(b"end_header\n", b"end_header\n" + b"\1\0\xa0\x7f", 1)[:-4],
     ["finite", "means"]),
    (lambda data: data.replace(b"end_header\n", b"end_header\n" + (
        np.full(18, 3e38, "<f4").tobytes()), 1)[:-72], ["finite", "sh_dc"]),
]
SPLAT: list[Case] = [
    (lambda _: b"", [0]),
    (lambda data: data + b"1", ["truncated"]),
    (lambda data: b"ply\n" + data[4:], [".splat"]),
    (lambda data: data[:12] + np.float32(-1).tobytes() + data[16:], ["negative", "scales"]),
    (lambda data: np.full(len(data) // 4, np.nan, "<f4").tobytes(), ["finite", "positions"]),
]


def spz_head(
    version: int = 3, count: int = 9, degree: int = 3, bits: int = 12, flags: int = 0,
    streams: int = 0
) -> bytes:
    return b"NGSP" + struct.pack("<IIBBBB", version, count, degree, bits, flags, streams)


AXES = 0xADBE0003  # the extension
SPZ: list[Case] = [
    (lambda data: data[:7], ["truncated"]),
    (lambda data: data + bytes(65), ["more", "header"]),
    (lambda data: spz_head(version=0) + data[16:], ["version 0"]),
    (lambda data: spz_head(version=1, count=12) + data[16:], ["truncated"]),
    (lambda data: spz_head(version=5) + data[16:], ["version 5"]),
    (lambda data: spz_head(degree=4) + data[16:], ["truncated"]),
    (lambda data: spz_head(degree=5) + data[16:], ["degree 5"]),
    (lambda data: spz_head(bits=25) + data[16:], [25]),
    (lambda data: spz_head(count=0) + data[16:], [0]),
    (lambda data: spz_head(count=10) + data[16:], ["truncated"]),
    (lambda data: spz_head(count=8) + data[16:], ["more", "header"]),
    (lambda data: spz_head(count=50_000_000) + data[16:], [50000000]),
    (lambda data: spz_head(count=2**32 - 1) + data[16:], [4294967295]),
    (lambda data: spz_head(flags=2) + data[16:] + b"123", ["truncated"]),
    (lambda data: spz_head(flags=2) + data[16:] + struct.pack("<II", 9, 4), ["truncated"]),
    (lambda data: spz_head(flags=2) + data[16:] + struct.pack("<II", AXES, 9), []),
    (lambda data: spz_head(flags=2) + data[16:] + struct.pack("<III", AXES, 4, 17), [11000000]),
    (lambda data: spz_head(flags=2) + data[16:] + struct.pack("<IIB", AXES, 1, 4), ["axes"]),
    (lambda data: spz_head(flags=2) + data[16:] + struct.pack("<III", AXES - 2, 4, 1),
     ["0xadbe0001"]),
]
ZIPPED_SPZ: list[Case] = [
    (lambda data, change=change: gzip.compress(change(gzip.decompress(data))), facts)
    for change, facts in SPZ] + [
    (lambda data: data[:12], []), (lambda data: data[:-3], []),
    (lambda data: data[:40] + b"\0" + data[41:], []),
]
SPZ_BOMBS: list[Case] = [
    (lambda data: gzip.compress(gzip.decompress(data) + bytes(200 * MIB)), ["more", "header"])]


def zstd_bomb(data: bytes, *, known: bool) -> bytes:
    """The first stream unpacks to more than its count, and says so or not."""
    packed, size = struct.unpack_from("<QQ", data, 32)
    behind = 32 + 16 * data[15]
    packer = zstandard.ZstdCompressor(write_content_size=known)
    bomb = packer.compress(bytes(200 * MIB))
    table = struct.pack("<QQ", len(bomb), size) + data[48:behind]
    return data[:32] + table + bomb + data[behind + packed:]


SPZ_4: list[Case] = [
    (lambda data: data[:20], ["truncated"]),
    (lambda data: data[:-1], ["unpacked"]),
    (lambda data: data + bytes(65), ["more", "header"]),
    (lambda data: spz_head(4, 10, streams=6) + data[16:], [90]),
    (lambda data: spz_head(4, 50_000_000, streams=6) + data[16:], [50000000]),
    (lambda data: spz_head(4, 9, streams=5) + data[16:], [5, 6]),
    (lambda data: spz_head(4, 9, 0, streams=6) + data[16:], [6, 5]),
    (lambda data: data[:16] + b"\0\0\0\0" + data[20:], ["streams"]),
    (lambda data: data[:16] + b"\xff\xff\xff\xff" + data[20:], ["streams"]),
    (lambda data: data[:32] + b"\xff" * 8 + data[40:], []),
    (lambda data: data[:32] + bytes(8) + data[40:], ["unpacked"]),
    (gzip.compress, ["packed"]),
]
ZSTD_BOMBS: list[Case] = [
    (lambda data: zstd_bomb(data, known=True), []), (lambda data: zstd_bomb(data, known=False), [])]

TAG = re.compile(rb'<script id="scene"[^>]*>')


def scene_of(page: bytes) -> slice:
    """Where the text of the scene's element lies."""
    found = TAG.search(page)
    assert found
    return slice(found.end(), page.index(b"</script>", found.end()))


def cut_at(share: float) -> Change:
    def change(page: bytes) -> bytes:
        place = scene_of(page)
        return page[:int(place.start + share * (place.stop - place.start))]

    return change


def scene(make: Change) -> Change:
    def change(page: bytes) -> bytes:
        place = scene_of(page)
        return page[:place.start] + make(page[place]) + page[place.stop:]

    return change


HTML: list[Case] = [
    (lambda _: b"<!doctype html><title>another page</title>", ["scenes"]),
    (lambda page: page.replace(b'id="scene"', b'id="scene2"'), ["scenes"]),
    (lambda page: page + TAG.findall(page)[0] + b"</script>", [2, "scenes"]),
    (lambda page: page[:scene_of(page).start - 3], ["scenes"]),
    (cut_at(0.5), ["truncated"]), (cut_at(1.0), ["truncated"]),
    (lambda page: page.replace(b'data-format="spz"', b'data-format="ksplat"'), ["ksplat"]),
    (lambda page: re.sub(b'data-bytes="[0-9]+"', b'data-bytes="7"', page), [7]),
    (lambda page: re.sub(b'data-bytes="[0-9]+"', b'data-bytes="999999999999"', page),
     [999999999999]),
    (scene(lambda text: text[:-8]), ["promises"]), (scene(lambda text: text[:-2]), ["base64"]),
    (scene(lambda text: b"*" + text[1:]), ["base64"]),
    (scene(lambda text: text[:40] + b"\n" + text[40:]), ["base64"]),
    (scene(lambda text: base64.b64encode(b"PK" + base64.b64decode(text)[2:])), ["SPZ"]),
]


def rad_head(**more: object) -> Change:
    return lambda _: rad([chunk(values(), DEFAULT)], N, **more)


RAD: list[Case] = [
    (rad_head(version=2), ["version", 2]), (rad_head(count=7), [7]),
    (rad_head(chunks=[]), ["chunks"]),
    (rad_head(chunks=[{"offset": 0, "bytes": 1, "filename": "0.radc"}]), ["files"]),
    (rad_head(chunks=[{"offset": 8, "bytes": 1}]), ["RADC"]),
    (rad_head(lodTree=True), ["child_count"]),
    (rad_head(chunks=[{"offset": 0, "bytes": 1}]), ["cut"]),
    (rad_head(chunks=[{"offset": 0, "bytes": 300}, {"offset": 299, "bytes": 1}]), ["overlap"]),
]


def put(offset: int, content: bytes) -> Change:
    return lambda data: data[:offset] + content + data[offset + len(content):]


KSPLAT: list[Case] = [
    (put(1, b"\2"), ["version 0.2"]), (put(20, b"\3"), ["level 3"]),
    (put(4, b"\xff\xff\xff\xff"), ["ends"]), (put(16, b"\x08"), [8]),
    (put(4096 + 40, b"\3"), ["degree 3"]), (put(4096, b"\xff\xff"), ["truncated"]),
    (put(4096 + 8, b"\1"), ["buckets", 3]), (put(4096 + 20, b"\4"), ["damaged"]),
]
