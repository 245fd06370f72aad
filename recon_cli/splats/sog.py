"""The .sog of PlayCanvas, version 2: a zip of lossless images, about 15 times smaller than a .ply.

Each Gaussian is one pixel of several images of one size, rows from the top left. Positions are 16
bits an axis of sign(x) ln(1 + |x|) between the scene's bounds; logarithms of scales, colours and
coefficients of degrees 1 and up are bytes that point into codebooks of 256 numbers; coefficients
are rows of a palette of at most 65,536. A quaternion is its three smaller components of 8 bits and,
in alpha, 252 plus the index of the greatest in wxyz. Opacity is a byte after the sigmoid. Axes are
those of the .ply that the scene would be written to.

Nothing is unpacked to the disk. Sizes in a zip's directory are only claims, so every entry is read
up to a bound that follows from the number of Gaussians, which the size of the file bounds in turn.
Source: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog, read
together with files that splat-transform writes: scales are logarithms there, quaternions wxyz.
"""

from __future__ import annotations

import io
import json
import math
import sys
import zipfile
import zlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from recon_cli.scene.splat_arrays import LEAST_OPACITY, TERMS, SplatArrays
from recon_cli.splats.codebooks import BOOK, fit_codebook, fit_palette, nearest_entries
from recon_cli.splats.format import SHARING, LoadedScene, SplatFormat
from recon_cli.splats.values import (
    MOST_HEAD_BYTES,
    Bytes,
    Floats,
    UntrustedFile,
    decode_smallest_three,
    describe_asset,
    encode_smallest_three,
    logit,
    morton_codes,
    read_start,
    sigmoid,
    splats_from_arrays,
    to_arrays,
)
from recon_cli.workspace.atomic import read_bytes, write_bytes
from recon_cli.workspace.paths import leads_out

if TYPE_CHECKING:
    from recon_cli.scene.splats import Splats

ROW = 64  # palette entries in a row of their image
_TAG = 252  # of a quaternion whose greatest component is w
_ROOT2 = math.sqrt(2)  # only the greatest component of a unit quaternion exceeds 1 / sqrt(2)
_MOST_16_BIT = int(np.iinfo(np.uint16).max)  # steps of a position; entries of a palette but 0
_MAX_COUNT = 16383 * 16383  # pixels of the largest WebP
META = "meta.json"
_SMALL = 1 << 20  # Gaussians or pixels that are always accepted: a few hundred MB
_START, _ENTRY = b"PK\x03\x04", b"PK\x01\x02"  # of the file, and of each entry of its directory
_ENTRIES = 64  # a .sog has eight
_HEADER = 1 << 16  # bytes of an image beside its pixels
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # others cannot be stopped at a bound
Doubles = NDArray[np.float64]


def write_sog(
    path: Path, splats: Splats | SplatArrays, *, seed: int = 0, sharing: int = SHARING,
    antialiased: bool = False, up: str | None = None,
) -> None:
    """Writes `splats` to `path`, whole or not at all; the same seed gives the same bytes.

    Gaussians are sorted in Morton order, those that have coefficients first. Quaternions are
    normalized, and opacities are rounded to 255ths. `seed` is of the k-means that finds codebooks
    and palette, in which an entry stands for the harmonics of `sharing` Gaussians. FormatError if
    there are no Gaussians, or a value is not finite. `up` is z, -y or y; None leaves it out.
    """
    meta, images = pack_splats(splats, seed=seed, sharing=sharing)
    meta["asset"] = describe_asset(up)
    if antialiased:
        meta |= {"antialias": True, "model": "antialiased"}
    write_bytes(path, pack_archive(meta, images))


