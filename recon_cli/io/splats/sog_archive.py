"""The zip of a .sog and its meta.json, checked before they are trusted.

Nothing is unpacked to the disk. Sizes in a zip's directory are only claims, so every entry is read
up to a bound that follows from the number of Gaussians, which the size of the file bounds in turn.
"""

from __future__ import annotations

import io
import json
import sys
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from recon_cli.io.splats.codebooks import BOOK
from recon_cli.io.splats.values import Floats, UntrustedFile

META = "meta.json"
_META_LIMIT = 1 << 20  # bytes; three codebooks of 256 numbers need a hundredth of it
_SMALL = 1 << 20  # Gaussians or pixels that are always accepted: a few hundred MB
_START, _ENTRY = b"PK\x03\x04", b"PK\x01\x02"  # of the file, and of each entry of its directory
_ENTRIES = 64  # a .sog has eight
_HEADER = 1 << 16  # bytes of an image beside its pixels
_DATE = (1980, 1, 1, 0, 0, 0)  # the earliest that a zip can hold: the same scene, the same bytes
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # others cannot be stopped at a bound
_MAX_ENTRIES = 65536  # of a palette: labels are 16 bits
_MAX_COUNT = 16383 * 16383  # pixels of the largest WebP


class Archive(UntrustedFile):
    """An open .sog; every method raises FormatError if the file does not hold what it promises."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, _START, ".sog")
        if self.data.count(_ENTRY) > _ENTRIES:  # each costs half a kilobyte when it is listed
            raise self.error(f"more than {_ENTRIES} entries: no .sog")
        try:
            self._zip = zipfile.ZipFile(io.BytesIO(self.data))
        except (OSError, zipfile.BadZipFile, ValueError, NotImplementedError) as error:
            raise self.error(f"a zip that is no .sog: {error}") from error
        self._entries = {entry.filename: entry for entry in self._zip.infolist()}
        if len(self._entries) < len(self._zip.infolist()):
            raise self.error("two entries of one name")
        for name in self._entries:
            if _escapes(name):
                raise self.error(f"the entry {name!r:.80}, which leaves the archive")

    def meta(self) -> dict[str, Any]:
        """Returns the object in meta.json."""
        return self.json_object(self._read(META, _META_LIMIT))

    def check_count(self, count: int) -> None:
        """Raises FormatError for more Gaussians than a file of this size is likely to hold.

        They take about 16 bytes each; images of one colour take none, however large they are.
        """
        if count > _SMALL + len(self.data):
            raise self.error(f"{count} Gaussians in {len(self.data)} bytes, as it claims")

    def pixels(
        self, name: str, count: int, *, size: tuple[int, int] | None = None
    ) -> NDArray[np.uint8]:
        """Returns the pixels [H, W, 4] of an image of at least `count` pixels, and not many more.

        `size` is the (width, height) that it must have; None for any.
        """
        most = max(4 * count, _SMALL)
        data = self._read(name, 4 * most + _HEADER)
        if data[8:16] == b"WEBPVP8 ":
            raise self.error(f"{name}, which has lossy compression that destroys its values")
        self._check_size(_webp_size(data), name, count, most, size)
        try:
            with Image.open(io.BytesIO(data), formats=["WEBP", "PNG"]) as image:
                if image.mode not in ("RGB", "RGBA") or getattr(image, "n_frames", 1) != 1:
                    raise self.error(f"{name}, which is no single image of 8 bits a channel")
                self._check_size(image.size, name, count, most, size)
                return np.asarray(image.convert("RGBA"))
        except (OSError, UnidentifiedImageError, ValueError, SyntaxError, zlib.error,
                Image.DecompressionBombError) as error:
            raise self.error(f"{name}, which is no image: {error}") from error

    def _check_size(
        self, actual: tuple[int, int] | None, name: str, count: int, most: int,
        needed: tuple[int, int] | None,
    ) -> None:
        if actual is None:
            return
        width, height = actual
        if not count <= width * height <= most:
            raise self.error(f"{name} of {width}x{height} pixels for {count} values")
        if needed is not None and actual != needed:
            raise self.error(
                f"{name} of {width}x{height} pixels, needed are {needed[0]}x{needed[1]}")

    def _read(self, name: str, most: int) -> bytes:
        entry = self._entries.get(name)
        if entry is None:
            raise self.error(f"no entry {name!r:.80}")
        if entry.flag_bits & 1 or entry.compress_type not in _METHODS:
            raise self.error(f"the entry {name}, which is encrypted or compressed unusually")
        try:
            with self._zip.open(entry) as file:
                data = file.read(most + 1)
                whole = len(data) <= most and not file.read(1)
        except (zipfile.BadZipFile, zlib.error, OSError, EOFError, ValueError, RuntimeError,
                NotImplementedError) as error:
            raise self.error(f"the entry {name}, which cannot be unpacked: {error}") from error
        if not whole:
            raise self.error(f"the entry {name}, which unpacks to more than {most} bytes")
        return data


def pack_archive(meta: dict[str, Any], images: dict[str, NDArray[np.uint8]]) -> bytes:
    """Returns the bytes of a .sog with images [H, W, 3] or [H, W, 4] by name.

    The same arguments give the same bytes.
    """
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_STORED) as archive:
        text = json.dumps(meta, separators=(",", ":"), allow_nan=False)
        archive.writestr(zipfile.ZipInfo(META, _DATE), text)
        for name, pixels in images.items():
            archive.writestr(zipfile.ZipInfo(name, _DATE), encode_webp(pixels))
    return data.getvalue()


def encode_webp(pixels: NDArray[np.uint8]) -> bytes:
    """Returns a lossless WebP of [H, W, 3] or [H, W, 4], exact under an alpha of 0 too."""
    data = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(
        data, "WEBP", lossless=True, exact=True, quality=75, method=4)
    return data.getvalue()


def _webp_size(data: bytes) -> tuple[int, int] | None:
    """Returns (width, height) from the header of a WebP (RFC 9649); None for other images.

    Pillow's decoder allocates memory when it opens a file, before it reports the size.
    """
    if data[8:12] != b"WEBP" or len(data) < 30:
        return None
    if data[12:16] == b"VP8L":
        bits = int.from_bytes(data[21:25], "little")
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    return int.from_bytes(data[24:27], "little") + 1, int.from_bytes(data[27:30], "little") + 1


def _escapes(name: str) -> bool:
    """Returns whether a path would lead out of the folder that it is unpacked to."""
    path = PurePosixPath(name.replace("\\", "/"))
    return path.is_absolute() or ".." in path.parts or ":" in name or "\0" in name


@dataclass(frozen=True, eq=False)
class Harmonics:
    """Coefficients of degrees 1 and up, as meta.json describes them."""

    count: int  # entries of the palette
    degree: int  # 1 to 3
    codebook: Floats  # at most 256 numbers
    files: tuple[str, ...]  # names of the palette's image and of the labels'


@dataclass(frozen=True, eq=False)
class Meta:
    """The checked content of meta.json."""

    count: int  # Gaussians
    low: NDArray[np.float64]  # [3] least logarithm of a position by axis
    high: NDArray[np.float64]  # [3] greatest
    means: tuple[str, ...]  # names of the images of the low and the high bytes
    scales: Floats  # codebook of the logarithms of scales
    scales_file: str  # name of their image
    quats_file: str  # name of the image of quaternions
    sh0: Floats  # codebook of the colours
    sh0_file: str  # name of the image of colours and opacities
    harmonics: Harmonics | None  # None at degree 0


def read_meta(archive: Archive) -> Meta:
    """Returns the checked meta.json of an archive."""
    value = archive.meta()
    if "version" not in value and isinstance(value.get("means"), dict):
        raise archive.error("version 1 of the format, which is not supported")
    if archive.whole(value, "version", 0, sys.maxsize) != 2:
        raise archive.error(f"version {value['version']} of the format; version 2 can be read")
    means, scales, quats, sh0 = (
        _part(value, name, archive) for name in ("means", "scales", "quats", "sh0"))
    return Meta(
        count=archive.whole(value, "count", 1, _MAX_COUNT),
        low=archive.numbers(means, "mins", 3, 3), high=archive.numbers(means, "maxs", 3, 3),
        means=_files(means, 2, archive),
        scales=_book(scales, archive), scales_file=_files(scales, 1, archive)[0],
        quats_file=_files(quats, 1, archive)[0],
        sh0=_book(sh0, archive), sh0_file=_files(sh0, 1, archive)[0],
        harmonics=_harmonics(value, archive))


def _harmonics(value: dict[str, Any], archive: Archive) -> Harmonics | None:
    if value.get("shN") is None:
        return None
    part = _part(value, "shN", archive)
    return Harmonics(
        archive.whole(part, "count", 1, _MAX_ENTRIES), archive.whole(part, "bands", 1, 3),
        _book(part, archive), _files(part, 2, archive))


def _part(value: dict[str, Any], name: str, archive: Archive) -> dict[str, Any]:
    part = value.get(name)
    if not isinstance(part, dict):
        raise archive.error(f"a meta.json without {name}")
    return part


def _book(part: dict[str, Any], archive: Archive) -> Floats:
    return archive.numbers(part, "codebook", 1, BOOK).astype(np.float32)


def _files(part: dict[str, Any], count: int, archive: Archive) -> tuple[str, ...]:
    value = part.get("files")
    if not isinstance(value, list) or len(value) != count or not all(
            isinstance(name, str) for name in value):
        raise archive.error(f"files = {value!r:.40}; needed are {count} names")
    return tuple(value)
