"""Small files that claim to be huge, and agree with themselves: refused within bounds of memory.

Every format of Gaussians, and every layout with counts, sizes or packed data in it, has its lie.
"""

from __future__ import annotations

import gzip
import json
import os
import re
import resource
import signal
import struct
import sys
import time
import zipfile
import zlib
from base64 import b64encode
from collections.abc import Callable
from pathlib import Path

import colmap_sets
import numpy as np
import posed_sets
import pytest
from app_sets import APPS
from app_shots import Shot
from phone_writers import r3d_entries
from splat_cases import few

from recon_cli.datasets.layouts import LAYOUTS, read_posed, recognise
from recon_cli.datasets.packed import unpacked
from recon_cli.errors import ReconError
from recon_cli.splats.registry import FORMATS, read_splats
from recon_cli.workspace.export_formats import READABLE

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="limits of memory are Linux's")
MANY = 100_000_000  # Gaussians, or values: gigabytes
# A few hundred MB are always allowed: pictures and a million Gaussians, as a .sog may have them
MOST_BYTES, MOST_SECONDS = 1 << 30, 60


def outcome(read: Callable[[], object]) -> tuple[str, float]:
    """Returns how reading ends in a process that gets no more memory, and how long it takes."""
    source, target = os.pipe()
    begin, pid = time.monotonic(), os.fork()
    if pid == 0:
        signal.alarm(MOST_SECONDS)
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + MOST_BYTES, used + MOST_BYTES))
        try:
            read()
            end = "read"
        except ReconError as error:
            end = "refused" if error.hint else f"no hint: {error.message}"
        except BaseException as error:
            end = repr(error)[:300]
        os.write(target, end.encode())
        os._exit(0)
    os.close(target)
    os.waitpid(pid, 0)
    with os.fdopen(source, "rb") as file:
        return file.read().decode() or "killed", time.monotonic() - begin


# ---- formats of Gaussians ----

def claim_ply(path: Path) -> None:
    FORMATS["ply"].write(path, few())
    path.write_bytes(path.read_bytes().replace(b"element vertex 9", b"element vertex %d" % MANY))


def claim_compressed_ply(path: Path) -> None:
    FORMATS["compressed.ply"].write(path, few())
    text = path.read_bytes().replace(b"element vertex 9", b"element vertex %d" % MANY)
    path.write_bytes(text.replace(b"element chunk 1", b"element chunk %d" % -(-MANY // 256)))


def claim_splat(path: Path) -> None:
    path.write_bytes(bytes(33))  # without a header, it can only be no multiple of a Gaussian


def spz_of_zeros() -> bytes:
    count = 10_000_000  # 20 bytes each, which gzip packs to a thousandth
    head = struct.pack("<4sIIBBBB", b"NGSP", 3, count, 0, 12, 0, 0)
    return gzip.compress(head + bytes(20 * count), 1)


def claim_spz(path: Path) -> None:
    path.write_bytes(spz_of_zeros())


def claim_html(path: Path) -> None:
    FORMATS["html"].write(path, few())
    packed = spz_of_zeros()
    text = re.sub(rb'data-bytes="\d+"', b'data-bytes="%d"' % len(packed), path.read_bytes())
    start = text.index(b">", text.index(b'<script id="scene"')) + 1
    end = text.index(b"</script>", start)
    path.write_bytes(text[:start] + b64encode(packed) + text[end:])


def claim_sog(path: Path) -> None:
    FORMATS["sog"].write(path, few())
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    files["meta.json"] = json.dumps(json.loads(files["meta.json"]) | {"count": MANY}).encode()
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in files.items():
            archive.writestr(name, data)


def claim_glb(path: Path) -> None:
    """Thousands of nodes with the same mesh."""
    FORMATS["glb"].write(path, few())
    data = path.read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    value = json.loads(data[20:20 + length])
    value["nodes"] = [dict(value["nodes"][0], mesh=0) for _ in range(20_000)]
    value["scenes"] = [{"nodes": list(range(20_000))}]
    text = json.dumps(value).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length:]
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 20 + len(text) + len(rest))
                     + struct.pack("<I4s", len(text), b"JSON") + text + rest)


def claim_lod(path: Path) -> None:
    """One file of Gaussians under hundreds of names."""
    FORMATS["lod"].write(path, few())
    meta = json.loads(path.read_text())
    names = [f"{'./' * at}0_0/meta.json" for at in range(300)]
    leaf = meta["tree"]
    meta |= {"filenames": names, "tree": {"bound": leaf["bound"], "children": [
        {"bound": leaf["bound"], "lods": {"0": {"file": at, "offset": 0, "count": 9}}}
        for at in range(300)]}}
    path.write_text(json.dumps(meta))


def _rad_part(magic: bytes, meta: dict[str, object]) -> bytes:
    text = json.dumps(meta).encode()
    return magic + struct.pack("<I", len(text)) + text + bytes(-len(text) % 8)


def claim_rad(path: Path) -> None:
    """Many chunks of their own, each of 65,536 equal Gaussians in two thousand bytes."""
    count, chunks, payload, properties = 65536, 30, b"", []
    for name, encoding, size in (("center", "f16", 6), ("alpha", "r8", 1), ("rgb", "r8", 3),
                                 ("scales", "ln_0r8", 3), ("orientation", "s8", 3)):
        packer = zlib.compressobj(9, wbits=-15)
        data = packer.compress(bytes(size * count)) + packer.flush()
        properties.append({
            "property": name, "encoding": encoding, "compression": "gz", "min": 0.0, "max": 1.0,
            "offset": len(payload), "bytes": len(data)})
        payload += data + bytes(-len(data) % 8)
    chunk = _rad_part(b"RADC", {"version": 1, "count": count, "properties": properties})
    chunk += struct.pack("<Q", len(payload)) + payload
    path.write_bytes(_rad_part(b"RAD0", {
        "version": 1, "count": chunks * count, "maxSh": 0,
        "chunks": [{"offset": at * len(chunk), "bytes": len(chunk)} for at in range(chunks)]})
        + chunks * chunk)