def pack_splats(
    splats: Splats | SplatArrays, groups: NDArray[np.int64] | None = None, *, seed: int = 0,
    sharing: int = SHARING,
) -> tuple[dict[str, Any], dict[str, Bytes]]:
    """Returns the content of meta.json, and the images by name; see `write_sog`.

    Gaussians of ascending `groups` [N] follow each other, if there are any; either all of them or
    none have coefficients then.
    """
    if groups is not None and len(splats.sh_rest) not in (0, len(splats)):
        raise ValueError(f"{len(splats.sh_rest)} of {len(splats)} grouped Gaussians are coloured")
    rng = np.random.default_rng(seed)
    table = to_arrays(splats, ".sog")
    low, high, places = pack_means(table["means"])
    plain = np.arange(len(splats)) >= len(splats.sh_rest)
    keys = (morton_codes(places.astype(np.uint64)), plain)
    order = np.lexsort(keys if groups is None else (*keys, groups))
    table, places = {name: value[order] for name, value in table.items()}, places[order]
    scales, sh0 = fit_codebook(table["log_scales"], rng), fit_codebook(table["sh_dc"], rng)
    opacities = np.rint(sigmoid(table["logit_opacities"]) * 255).astype(np.uint8)
    rows: dict[str, Bytes] = {
        "means_l.webp": (places & 255).astype(np.uint8),
        "means_u.webp": (places >> 8).astype(np.uint8),
        "scales.webp": nearest_entries(table["log_scales"], scales),
        "quats.webp": pack_quats(table["quats"]),
        "sh0.webp": np.column_stack([nearest_entries(table["sh_dc"], sh0), opacities]),
    }
    meta: dict[str, Any] = {
        "version": 2, "asset": describe_asset(None), "count": len(splats), "antialias": False,
        "means": {"mins": low.tolist(), "maxs": high.tolist(),
                  "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": _json(scales), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": _json(sh0), "files": ["sh0.webp"]},
    }
    images = {name: _image(row) for name, row in rows.items()}
    if table["sh_rest"].size:
        meta["shN"], palette = pack_harmonics(
            table["sh_rest"], len(splats.sh_rest), rng, sharing)
        images |= palette
    return meta, images


def _image(rows: Bytes) -> Bytes:
    """Returns the values [N, C] of the Gaussians as an image, padded with the last."""
    width = math.isqrt(len(rows) - 1) + 1
    height = -(-len(rows) // width)
    filled = np.pad(rows, ((0, width * height - len(rows)), (0, 0)), mode="edge")
    return filled.reshape(height, width, -1)


def _json(book: Floats) -> list[float]:
    """Returns float32 numbers with the fewest digits that round-trip."""
    return [float(str(value)) for value in book]


def load_sog(path: Path) -> LoadedScene:
    """Returns the scene of a .sog, or of its unpacked meta.json, in the file's order.

    Gaussians behind the last one that has a coefficient other than zero are of degree 0.
    FormatError if the file is missing, damaged, of version 1, or breaks its own promises.
    """
    archive = Unpacked(path) if read_start(path, 1) == b"{" else Archive(path)
    meta = archive.meta()
    antialiased = meta.get("antialias") is True or meta.get("model") == "antialiased"
    return LoadedScene(
        read_files(archive), archive.up(meta), antialiased, writer=archive.generator(meta))


def read_files(archive: SogFiles) -> SplatArrays:
    """Returns the Gaussians of the files of a .sog; see `load_sog`."""
    path, meta = archive.path, archive.meta()
    means, scales, quats, sh0 = (
        archive.part(meta, name) for name in ("means", "scales", "quats", "sh0"))
    count = archive.count(meta)
    low, high = archive.numbers(means, "mins", 3, 3), archive.numbers(means, "maxs", 3, 3)
    low_name, high_name = archive.files(means, 2)
    first = archive.pixels(low_name, count)
    size = (first.shape[1], first.shape[0])

    def rows(name: str) -> Bytes:
        return archive.pixels(name, count, size=size).reshape(-1, 4)[:count]

    low_bytes, high_bytes = first.reshape(-1, 4)[:count, :3], rows(high_name)[:, :3]
    turns, colors = rows(*archive.files(quats, 1)), rows(*archive.files(sh0, 1))
    if (turns[:, 3] < _TAG).any():
        raise archive.error("quaternions without their greatest component")
    return splats_from_arrays(path, {
        "means": unpack_means(low_bytes, high_bytes, low, high),
        "quats": decode_smallest_three(
            turns[:, 3].astype(np.int64) - _TAG, (turns[:, :3] / 255 * 2 - 1) / _ROOT2),
        "log_scales": archive.look_up(rows(*archive.files(scales, 1))[:, :3], scales),
        "logit_opacities": logit(colors[:, 3] / 255, LEAST_OPACITY),
        "sh_dc": archive.look_up(colors[:, :3], sh0),
        "sh_rest": _read_harmonics(archive, meta, rows),
    })


def _read_harmonics(
    archive: SogFiles, meta: dict[str, Any], rows: Callable[[str], Bytes]
) -> Floats:
    """Returns coefficients [M, T, 3]."""
    if meta.get("shN") is None:
        return np.zeros((0, 0, 3), np.float32)
    part = archive.part(meta, "shN")
    count = archive.integer(part, "count", 1, _MOST_16_BIT + 1)
    terms = TERMS[archive.integer(part, "bands", 1, 3)]
    entries_name, labels_name = archive.files(part, 2)
    width, lines = ROW * terms, -(-count // ROW)
    entries = archive.pixels(entries_name, width * lines, size=(width, lines))[:, :, :3]
    parts = rows(labels_name)
    labels = parts[:, 0] + 256 * parts[:, 1].astype(np.int64)
    if labels.max() >= count:
        raise archive.error(f"the label {labels.max()} of a palette of {count}")
    return np.asarray(archive.look_up(entries, part).reshape(-1, terms, 3)[labels])


def pack_means(means: Floats) -> tuple[Doubles, Doubles, NDArray[np.int64]]:
    """Returns the least and greatest logarithms [3] and 16-bit positions [N, 3] between them."""
    wide = means.astype(np.float64)
    logs = np.copysign(np.log1p(np.abs(wide)), wide)
    low, high = logs.min(axis=0), logs.max(axis=0)
    span = np.where(high > low, high - low, 1)
    return low, high, np.rint((logs - low) / span * _MOST_16_BIT).astype(np.int64)


def unpack_means(low_bytes: Bytes, high_bytes: Bytes, low: Doubles, high: Doubles) -> Floats:
    """Returns positions [N, 3]; infinite if the bounds are out of range."""
    steps = low_bytes.astype(np.float64) + 256.0 * high_bytes
    logs = low + (high - low) * (steps / _MOST_16_BIT)
    with np.errstate(over="ignore"):
        return np.copysign(np.expm1(np.abs(logs)), logs).astype(np.float32)


def pack_quats(quats: Floats) -> Bytes:
    """Returns unit quaternions [N, 4] as the three smaller components and a tag [N, 4]."""
    greatest, others = encode_smallest_three(quats)
    steps = np.rint((others.astype(np.float64) * _ROOT2 + 1) / 2 * 255).clip(0, 255)
    return np.column_stack([steps, _TAG + greatest]).astype(np.uint8)


def pack_harmonics(
    sh_rest: Floats, colored: int, rng: np.random.Generator, sharing: int
) -> tuple[dict[str, Any], dict[str, Bytes]]:
    """Returns the entry of meta.json and the images of coefficients [N, T, 3].

    The first `colored` Gaussians have any; the others share an entry of zeros.
    """
    n, terms = sh_rest.shape[:2]
    size = min(_MOST_16_BIT, -(-colored // sharing))
    entries, labels = fit_palette(sh_rest[:colored].reshape(colored, -1), size, rng)
    # Neighbours in space get neighbouring numbers, so that both images compress.
    order = np.argsort(np.bincount(labels, np.arange(colored)) / np.bincount(labels))
    labels, entries = np.argsort(order)[labels], entries[order]
    if colored < n:
        labels = np.append(labels, np.full(n - colored, len(entries)))
        entries = np.concatenate([entries, np.zeros((1, entries.shape[1]), np.float32)])
    book = fit_codebook(entries, rng)
    book[np.abs(book).argmin()] = 0
    lines = -(-len(entries) // ROW)
    filled = np.pad(entries, ((0, lines * ROW - len(entries)), (0, 0)))
    pixels = nearest_entries(filled, book).reshape(lines, ROW * terms, 3)
    rows = np.column_stack([labels & 255, labels >> 8, np.zeros_like(labels)]).astype(np.uint8)
    names = ["shN_centroids.webp", "shN_labels.webp"]
    return {"count": len(entries), "bands": TERMS.index(terms), "codebook": _json(book),
            "files": names}, dict(zip(names, (pixels, _image(rows)), strict=True))


class SogFiles(UntrustedFile):
    """The files of a .sog; every method raises FormatError if they break their own promises."""

    size: int  # of all files, bytes

    def read(self, name: str, most: int) -> bytes:
        """Returns the content of a file of at most `most` bytes."""
        raise NotImplementedError

    def meta(self) -> dict[str, Any]:
        """Returns the object in meta.json of version 2."""
        meta = self.json_object(self.read(META, MOST_HEAD_BYTES))
        if "version" not in meta and isinstance(meta.get("means"), dict):
            raise self.error("version 1 of the format, which is not supported")
        if self.integer(meta, "version", 0, sys.maxsize) != 2:
            raise self.error(f"version {meta['version']} of the format; version 2 can be read")
        return meta

    def part(self, meta: dict[str, Any], name: str) -> dict[str, Any]:
        """Returns an object of meta.json."""
        part = meta.get(name)
        if not isinstance(part, dict):
            raise self.error(f"a meta.json without {name}")
        return part

    def files(self, part: dict[str, Any], count: int) -> list[str]:
        """Returns the names of the images of a part."""
        names = part.get("files")
        if not isinstance(names, list) or len(names) != count or not all(
                isinstance(name, str) for name in names):
            raise self.error(f"files = {names!r:.40}; needed are {count} names")
        return names

    def look_up(self, indices: NDArray[np.uint8], part: dict[str, Any]) -> Floats:
        """Returns the numbers of a part's codebook, which has at most 256."""
        book = self.numbers(part, "codebook", 1, BOOK).astype(np.float32)
        if indices.max() >= len(book):
            raise self.error(f"the number {indices.max()} of a codebook of {len(book)}")
        return np.asarray(book[indices])

    def count(self, meta: dict[str, Any]) -> int:
        """Returns how many Gaussians there are, if they can be in files of that size."""
        count = self.integer(meta, "count", 1, _MAX_COUNT)
        self.check_count(count, self.size)
        return count

    def check_count(self, count: int, size: int) -> None:
        """Raises FormatError for implausibly many Gaussians: each takes about 16 bytes."""
        if count > _SMALL + size:
            raise self.error(f"{count} Gaussians in {size} bytes, as it claims")

    def pixels(
        self, name: str, count: int, *, size: tuple[int, int] | None = None
    ) -> NDArray[np.uint8]:
        """Returns the pixels [H, W, 4] of an image of at least `count` pixels, and not many more.

        `size` is the (width, height) that it must have; None for any.
        """
        most = max(4 * count, _SMALL)
        data = self.read(name, 4 * most + _HEADER)
        if data[8:16] == b"WEBPVP8 ":
            raise self.error(f"{name}, which has lossy compression that destroys its values")
        if (claimed := _webp_size(data)) is not None:
            self._check_size(claimed, name, count, most, size)
        try:
            with Image.open(io.BytesIO(data), formats=["WEBP", "PNG"]) as image:
                if image.mode not in ("RGB", "RGBA") or getattr(image, "n_frames", 1) != 1:
                    raise self.error(f"{name}, which is not a single image of 8 bits a channel")
                self._check_size(image.size, name, count, most, size)
                return np.asarray(image.convert("RGBA"))
        except (OSError, UnidentifiedImageError, ValueError, SyntaxError, zlib.error,
                Image.DecompressionBombError) as error:
            raise self.error(f"{name}, which is not an image: {error}") from error

    def _check_size(
        self, actual: tuple[int, int], name: str, count: int, most: int,
        needed: tuple[int, int] | None,
    ) -> None:
        width, height = actual
        if not count <= width * height <= most:
            raise self.error(f"{name} of {width}x{height} pixels for {count} values")
        if needed is not None and actual != needed:
            raise self.error(
                f"{name} of {width}x{height} pixels, needed are {needed[0]}x{needed[1]}")

class Archive(SogFiles):
    """An open .sog."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, _START, ".sog")
        self.size = len(self.data)
        if self.data.count(_ENTRY) > _ENTRIES:  # each costs half a kilobyte when it is listed
            raise self.error(f"more than {_ENTRIES} entries, which is not a .sog")
        try:
            self._zip = zipfile.ZipFile(io.BytesIO(self.data))
        except (OSError, zipfile.BadZipFile, ValueError, NotImplementedError) as error:
            raise self.error(f"a zip that is not a .sog: {error}") from error
        self._entries = {entry.filename: entry for entry in self._zip.infolist()}
        if len(self._entries) < len(self._zip.infolist()):
            raise self.error("two entries of one name")
        for name in self._entries:
            if leads_out(name):
                raise self.error(f"the entry {name!r:.80}, which leaves the archive")

    def read(self, name: str, most: int) -> bytes:
        """Returns the content of a file of at most `most` bytes."""
        entry = self._entries.get(name)
        if entry is None:
            raise self.error(f"no entry {name!r:.80}")
        if entry.flag_bits & 1 or entry.compress_type not in _METHODS:
            raise self.error(f"the entry {name}, which is encrypted or compressed unusually")
        try:
            with self._zip.open(entry) as file:
                data = file.read(most + 1)
                complete = len(data) <= most and not file.read(1)
        except (zipfile.BadZipFile, zlib.error, OSError, EOFError, ValueError, RuntimeError,
                NotImplementedError) as error:
            raise self.error(f"the entry {name}, which cannot be unpacked: {error}") from error
        if not complete:
            raise self.error(f"the entry {name}, which unpacks to more than {most} bytes")
        return data


class Unpacked(SogFiles):
    """The files of an unpacked .sog: meta.json, and the images beside it."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, b"{", META)
        self.size = sum(file.stat().st_size for file in path.parent.iterdir() if file.is_file())

    def read(self, name: str, most: int) -> bytes:
        """Returns the content of a file of at most `most` bytes."""
        if name == META:
            return self.data
        if "/" in name or leads_out(name):
            raise self.error(f"the name {name!r:.80}, which leaves the folder")
        try:
            return read_bytes(self.path.parent / name, most=most)
        except (OSError, ValueError) as error:
            raise self.error(f"{name}, which cannot be read: {error}") from error


def pack_archive(meta: dict[str, Any], images: dict[str, NDArray[np.uint8]]) -> bytes:
    """Returns the bytes of a .sog with images [H, W, 3] or [H, W, 4] by name.

    The same scene gives the same bytes: the date of all is the earliest that a zip can hold.
    """
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_STORED) as archive:
        text = json.dumps(meta, separators=(",", ":"), allow_nan=False)
        archive.writestr(zipfile.ZipInfo(META), text)
        with ThreadPoolExecutor(2) as pool:  # more take memory for little
            for name, encoded in zip(images, pool.map(encode_webp, images.values()), strict=True):
                archive.writestr(zipfile.ZipInfo(name), encoded)
    return data.getvalue()


def encode_webp(pixels: NDArray[np.uint8]) -> bytes:
    """Returns a lossless WebP of [H, W, 3] or [H, W, 4], exact under an alpha of 0 too."""
    data = io.BytesIO()
    # Method 4 takes 3.5 times as long for 1% less to 0.4% more bytes.
    Image.fromarray(np.ascontiguousarray(pixels)).save(
        data, "WEBP", lossless=True, exact=True, quality=75, method=2)
    return data.getvalue()


def _webp_size(data: bytes) -> tuple[int, int] | None:
    """Returns (width, height) of a WebP (RFC 9649) without decoding it; None for other images."""
    if data[8:12] != b"WEBP" or len(data) < 30:
        return None
    if data[12:16] == b"VP8L":
        bits = int.from_bytes(data[21:25], "little")
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    return int.from_bytes(data[24:27], "little") + 1, int.from_bytes(data[27:30], "little") + 1


FORMAT = SplatFormat(
    load_sog, lambda path, splats, settings: write_sog(
        path, splats.with_sphere(), sharing=settings.sharing, antialiased=settings.antialiased,
        up=settings.up_axis))
