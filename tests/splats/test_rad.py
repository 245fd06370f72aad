"""Files laid out as Spark writes .rad are read in every encoding; damaged ones are refused.

What is written is read back, by Spark too.
"""

from __future__ import annotations

import json
import struct
import zlib
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import archive_splats
import numpy as np
import pytest
import torch
from facts import raises
from scipy.spatial import cKDTree
from spark import assert_spark_agrees, decode
from splat_cases import damaged, rotation_error

from recon_cli.errors import FormatError
from recon_cli.scene.splats import SH_C0, Splats
from recon_cli.splats.merge_tree import build_tree
from recon_cli.splats.rad import write_rad
from recon_cli.splats.registry import load_splats, read_splats

if TYPE_CHECKING:
    from browser import WatchedPage

N = 6
FLOATS = {"center": "f32", "alpha": "f32", "rgb": "f32", "scales": "f32", "orientation": "f32",
          "sh": "f32"}
HALVES = {"center": "f16", "alpha": "f16", "rgb": "f16", "scales": "ln_f16", "orientation": "f16",
          "sh": "f16"}
DEFAULT = {"center": "f32_lebytes", "alpha": "r8", "rgb": "r8_delta", "scales": "ln_0r8",
           "orientation": "oct88r8", "sh": "s8"}
OTHERS = DEFAULT | {"center": "f16_lebytes", "rgb": "r8", "sh": "s8_delta"}
LIMITS = {"alpha": (0.0, 1.0), "rgb": (-0.5, 1.5), "scales": (-12.0, 9.0), "sh1": (-1.0, 1.0),
          "sh2": (-2.0, 2.0), "sh3": (-3.0, 3.0)}


def values() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(2)
    quats = rng.normal(size=(N, 4))
    quats[:, 3] = abs(quats[:, 3])  # xyzw, as Spark has them
    table = {
        "center": rng.uniform(-5, 5, (N, 3)), "alpha": rng.uniform(0.1, 0.9, (N, 1)),
        "rgb": rng.uniform(-0.4, 1.4, (N, 3)), "scales": np.exp(rng.uniform(-6, 1, (N, 3))),
        "orientation": quats / np.linalg.norm(quats, axis=1, keepdims=True)}
    for degree, count in ((1, 9), (2, 15), (3, 21)):
        table[f"sh{degree}"] = rng.uniform(-0.9, 0.9, (N, count))
    return table


def octahedral(quats: np.ndarray) -> bytes:
    half = np.arccos(quats[:, 3])
    axis = quats[:, :3] / np.sin(half)[:, None]
    axis /= abs(axis).sum(axis=1, keepdims=True)
    x, y, below = axis[:, 0], axis[:, 1], axis[:, 2] < 0
    x, y = (np.where(below, (1 - abs(b)) * np.where(a >= 0, 1, -1), a) for a, b in ((x, y), (y, x)))
    turned = np.stack([(x + 1) / 2, (y + 1) / 2, 2 * half / np.pi], axis=1)
    return np.rint(turned * 255).astype("u1").tobytes()


def encode(data: np.ndarray, encoding: str, low: float, high: float) -> bytes:
    """One property: all first components, then all second ones."""
    plane = data.T
    share = np.rint(np.clip((plane - low) / (high - low) * 255, 0, 255)).astype("u1")
    signed = np.rint(plane / high * 127).astype("i1").view("u1")
    if encoding.endswith("_lebytes"):
        kind = "<f4" if encoding.startswith("f32") else "<f2"
        flat = plane.astype(kind).ravel()
        return np.ascontiguousarray(flat.view("u1").reshape(len(flat), -1).T).tobytes()
    if encoding.endswith("_delta"):
        return np.diff(share if encoding[0] == "r" else signed, axis=1, prepend=0).astype(
            "u1").tobytes()
    return {
        "f32": lambda: plane.astype("<f4"), "f16": lambda: plane.astype("<f2"),
        "ln_f16": lambda: np.log(plane).astype("<f2"), "r8": lambda: share, "s8": lambda: signed,
        "ln_0r8": lambda: np.rint((np.log(plane) - low) / (high - low) * 254 + 1).astype("u1"),
        "u16": lambda: plane.astype("<u2"), "u32": lambda: plane.astype("<u4"),
    }[encoding]().tobytes()


def padded(data: bytes) -> bytes:
    return data + bytes(-len(data) % 8)


