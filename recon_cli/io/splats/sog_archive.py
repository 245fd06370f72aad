"""The zip of a .sog: JSON and lossless images, none of them taken larger than it may be.

Nothing is unpacked to the disk. Sizes in a zip's directory are what its writer claims, so every
entry is read up to a bound that the number of Gaussians sets, and that number is bound by the size
of the file.
"""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from recon_cli.errors import FormatError

META = "meta.json"
_META_LIMIT = 1 << 20  # bytes; three codebooks of 256 numbers need a hundredth of it
_SMALL = 1 << 20  # Gaussians or pixels that are taken without asking how: a few hundred MB
_START, _ENTRY = b"PK\x03\x04", b"PK\x01\x02"  # of a zip, and of each entry of its directory
_ENTRIES = 64  # a .sog has eight
_HEADER = 1 << 16  # bytes of an image beside its pixels
_HINT = "Write or copy the file again."
_DATE = (1980, 1, 1, 0, 0, 0)  # the first one that a zip can hold: the same scene, the same bytes
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # the others do not stop at a bound


class Archive:
    """An open .sog.

    Raises:
        FormatError: from every method, where the file does not hold what it promises.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            with path.open("rb") as file:
                if file.read(len(_START)) != _START:
                    raise FormatError(f"{path} is no .sog.")
                self._data = _START + file.read()
            if self._data.count(_ENTRY) > _ENTRIES:  # each costs half a kilobyte when it is listed
                raise self.damaged(f"more than {_ENTRIES} entries: no .sog")
            self._zip = zipfile.ZipFile(io.BytesIO(self._data))
        except OSError as error:
            raise FormatError(f"{path} cannot be read: {error}.") from error
        except (zipfile.BadZipFile, ValueError, NotImplementedError) as error:
            raise FormatError(f"{path} is no .sog: {error}.", hint=_HINT) from error
        self._entries = {entry.filename: entry for entry in self._zip.infolist()}
        if len(self._entries) < len(self._zip.infolist()):
            raise self.damaged("two entries of one name")
        for name in self._entries:
            if _leaves(name):
                raise self.damaged(f"the entry {name!r:.80}, which leaves the archive")

    def damaged(self, found: str) -> FormatError:
        """Returns the error that says what was found in this file."""
        return FormatError(f"{self._path} holds {found}.", hint=_HINT)

    def meta(self) -> dict[str, Any]:
        """Returns what meta.json says."""
        try:
            value = json.loads(self._read(META, _META_LIMIT), parse_constant=_no_constant)
        except (ValueError, RecursionError) as error:
            raise self.damaged(f"a {META} that cannot be read: {error}") from error
        if not isinstance(value, dict):
            raise self.damaged(f"a {META} that is no set of names")
        return value

    def check_count(self, count: int) -> None:
        """Raises FormatError for more Gaussians than a file of this size can be trusted to hold.

        They take about 16 bytes each; images of one colour take none, however large they are.
        """
        if count > _SMALL + len(self._data):
            raise self.damaged(f"{count} Gaussians in {len(self._data)} bytes, as it claims")

    def pixels(
        self, name: str, count: int, *, size: tuple[int, int] | None = None
    ) -> NDArray[np.uint8]:
        """Returns the pixels [H, W, 4] of an image.

        Args:
            name: of its entry.
            count: pixels that it has at least, and not many more.
            size: (width, height) that it has to have; None for any.
        """
        most = max(4 * count, _SMALL)
        data = self._read(name, 4 * most + _HEADER)
        if data[8:16] == b"WEBPVP8 ":
            raise self.damaged(f"{name}, which is compressed with losses: its numbers are gone")
        self._check_size(_webp_size(data), name, count, most, size)
        try:
            with Image.open(io.BytesIO(data), formats=["WEBP", "PNG"]) as image:
                if image.mode not in ("RGB", "RGBA") or getattr(image, "n_frames", 1) != 1:
                    raise self.damaged(f"{name}, which is no single image of 8 bits a channel")
                self._check_size(image.size, name, count, most, size)
                return np.asarray(image.convert("RGBA"))
        except (OSError, UnidentifiedImageError, ValueError, SyntaxError, zlib.error,
                Image.DecompressionBombError) as error:
            raise self.damaged(f"{name}, which is no image: {error}") from error

    def _check_size(
        self, found: tuple[int, int] | None, name: str, count: int, most: int,
        needed: tuple[int, int] | None,
    ) -> None:
        if found is None:
            return
        width, height = found
        if not count <= width * height <= most:
            raise self.damaged(f"{name} of {width}x{height} pixels for {count} values")
        if needed is not None and found != needed:
            raise self.damaged(
                f"{name} of {width}x{height} pixels, needed are {needed[0]}x{needed[1]}")

    def _read(self, name: str, most: int) -> bytes:
        entry = self._entries.get(name)
        if entry is None:
            raise self.damaged(f"no entry {name!r:.80}")
        if entry.flag_bits & 1 or entry.compress_type not in _METHODS:
            raise self.damaged(f"the entry {name}, which is encrypted or compressed unusually")
        try:
            with self._zip.open(entry) as file:
                data = file.read(most + 1)
                whole = len(data) <= most and not file.read(1)
        except (zipfile.BadZipFile, zlib.error, OSError, EOFError, ValueError, RuntimeError,
                NotImplementedError) as error:
            raise self.damaged(f"the entry {name}, which cannot be unpacked: {error}") from error
        if not whole:
            raise self.damaged(f"the entry {name}, which unpacks to more than {most} bytes")
        return data


def packed(meta: dict[str, Any], images: dict[str, NDArray[np.uint8]]) -> bytes:
    """Returns the bytes of a .sog; the same arguments give the same bytes.

    Args:
        meta: becomes meta.json.
        images: [H, W, 3] or [H, W, 4] by name.
    """
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_STORED) as archive:
        text = json.dumps(meta, separators=(",", ":"), allow_nan=False)
        archive.writestr(zipfile.ZipInfo(META, _DATE), text)
        for name, pixels in images.items():
            archive.writestr(zipfile.ZipInfo(name, _DATE), webp(pixels))
    return data.getvalue()


def webp(pixels: NDArray[np.uint8]) -> bytes:
    """Returns a lossless WebP of [H, W, 3] or [H, W, 4], exact under an alpha of 0 too."""
    data = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(
        data, "WEBP", lossless=True, exact=True, quality=75, method=4)
    return data.getvalue()


def _webp_size(data: bytes) -> tuple[int, int] | None:
    """Returns (width, height) by the header of a WebP (RFC 9649); None for other images.

    The decoder of Pillow takes memory for both when the file is opened, before its size is known.
    """
    if data[8:12] != b"WEBP" or len(data) < 30:
        return None
    if data[12:16] == b"VP8L":
        bits = int.from_bytes(data[21:25], "little")
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    return int.from_bytes(data[24:27], "little") + 1, int.from_bytes(data[27:30], "little") + 1


def _leaves(name: str) -> bool:
    """Returns whether a path would lie outside of the folder that it is unpacked to."""
    path = PurePosixPath(name.replace("\\", "/"))
    return path.is_absolute() or ".." in path.parts or ":" in name or "\0" in name


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is no number of JSON")
