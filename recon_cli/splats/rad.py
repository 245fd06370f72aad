"""The .rad of Spark, version 1: a scene in chunks, with or without a tree of levels.

A file is RAD0, the length of a JSON, the JSON filled up to 8 bytes, and the chunks that it lists. A
chunk is RADC, length and JSON likewise, the size of its properties (u64), and these, raw deflate
each or plain. A property holds all first components, then all second ones. Where there is a tree,
the Gaussians without children are the scene, and the others stand for them from afar.
Coefficients are the property of each Gaussian, or of an entry of a palette in the first chunk.
Source: https://github.com/sparkjsdev/spark, rust/spark-lib/src/rad.rs. Chunks in files of their own
(.radc) are not read.
"""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.scene.splat_arrays import SH_C0, TERMS
from recon_cli.splats.axes import read_up_comment, up_comment
from recon_cli.splats.foreign import FLAT, drop_not_finite
from recon_cli.splats.format import LoadedScene, SplatFormat
from recon_cli.splats.values import (
    MOST_PARTS,
    UntrustedFile,
    refuse_not_finite,
    sigmoid,
    splats_from_arrays,
    to_arrays,
)
from recon_cli.workspace.atomic import write_bytes

if TYPE_CHECKING:
    from recon_cli.scene.splats import Splats
    from recon_cli.splats.merge_tree import MergeTree

_MAGIC, _CHUNK_MAGIC = b"RAD0", b"RADC"
_MOST_SPLATS, _CHUNK = 1 << 31, 1 << 16
_WORD = 8  # bytes, to which everything is filled up
_BAND = {1: 9, 2: 15, 3: 21}  # coefficients of three channels, by degree
_LEAST = 0.25 / 255  # of an opacity, as in the other formats of bytes

Array = NDArray[Any]


def load_rad(path: Path) -> LoadedScene:
    """Returns the scene of a .rad: its Gaussians without children, in the file's order.

    Those that are not finite are dropped, with a warning. FormatError if the file is damaged.
    """
    file = _RadFile(path)
    columns = drop_not_finite(path, file.columns())
    alphas = np.clip(columns["alpha"][:, 0].astype(np.float64), _LEAST, 1 - _LEAST)
    count = len(alphas)
    comment = str(file.meta.get("comment") or "")
    return LoadedScene(splats_from_arrays(path, {
        "means": columns["center"], "quats": columns["orientation"],
        "log_scales": columns["scales"], "logit_opacities": np.log(alphas / (1 - alphas)),
        "sh_dc": (columns["rgb"] - 0.5) / SH_C0,
        "sh_rest": np.concatenate([
            np.zeros((count, 0), np.float32),
            *(columns[f"sh{degree}"] for degree in range(1, file.degree + 1))],
            axis=1).reshape(count, TERMS[file.degree], 3)}),
        read_up_comment(comment), writer=comment)


@dataclass(frozen=True)
class _Chunk:
    """The properties of a chunk: their place in the file, and what its JSON says."""

    payload: int
    end: int
    count: int  # Gaussians
    meta: Mapping[str, Any]