def head(magic: bytes, meta: dict[str, object]) -> bytes:
    text = json.dumps(meta).encode()
    return magic + struct.pack("<I", len(text)) + padded(text)


def chunk(table: dict[str, np.ndarray], encodings: dict[str, str], base: int = 0) -> bytes:
    properties, payload = [], b""
    for name, data in table.items():
        encoding = encodings.get(name) or encodings["sh"]
        low, high = LIMITS.get(name, (0.0, 1.0))
        if name == "orientation":
            plain = octahedral(data) if encoding == "oct88r8" else encode(
                data[:, :3], encoding, low, high)
        else:
            plain = encode(data, encoding, low, high)
        packer = zlib.compressobj(wbits=-15)
        packed = packer.compress(plain) + packer.flush()
        limits = {} if encoding[0] in "fu" or encoding == "ln_f16" else {"min": low, "max": high}
        properties.append({
            "offset": len(payload), "bytes": len(packed), "property": name, "encoding": encoding,
            "compression": "gz", **limits})
        payload += padded(packed)
    return head(b"RADC", {
        "version": 1, "base": base, "count": len(table["center"]), "payloadBytes": len(payload),
        "properties": properties}) + struct.pack("<Q", len(payload)) + payload


def rad(parts: list[bytes], number: int, **more: object) -> bytes:
    offsets = np.cumsum([0, *map(len, parts)]).tolist()
    return head(b"RAD0", {
        "version": 1, "type": "gsplat", "count": number, "maxSh": 3, "allChunkBytes": offsets[-1],
        "chunks": [{"offset": offset, "bytes": len(one)}
                   for offset, one in zip(offsets, parts, strict=False)],
        "comment": "made by hand", **more}) + b"".join(parts)


@pytest.mark.parametrize(("encodings", "error"), [
    (FLOATS, 1e-6), (HALVES, 5e-3), (DEFAULT, 5e-2), (OTHERS, 5e-2)])
def test_every_encoding_is_read(encodings: dict[str, str], error: float, tmp_path: Path) -> None:
    path, table = tmp_path / "room.rad", values()
    path.write_bytes(rad([chunk(table, encodings)], N))
    scene = load_splats(path)
    splats = scene.splats
    assert scene.writer == "made by hand"
    expected = {
        "means": table["center"], "log_scales": np.log(table["scales"]),
        "quats": table["orientation"][:, [3, 0, 1, 2]],
        "sh_rest": np.concatenate(
            [table[f"sh{degree}"] for degree in (1, 2, 3)], axis=1).reshape(N, 15, 3)}
    for name, value in expected.items():
        assert abs(getattr(splats, name).numpy() - value).max() < error, name
    assert abs(splats.opacities.numpy() - table["alpha"][:, 0]).max() < error
    assert abs((SH_C0 * splats.sh_dc + 0.5).numpy() - table["rgb"]).max() < error


@pytest.mark.parametrize("encodings", [FLOATS, HALVES, DEFAULT, OTHERS])
def test_spark_reads_the_same(
    encodings: dict[str, str], page: WatchedPage, tmp_path: Path
) -> None:
    path = tmp_path / "room.rad"
    path.write_bytes(rad([chunk(values(), encodings)], N))
    assert_spark_agrees(page, path, read_splats(path))


def test_of_a_tree_the_ends_are_read_from_all_chunks(tmp_path: Path) -> None:
    table = values() | {
        "child_count": np.array([[2], [0], [3], [0], [0], [0]]), "child_start": np.ones((N, 1))}
    encodings = FLOATS | {"child_count": "u16", "child_start": "u32"}
    parts = [{name: value[rows] for name, value in table.items()}
             for rows in (slice(4), slice(4, None))]
    path = tmp_path / "room.rad"
    path.write_bytes(rad([chunk(part, encodings) for part in parts], N, lodTree=True))
    means = read_splats(path).means
    assert torch.equal(means, torch.tensor(table["center"][[1, 3, 4, 5]]).float())


def test_coefficients_may_lie_in_a_palette(tmp_path: Path) -> None:
    table = values()
    palette = {f"sh{degree}_code": table.pop(f"sh{degree}")[:2] for degree in (1, 2, 3)}
    labels = np.array([[0], [1], [1], [0], [1], [0]])
    path = tmp_path / "room.rad"
    path.write_bytes(rad([
        chunk({**table, **palette, "sh_label": labels}, FLOATS | {"sh_label": "u16"})],
        N, shCodeCount=2))
    rest = read_splats(path).sh_rest
    assert torch.equal(rest[1], rest[4])
    assert torch.equal(rest[3, :3].ravel(), torch.tensor(palette["sh1_code"][0]).float())
    path.write_bytes(rad([
        chunk({**table, **palette, "sh_label": labels + 1}, FLOATS | {"sh_label": "u16"})],
        N, shCodeCount=2))
    with raises(FormatError, 2, "label"):
        read_splats(path)


