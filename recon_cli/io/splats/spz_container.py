"""The frame of an SPZ file: its header and the six arrays of bytes, packed by gzip or zstd.

Versions 2 and 3 are one gzip stream (or the same bytes plain): a header of 16 bytes, then
positions, opacities, colours, scales, rotations and harmonics. Version 4 has a header of 32 bytes
and a table of sizes in the clear, and one zstd stream for each array that is not empty. It is
Niantic's: https://github.com/nianticlabs/spz. Version 1 was never released and is not read.

An unpacked array is as long as the header's count says, and no byte more is ever unpacked.
"""

from __future__ import annotations

import gzip
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import zstandard

from recon_cli.errors import FormatError
from recon_cli.io.splats.values import Bytes
from recon_cli.scene.splats import TERMS

_MAGIC = b"NGSP"
_HEADER = struct.Struct("<4sIIBBBB")  # magic, version, count, degree, bits, flags, streams
_MORE = struct.Struct("<I12x")  # of version 4: where the table of sizes begins
_SIZES = struct.Struct("<QQ")  # packed, unpacked
_EXTENSION = struct.Struct("<II")  # type, bytes that follow
_HAS_EXTENSIONS = 2
_EXTENSIONS_LIMIT = 1 << 20  # bytes
_ADOBE, _ORBIT_CAMERA = 0xADBE, 0xADBE0002
_MAX_FRACTIONAL_BITS = 24
# What a file may unpack to. Of a scene all of whose harmonics are 0 it is 5 times its size; small
# files do no harm.
_HARMLESS_BYTES, _MAX_RATIO = 1 << 24, 128
_ZSTD_LEVEL = 12  # that of Niantic's program


@dataclass(frozen=True)
class SpzHeader:
    """What the arrays are to be read with.

    Attributes:
        version: 2, 3 or 4.
        count: Gaussians, N.
        sh_degree: 0 to 3.
        fractional_bits: of the positions.
    """

    version: int
    count: int
    sh_degree: int
    fractional_bits: int

    @property
    def sizes(self) -> tuple[int, ...]:
        """Bytes of positions, opacities, colours, scales, rotations and harmonics."""
        rotation = 3 if self.version < 3 else 4
        each = (9, 1, 3, 3, rotation, 3 * TERMS[self.sh_degree])
        return tuple(self.count * size for size in each)


def pack(header: SpzHeader, arrays: list[Bytes]) -> bytes:
    """Returns the file of the six arrays, each of the header's size."""
    raw = [array.tobytes() for array in arrays]
    assert tuple(len(item) for item in raw) == header.sizes
    fields = (_MAGIC, header.version, header.count, header.sh_degree, header.fractional_bits, 0)
    if header.version < 4:
        return gzip.compress(_HEADER.pack(*fields, 0) + b"".join(raw), 6, mtime=0)
    raw = [item for item in raw if item]
    packed = [zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compress(item) for item in raw]
    sizes = [_SIZES.pack(len(small), len(large)) for small, large in zip(packed, raw, strict=True)]
    head = _HEADER.pack(*fields, len(raw)) + _MORE.pack(_HEADER.size + _MORE.size)
    return b"".join([head, *sizes, *packed])


def unpack(path: Path, data: bytes) -> tuple[SpzHeader, list[Bytes]]:
    """Returns the header and the six arrays of a file.

    Args:
        path: for messages.
        data: what lies in it.

    Raises:
        FormatError: the data is damaged, of another format or version, promises more than a file
            of its size can hold, or holds less or more than it promises.
    """
    try:
        if data.startswith(b"\x1f\x8b"):
            header, body = _unpack_gzip(path, data)
        elif data.startswith(_MAGIC):
            header, flags, streams = _parse(path, data[:_HEADER.size], len(data))
            if header.version == 4:
                body = _unpack_streams(path, data, header, flags, streams)
            else:
                body = _without_extensions(path, data[_HEADER.size:], header, flags)
        else:
            raise FormatError(f"{path} is no SPZ file.")
    except (zlib.error, zstandard.ZstdError) as error:
        raise FormatError(f"{path} cannot be unpacked: {error}.") from error
    ends = np.cumsum(header.sizes)[:-1]
    return header, np.split(np.frombuffer(body, np.uint8), ends)