class _RadFile(UntrustedFile):
    """An open .rad; every method raises FormatError if it breaks its own promises."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, _MAGIC, ".rad")
        self.meta, self._start = self._json(0, _MAGIC)
        self.integer(self.meta, "version", 1, 1)
        self.count = self.integer(self.meta, "count", 1, _MOST_SPLATS)
        self.degree = self.integer(self.meta, "maxSh", 0, 3, default=0)
        self._codes: dict[int, Array] = {}  # palette of each degree, [K, 3 * terms]

    def columns(self) -> dict[str, Array]:
        """Returns the properties [N, ...] of the Gaussians that are the scene."""
        chunks = self._open_chunks()
        found = sum(chunk.count for chunk in chunks)
        if found != self.count:
            raise self.error(f"{found:,} Gaussians in its chunks, but states {self.count:,}")
        self._check_size("Gaussians", self.count, 3 + 3 + 4 + 1 + 3)
        parts = [self._read_chunk(chunk) for chunk in chunks]
        table = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        children = table.pop("child_count", None)
        if children is None:
            return table
        leaf = children[:, 0] == 0
        if not leaf.any():
            raise self.error("a tree without ends")
        return {name: value[leaf] for name, value in table.items()}

    def _open_chunks(self) -> list[_Chunk]:
        """Returns the chunks, no two of which share a byte; nothing is unpacked."""
        entries = self.meta.get("chunks")
        if not isinstance(entries, list) or not 0 < len(entries) <= MOST_PARTS:
            raise self.error(f"chunks = {entries!r:.40}; needed is a list")
        places = []
        for entry in entries:
            if not isinstance(entry, dict) or entry.get("filename") is not None:
                raise self.error("chunks in other files, which are not read")
            start = self._start + self.integer(entry, "offset", 0, len(self.data))
            places.append((start, start + self.integer(entry, "bytes", 0, len(self.data) - start)))
        if any(end > start for (_, end), (start, _) in pairwise(sorted(places))):
            raise self.error("chunks that overlap")
        return [self._open_chunk(*place) for place in places]

    def _open_chunk(self, start: int, end: int) -> _Chunk:
        meta, payload = self._json(start, _CHUNK_MAGIC)
        payload += _WORD  # the size of the properties, which each state their own
        if payload > end:
            raise self.error(f"a chunk of {end - start} bytes, which is cut short")
        return _Chunk(payload, end, self.integer(meta, "count", 1, _CHUNK), meta)

    def _check_size(self, what: str, count: int, numbers: int) -> None:
        """Raises FormatError unless `count` rows of `numbers` and coefficients can be packed."""
        numbers += 3 * TERMS[self.degree]
        self.check_unpacked(4 * numbers * count, f"{count:,} {what}")

    def _read_chunk(self, chunk: _Chunk) -> dict[str, Array]:
        """Returns the properties of a chunk by name."""
        meta, count = chunk.meta, chunk.count
        properties = meta.get("properties")
        if not isinstance(properties, list) or not all(
                isinstance(one, dict) and isinstance(one.get("property"), str)
                for one in properties):
            raise self.error(f"properties = {properties!r:.40}; needed is a list")
        named = {one["property"]: one for one in properties}

        def read(name: str, components: int, rows: int = count) -> Array:
            if name not in named:
                raise self.error(f"a chunk without {name}")
            return self._property(named[name], chunk, components, rows)

        values = {name: read(name, 3) for name in ("center", "rgb", "scales", "orientation")}
        values["alpha"] = read("alpha", 1)
        if self.meta.get("lodTree"):
            values["child_count"] = read("child_count", 1)
        return values | self._harmonics(named, read)

    def _harmonics(
        self, named: Mapping[str, Any], read: Callable[..., Array]
    ) -> dict[str, Array]:
        """Returns the coefficients [N, 3 * terms] of each degree of a chunk."""
        degrees = range(1, self.degree + 1)
        if "sh_label" not in named:
            return {f"sh{degree}": read(f"sh{degree}", _BAND[degree]) for degree in degrees}
        entries = self.integer(self.meta, "shCodeCount", 1, _MOST_SPLATS)
        if not self._codes:
            self._check_size("entries of a palette", entries, 0)
            self._codes = {
                degree: read(f"sh{degree}_code", _BAND[degree], entries) for degree in degrees}
        labels = read("sh_label", 1)[:, 0]
        if labels.max() >= entries:
            raise self.error(f"the label {labels.max()} of a palette of {entries}")
        return {f"sh{degree}": self._codes[degree][labels] for degree in degrees}

    def _property(
        self, meta: Mapping[str, Any], chunk: _Chunk, components: int, rows: int
    ) -> Array:
        """Returns a property [rows, components]: scales as logarithms, rotations as wxyz."""
        name, encoding = meta["property"], meta.get("encoding")
        decode = _ENCODINGS.get(encoding) if isinstance(encoding, str) else None
        if decode is None:
            raise self.error(f"{name} in the unknown encoding {encoding!r:.40}")
        size = _SIZES.get(str(encoding), 1) * components * rows
        offset = chunk.payload + self.integer(meta, "offset", 0, chunk.end - chunk.payload)
        data = self.data[offset: offset + self.integer(meta, "bytes", 0, chunk.end - offset)]
        if meta.get("compression") == "gz":
            try:
                data = zlib.decompressobj(-zlib.MAX_WBITS).decompress(data, size)
            except zlib.error as error:
                raise self.error(f"{name} that cannot be decompressed: {error}") from error
        if len(data) < size or not size:
            raise self.error(f"{len(data)} bytes of {name}; needed are {size}")
        low, high = self._limits(meta)
        values = decode(np.frombuffer(data, np.uint8, size), components, low, high)
        if name == "scales" and encoding == "f32":
            return np.log(np.maximum(values, math.exp(FLAT)))
        if name == "orientation" and encoding != "oct88r8":
            real = np.sqrt(np.maximum(0, 1 - (values * values).sum(axis=1, keepdims=True)))
            return np.concatenate([real, values], axis=1)
        return values

    def _limits(self, meta: Mapping[str, Any]) -> tuple[float, float]:
        """Returns the lowest and highest value of a property; 0 and 1 where it has none."""
        if meta.get("max") is None:
            return 0.0, 1.0
        (high,) = self.numbers({"max": [meta["max"]]}, "max", 1, 1)
        (low,) = self.numbers({"min": [meta.get("min") or 0.0]}, "min", 1, 1)
        return float(low), float(high)

    def _json(self, start: int, magic: bytes) -> tuple[dict[str, Any], int]:
        """Returns the JSON at a place, and where what follows it begins."""
        if self.data[start: start + 4] != magic or start + _WORD > len(self.data):
            raise self.error(f"no {magic.decode()} at byte {start}")
        length = int.from_bytes(self.data[start + 4: start + _WORD], "little")
        text = self.data[start + _WORD: start + _WORD + length]
        return self.json_object(text), start + _WORD + -(-length // _WORD) * _WORD


def _columns(values: Array, components: int) -> Array:
    """Returns values [components * N] as [N, components]."""
    return values.reshape(components, -1).T


def _from_planes(data: Array, components: int, kind: str) -> Array:
    """Returns numbers [N, components] of which all first bytes come first."""
    size = np.dtype(kind).itemsize
    return _columns(np.ascontiguousarray(data.reshape(size, -1).T).view(kind)[:, 0], components)


def _summed(data: Array, components: int) -> Array:
    """Returns bytes [N, components] of their differences, modulo 256."""
    return np.cumsum(_columns(data, components), axis=0, dtype=np.uint8)


def _log_scales(data: Array, components: int, low: float, high: float) -> Array:
    """Returns logarithms of bytes: 0 is flat, the others are 255 steps."""
    steps = _columns(data, components).astype(np.float32)
    return np.where(steps == 0, np.float32(FLAT), low + (steps - 1) * ((high - low) / 254))


def _rotations(data: Array, _components: int, _low: float, _high: float) -> Array:
    """Returns quaternions wxyz of an axis in an octahedron (2 bytes) and an angle (1 byte)."""
    table = data.reshape(-1, 3) / np.float64(255)
    x, y = (table[:, :2] * 2 - 1).T
    z = 1 - abs(x) - abs(y)
    fold = np.maximum(-z, 0)
    axis = np.stack([np.where(x >= 0, x - fold, x + fold), np.where(y >= 0, y - fold, y + fold), z])
    axis /= np.linalg.norm(axis, axis=0)
    half = table[:, 2] * (math.pi / 2)
    return np.stack([np.cos(half), *(axis * np.sin(half))], axis=1)


_SIZES = {"f32": 4, "f16": 2, "f32_lebytes": 4, "f16_lebytes": 2, "ln_f16": 2, "u16": 2, "u32": 4}
_ENCODINGS: dict[str, Callable[[Array, int, float, float], Array]] = {
    "f32": lambda data, k, *_: _columns(data.view("<f4"), k),
    "f16": lambda data, k, *_: _columns(data.view("<f2"), k).astype(np.float32),
    "f32_lebytes": lambda data, k, *_: _from_planes(data, k, "<f4"),
    "f16_lebytes": lambda data, k, *_: _from_planes(data, k, "<f2").astype(np.float32),
    "ln_f16": lambda data, k, *_: _columns(data.view("<f2"), k).astype(np.float32),
    "ln_0r8": _log_scales,
    "r8": lambda data, k, low, high: low + _columns(data, k) / 255 * (high - low),
    "r8_delta": lambda data, k, low, high: low + _summed(data, k) / 255 * (high - low),
    "s8": lambda data, k, _, high: _columns(data.view(np.int8), k) / 127 * high,
    "s8_delta": lambda data, k, _, high: _summed(data, k).view(np.int8) / 127 * high,
    "oct88r8": _rotations,
    "u16": lambda data, k, *_: _columns(data.view("<u2"), k),
    "u32": lambda data, k, *_: _columns(data.view("<u4"), k),
}


def write_rad(path: Path, splats: Splats, *, up: str | None = None) -> None:
    """Writes a scene, and a tree of levels over it, of which Spark loads what it shows.

    `up` is the axis that is up, z, -y or y, as a comment; None leaves it out.

    FormatError if there are no Gaussians, a value is not finite, or a colour is above 65504.
    """
    from recon_cli.splats.merge_tree import build_tree  # imports torch

    to_arrays(splats, path.name)  # refuses what cannot be written before the tree is made
    tree = build_tree(splats)
    degree, count = tree.splats.sh_degree, len(tree.splats)
    columns = _encode(tree, path)
    chunks = [_pack_chunk(columns, degree, base, min(_CHUNK, count - base))
              for base in range(0, count, _CHUNK)]
    ends = np.cumsum([len(chunk) for chunk in chunks])
    rgb = columns["rgb"][1]
    meta = {
        "version": 1, "type": "gsplat", "count": count, "maxSh": degree, "lodTree": True,
        "chunkSize": _CHUNK, "allChunkBytes": int(ends[-1]),
        "chunks": [{"offset": int(end) - len(chunk), "bytes": len(chunk)}
                   for end, chunk in zip(ends, chunks, strict=True)],
        # Spark packs colours into bytes of this range
        "splatEncoding": {
            "rgbMin": min(0.0, float(rgb.min())), "rgbMax": max(1.0, float(rgb.max())),
            "lodOpacity": True},
        "comment": up_comment(up)}
    write_bytes(path, b"".join([_pack_json(_MAGIC, meta), *chunks]))


def _encode(tree: MergeTree, path: Path) -> dict[str, tuple[str, Array]]:
    """Returns encoding and values [M, components] of each property."""
    values = to_arrays(tree.splats, path.name)
    # the real part is positive, as it follows from the others
    quats = np.where(values["quats"][:, :1] < 0, -values["quats"], values["quats"])
    with np.errstate(over="ignore"):  # an infinity is refused below
        rgb = (SH_C0 * values["sh_dc"] + 0.5).astype("<f2")
    columns = {
        "center": ("f32_lebytes", values["means"].astype("<f4")),
        "alpha": ("f16", sigmoid(values["logit_opacities"])[:, None].astype("<f2")),
        "rgb": ("f16", rgb),
        "scales": ("ln_f16", values["log_scales"].astype("<f2")),
        "orientation": ("f32", quats[:, 1:].astype("<f4")),
        "child_count": ("u16", tree.child_count[:, None].astype("<u2")),
        "child_start": ("u32", tree.child_start[:, None].astype("<u4"))}
    refuse_not_finite(f"The scene for {path.name}, in float16,", {
        name: columns[name][1] for name in ("rgb", "scales")})
    coefficients = values["sh_rest"].reshape(len(quats), -1)
    for degree in range(1, tree.splats.sh_degree + 1):
        first = 3 * TERMS[degree - 1]
        columns[f"sh{degree}"] = "s8", coefficients[:, first: first + _BAND[degree]]
    return columns


def _pack_chunk(
    columns: Mapping[str, tuple[str, Array]], degree: int, base: int, count: int
) -> bytes:
    """Returns a chunk of `count` Gaussians from number `base` on."""
    properties: list[dict[str, Any]] = []
    payload = bytearray()
    for name, (encoding, values) in columns.items():
        plane = np.ascontiguousarray(values[base: base + count].T)
        meta: dict[str, Any] = {"property": name, "encoding": encoding, "compression": "gz"}
        if encoding == "s8":
            most = max(float(abs(plane).max()), 1e-6)
            meta |= {"min": -most, "max": most}
            plane = np.rint(plane / most * 127).astype(np.int8)
        data = plane.tobytes()
        if encoding == "f32_lebytes":
            data = np.frombuffer(data, np.uint8).reshape(-1, 4).T.tobytes()
        packer = zlib.compressobj(wbits=-zlib.MAX_WBITS)
        packed = packer.compress(data) + packer.flush()
        properties.append({"offset": len(payload), "bytes": len(packed), **meta})
        payload += packed + bytes(-len(packed) % _WORD)
    return _pack_json(_CHUNK_MAGIC, {
        "version": 1, "base": base, "count": count, "payloadBytes": len(payload), "maxSh": degree,
        "lodTree": True, "properties": properties,
    }) + len(payload).to_bytes(_WORD, "little") + payload


def _pack_json(magic: bytes, meta: Mapping[str, Any]) -> bytes:
    """Returns a JSON with its length, filled up."""
    text = json.dumps(meta, allow_nan=False).encode()
    return magic + len(text).to_bytes(4, "little") + text + bytes(-len(text) % _WORD)


FORMAT = SplatFormat(
    load_rad, lambda path, splats, settings: write_rad(
        path, splats.as_tensors().with_sphere(), up=settings.up_axis))