@pytest.mark.parametrize(("more", "said"), [
    ({"version": 2}, "version = 2"), ({"count": 7}, "states 7"), ({"chunks": []}, "chunks ="),
    ({"chunks": [{"offset": 0, "bytes": 1, "filename": "0.radc"}]}, "other files"),
    ({"chunks": [{"offset": 8, "bytes": 1}]}, "no RADC"), ({"lodTree": True}, "without child_c"),
    ({"chunks": [{"offset": 0, "bytes": 1}]}, "cut short"),
    ({"chunks": [{"offset": 0, "bytes": 300}, {"offset": 299, "bytes": 1}]}, "overlap")])
def test_a_header_that_contradicts_the_file_is_refused(
    more: dict[str, object], said: str, tmp_path: Path
) -> None:
    path = tmp_path / "room.rad"
    path.write_bytes(rad([chunk(values(), DEFAULT)], N, **more))
    with pytest.raises(FormatError, match=said) as caught:
        read_splats(path)
    assert caught.value.hint


@pytest.mark.parametrize("seed", range(60))
def test_a_damaged_file_is_read_or_refused(seed: int, tmp_path: Path) -> None:
    path = tmp_path / "room.rad"
    path.write_bytes(damaged(rad([chunk(values(), (DEFAULT, FLOATS)[seed % 2])], N), seed))
    with suppress(FormatError):
        assert len(read_splats(path))


def nearest(splats: Splats, others: Splats) -> torch.Tensor:
    """The number of the Gaussian of `others` at the place of each of `splats`."""
    distance, found = cKDTree(others.means.numpy()).query(splats.means.numpy())
    assert distance.max() == 0
    return torch.from_numpy(found)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_what_is_written_is_read_back(degree: int, tmp_path: Path) -> None:
    splats, path = archive_splats.room(700, degree=degree), tmp_path / "room.rad"
    write_rad(path, splats)
    scene = load_splats(path)
    assert scene.writer == "recon"
    again = scene.splats.select(nearest(splats, scene.splats))
    assert torch.equal(again.means, splats.means)
    assert (again.log_scales - splats.log_scales).abs().max() < 5e-3
    assert (again.opacities - splats.opacities).abs().max() < 1.1e-3
    assert (again.sh_dc - splats.sh_dc).abs().max() < 5e-3
    if degree:
        most = splats.sh_rest.abs().max()
        assert (again.sh_rest - splats.sh_rest).abs().max() <= most / 127
    assert rotation_error(again, splats) < 1e-3


@pytest.mark.integration
def test_more_than_a_chunk_is_written_and_read(tmp_path: Path) -> None:
    splats, path = archive_splats.room(70_000, degree=0), tmp_path / "room.rad"
    write_rad(path, splats)
    assert path.read_bytes().count(b"RADC") == 2
    assert torch.equal(
        read_splats(path).means.sort(dim=0).values, splats.means.sort(dim=0).values)


def test_spark_finds_every_gaussian_of_a_written_file(page: WatchedPage, tmp_path: Path) -> None:
    splats, path = archive_splats.room(300, degree=1), tmp_path / "room.rad"
    write_rad(path, splats)
    rows, _ = decode(page, path)
    assert len(rows) == len(build_tree(splats).splats)
    distance, _ = cKDTree(np.array(rows)[:, :3]).query(splats.means.numpy())
    assert distance.max() < 2e-2  # it packs centres into float16


@pytest.mark.parametrize(("change", "said"), [
    ({"means": float("nan")}, "finite"), ({"sh_dc": 1e6}, "float16")])
def test_what_cannot_be_written_is_refused_and_leaves_no_file(
    change: dict[str, float], said: str, tmp_path: Path
) -> None:
    splats = archive_splats.room(20, degree=0)
    for name, value in change.items():
        getattr(splats, name)[3] = value
    with raises(FormatError, said):
        write_rad(tmp_path / "room.rad", splats)
    assert not list(tmp_path.iterdir())
