"""Writes .rad files by hand as Spark lays them out, in every encoding."""

from __future__ import annotations

import json
import struct
import zlib

import numpy as np

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