def claim_ksplat(path: Path) -> None:
    header, section = bytearray(4096), bytearray(1024)
    header[:2] = 0, 1
    struct.pack_into("<IIIIH", header, 4, 1, 1, MANY, MANY, 1)
    struct.pack_into("<IIIIfH", section, 0, MANY, MANY, MANY, 1, 5.0, 12)
    struct.pack_into("<IIIIH", section, 24, 32767, 0, 1, 0, 0)
    path.write_bytes(bytes(header + section) + bytes(1000))


CLAIMS = {
    "ply": claim_ply, "compressed.ply": claim_compressed_ply, "splat": claim_splat,
    "spz": claim_spz, "html": claim_html, "sog": claim_sog, "glb": claim_glb, "lod": claim_lod,
    "rad": claim_rad, "ksplat": claim_ksplat}


@pytest.mark.integration
@pytest.mark.parametrize("row", READABLE, ids=lambda row: row.name)
def test_a_small_file_that_claims_to_be_a_huge_scene_is_refused(row, tmp_path: Path) -> None:
    path = tmp_path / ("lod-meta.json" if row.name == "lod" else f"claim.{row.name}")
    CLAIMS[row.name](path)
    assert path.stat().st_size < 4 << 20
    end, seconds = outcome(lambda: read_splats(path))
    assert end == "refused"
    assert seconds < MOST_SECONDS


# ---- layouts ----

def shots(count: int = 3) -> list[Shot]:
    found = []
    for at in range(count):
        pose = np.eye(4)
        pose[0, 3] = 0.1 * at
        rgb = np.full((48, 64, 3), 40 * at, np.uint8)
        found.append(Shot(at, rgb, np.full((12, 16), 2.0), pose, (50.0, 50.0, 32.0, 24.0), at / 10))
    return found


def npy_header(shape: tuple[int, ...]) -> bytes:
    """The start of an array file of float64, and none of its values."""
    text = str({"descr": "<f8", "fortran_order": False, "shape": shape}).encode()
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


def claim_colmap(folder: Path) -> None:
    colmap_sets.write(folder, colmap_sets.rig_model(), "bin")
    for path in folder.rglob("*.bin"):
        data = path.read_bytes()
        path.write_bytes(struct.pack("<Q", 1 << 40) + data[8:])


def claim_llff(folder: Path) -> None:
    APPS["llff"].write(folder, shots())
    (folder / "poses_bounds.npy").write_bytes(npy_header((1 << 30, 17)))


def claim_bundler(folder: Path) -> None:
    APPS["bundler"].write(folder, shots())
    path = folder / "bundle.out"
    lines = path.read_text().splitlines()
    lines[1] = f"{MANY} {MANY}"
    path.write_text("\n".join(lines) + "\n")


def claim_record3d(folder: Path) -> None:
    APPS["r3d"].write(folder, shots())
    path = next(folder.rglob("metadata"))
    path.write_text(json.dumps(json.loads(path.read_text()) | {"dw": 65536, "dh": 65536}))


def claim_depth(folder: Path) -> None:
    """Depth of which only the header is there."""
    value = posed_sets.transforms()
    for at, frame in enumerate(value["frames"]):
        frame["depth_file_path"] = f"depth_{at}.npy"
        (folder / f"depth_{at}.npy").write_bytes(npy_header((1 << 17, 1 << 17)))
    posed_sets.make_transforms(folder, value)


LAYOUT_CLAIMS = {"colmap": claim_colmap, "llff": claim_llff, "bundler": claim_bundler,
                 "record3d": claim_record3d, "transforms": claim_depth}
# Text, pictures and videos alone, whose readers are tried elsewhere: nothing states a count
PLAIN = {"replica", "scannet", "7scenes", "tum", "polycam", "stray", "3dscannerapp", "arkitscenes",
         "rtabmap", "quest", "nerfcapture", "realityscan", "metashape", "opensfm"}


def test_every_layout_has_its_claim_or_none_to_make() -> None:
    assert {layout.name for layout in LAYOUTS} == LAYOUT_CLAIMS.keys() | PLAIN


def read_all(folder: Path) -> None:
    for image in read_posed(folder).images:
        if image.depth is not None:
            image.depth.read()


@pytest.mark.integration
@pytest.mark.parametrize("name", LAYOUT_CLAIMS)
def test_a_data_set_that_claims_to_be_huge_is_refused(name: str, tmp_path: Path) -> None:
    folder = tmp_path / "set"
    folder.mkdir()
    LAYOUT_CLAIMS[name](folder)
    assert recognise(folder) == name
    end, seconds = outcome(lambda: read_all(folder))
    assert end == "refused"
    assert seconds < MOST_SECONDS


@pytest.mark.integration
def test_a_recording_that_unpacks_to_far_more_than_its_size_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "walk.r3d"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in (r3d_entries(shots()) | {"rgbd/99.jpg": bytes(1 << 27)}).items():
            archive.writestr(name, data)

    def read() -> None:
        with unpacked(path, tmp_path / "out"):
            pass

    assert outcome(read)[0] == "refused"
    assert not list(tmp_path.rglob("99.jpg"))