def _parse(path: Path, head: bytes, size: int) -> tuple[SpzHeader, int, int]:
    """Returns the header, its flags and the number of streams, checked against the file's size."""
    if len(head) < _HEADER.size:
        raise _truncated(path)
    magic, version, count, degree, bits, flags, streams = _HEADER.unpack(head)
    if magic != _MAGIC:
        raise FormatError(f"{path} is no SPZ file.")
    if version not in (2, 3, 4):
        raise FormatError(f"{path} is of SPZ version {version}; 2, 3 and 4 can be read.")
    if degree >= len(TERMS):
        raise FormatError(f"{path} has harmonics of degree {degree}; at most 3 can be read.")
    if bits > _MAX_FRACTIONAL_BITS:
        raise FormatError(f"{path} has positions of {bits} fractional bits, above 24: damaged.")
    header = SpzHeader(version, count, degree, bits)
    if not count or sum(header.sizes) > _HARMLESS_BYTES + _MAX_RATIO * size:
        raise FormatError(
            f"{path} promises {count} Gaussians, which do not fit into its {size} bytes.",
            hint="Copy the file again, or ask who made it.")
    return header, flags, streams


def _unpack_gzip(path: Path, data: bytes) -> tuple[SpzHeader, bytes]:
    stream = zlib.decompressobj(wbits=31)
    head = stream.decompress(data, _HEADER.size)
    header, flags, _ = _parse(path, head, len(data))
    if header.version == 4:
        raise FormatError(f"{path} is of version 4 but packed as older ones are: it is damaged.")
    limit = sum(header.sizes) + (_EXTENSIONS_LIMIT if flags & _HAS_EXTENSIONS else 0)
    body = stream.decompress(stream.unconsumed_tail, limit)
    if stream.decompress(stream.unconsumed_tail, 1) or stream.unused_data:
        raise _too_long(path)
    if not stream.eof:
        raise _truncated(path)
    return header, _without_extensions(path, body, header, flags)


def _without_extensions(path: Path, body: bytes, header: SpzHeader, flags: int) -> bytes:
    size = sum(header.sizes)
    if len(body) < size:
        raise _truncated(path)
    if flags & _HAS_EXTENSIONS:
        _check_extensions(path, body[size:])
    elif len(body) > size:
        raise _too_long(path)
    return body[:size]


def _unpack_streams(
    path: Path, data: bytes, header: SpzHeader, flags: int, streams: int
) -> bytes:
    promised = [size for size in header.sizes if size]
    begin = _HEADER.size + _MORE.size
    if len(data) < begin:
        raise _truncated(path)
    table = _MORE.unpack_from(data, _HEADER.size)[0]
    start = table + _SIZES.size * streams
    if streams != len(promised) or table < begin or start > len(data):
        raise FormatError(f"{path} has {streams} streams where {len(promised)} belong: damaged.")
    if flags & _HAS_EXTENSIONS:
        _check_extensions(path, data[begin:table])
    parts = []
    for i, size in enumerate(promised):
        packed, unpacked = _SIZES.unpack_from(data, table + _SIZES.size * i)
        stream, start = data[start:start + packed], start + packed
        # The frame says its own size as well, and zstandard would take that much memory.
        if unpacked != size or zstandard.frame_content_size(stream) not in (-1, size):
            raise FormatError(f"{path} has a stream of {unpacked} bytes where {size} belong.")
        parts.append(zstandard.ZstdDecompressor().decompress(
            stream, max_output_size=size, allow_extra_data=False))
        if len(parts[-1]) != size:
            raise _truncated(path)
    if start != len(data):
        raise _too_long(path) if start < len(data) else _truncated(path)
    return b"".join(parts)


def _check_extensions(path: Path, data: bytes) -> None:
    """Raises FormatError for extensions that change what the arrays mean, and for damaged ones.

    Unknown ones of other makers are passed over, as the format demands. Of Adobe's the limits of
    an orbiting camera are harmless; others turn the axes or stretch the harmonics.
    """
    start = 0
    while start < len(data):
        if start + _EXTENSION.size > len(data):
            raise _truncated(path)
        kind, size = _EXTENSION.unpack_from(data, start)
        if kind >> 16 == _ADOBE and kind != _ORBIT_CAMERA:
            raise FormatError(
                f"{path} has the extension {kind:#x}, which changes what its values mean.",
                hint="Write it again without extensions.")
        start += _EXTENSION.size + size
    if start > len(data):
        raise _truncated(path)


def _truncated(path: Path) -> FormatError:
    return FormatError(f"{path} ends too early: it is truncated.", hint="Copy the file again.")


def _too_long(path: Path) -> FormatError:
    return FormatError(f"{path} holds more than its header promises: it is damaged or a trap.")
