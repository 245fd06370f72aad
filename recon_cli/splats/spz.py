"""SPZ, Niantic's compact format: 20 bytes a Gaussian and one for each coefficient, then compressed.

Source: https://github.com/nianticlabs/spz. Positions are fixed point numbers of 24 bits, log scales
and colours bytes, opacities bytes after the sigmoid, rotations the smallest three components of the
quaternion (bytes of x, y and z in version 2), harmonics bytes of 1/128.

The extension 0xADBE0003 says which axes a file has. Without it the documentation says RUB, but the
programs that are used write and read the axes of the .ply they convert, which is RDF: docs/formats.
It is written in version 4 alone, since readers of the older ones refuse or misread such a file. In
versions 2 and 3 a comment in the header of gzip, which every program skips, says which axis is up.

Versions 1 to 3 are one gzip stream (or the same bytes plain): a header of 16 bytes, then
positions, opacities, colours, scales, rotations and harmonics. Version 4 has an uncompressed header
of 32 bytes and table of sizes, and one zstd stream for each array that is not empty. Version 1,
whose positions are float16, is only read. Never more is unpacked than the header's count implies.
"""

from __future__ import annotations

import logging
import math
import re
import struct
import zlib
from dataclasses import dataclass, replace
from enum import IntEnum, IntFlag
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import zstandard
from numpy.typing import NDArray

from recon_cli.errors import FormatError
from recon_cli.scene.splat_arrays import TERMS, SplatArrays
from recon_cli.splats.axes import (
    AXES,
    PLY,
    Z_UP,
    read_up_comment,
    turn_from,
    up_comment,
    up_of,
)
from recon_cli.splats.foreign import accept_surplus, warn_of_degree
from recon_cli.splats.format import LoadedScene, SplatFormat, WriteSettings
from recon_cli.splats.values import (
    HARMLESS_BYTES,
    MAX_RATIO,
    MOST_HEAD_BYTES,
    Bytes,
    Floats,
    decode_opacities,
    decode_smallest_three,
    encode_opacities,
    encode_smallest_three,
    read_contents,
    round_to_bytes,
    splats_from_arrays,
    to_arrays,
)
from recon_cli.workspace.atomic import write_bytes

if TYPE_CHECKING:
    from recon_cli.scene.splats import Splats

logger = logging.getLogger("recon")

_FEWEST_BITS, POSITION_BITS = 8, 12  # fractional bits of a position: fewest, and Niantic's
_MAX_FRACTIONAL_BITS = 24  # as a position has in all
_MOST = (1 << _MAX_FRACTIONAL_BITS - 1) - 1  # of a position, in fractions
# Of the median Gaussian's size, by which a position is rounded. In a close-up of 0.2 mm Gaussians
# 1/10 loses .34 dB, 1/20 .16 and 1/40 .11; each halving takes 2% more bytes.
_ROUNDING = 1 / 32
_SCALE_STEPS, _SCALE_OFFSET = 16, 10  # byte = (log scale + 10) * 16
_LARGEST_SCALE = 255 / _SCALE_STEPS - _SCALE_OFFSET
# That an SPZ file holds, in units of the scene: sizes of Gaussians, and a coordinate.
LARGEST_SCALE, SMALLEST_SCALE = math.exp(_LARGEST_SCALE), math.exp(-_SCALE_OFFSET)
FARTHEST = _MOST / 2.0**_FEWEST_BITS
_COLOR = 0.15  # byte = (0.15 * dc + 0.5) * 255, so that dc of -3.33 to 3.33 fit
_HARMONIC = 128
# In steps of 2 of the 256 a trained scene of degree 3 packs to 1/8.2 of its .ply instead of 1/7.0
# and loses .003 dB; in steps of 4 it loses .2 dB. Niantic's program uses 8 and 16.
_HARMONIC_STEP = 2
_MAGNITUDE = 511  # of a component of a rotation; 9 bits and a sign
_XYZW = [1, 2, 3, 0]
VERSIONS = (2, 3, 4)  # that are written
_HALVES = 1  # the version whose positions are float16
_MAGIC = b"NGSP"
_HEAD = struct.Struct("<4sIIBBBB")  # magic, version, count, degree, bits, flags, streams
_MORE = struct.Struct("<I12x")  # of version 4: where the table of sizes begins
_SIZES = struct.Struct("<QQ")  # packed, unpacked
_EXTENSION = struct.Struct("<II")  # type, bytes that follow
_AXES_RECORD = struct.Struct("<III")  # type, 4, and a number of AXES from 1; 0 means none
_AXES_BY_UP = {"z": Z_UP, "-y": PLY, "y": "rub"}  # names in version 4 of axes as they are, by up
# A header of gzip that has no time and no system; a comment up to a 0 follows and nothing else.
_GZIP_HEADER = b"\x1f\x8b\x08\x10\0\0\0\0\0\xff"
_COMMENT = re.compile(re.escape(_GZIP_HEADER) + rb"([ -~]{,40})\0")
# Coefficients a channel that a file may have; those above degree 3 are cut off.
_FILE_TERMS = (*TERMS, 24)
_ZSTD_LEVEL = 12  # of Niantic's program, whose level of gzip is that of zlib


class _Flag(IntFlag):
    """Bits of the header."""

    ANTIALIASED = 1
    EXTENSIONS = 2


class _Extension(IntEnum):
    """Types of extensions; the upper half is the vendor, Adobe."""

    ORBIT_CAMERA = 0xADBE0002
    AXES = 0xADBE0003


def write_spz(
    path: Path, splats: Splats | SplatArrays, *, version: int = 3, up: str | None = None,
    antialiased: bool = False,
) -> None:
    """Writes `splats` to `path`, whole or not at all; see `spz_bytes`."""
    write_bytes(path, spz_bytes(path, splats, version=version, up=up, antialiased=antialiased))


def spz_bytes(
    path: Path, splats: Splats | SplatArrays, *, version: int = 3,
    harmonic_step: int = _HARMONIC_STEP, least_bits: int = POSITION_BITS, up: str | None = None,
    antialiased: bool = False,
) -> bytes:
    """Returns the bytes of an SPZ file of `splats`, whose values are written as they are.

    `up` is the axis that is up, z, -y or y, which the file records; None leaves it out.

    Log scales below -10 become -10, and above 5.9375, with a warning, 5.9375; coefficients outside
    -1 to 127/128 and dc outside -3.33 to 3.33 are clipped. Positions get `least_bits` fractional
    bits, 12 in Niantic's program, more where these move a Gaussian visibly, and fewer, down to 8,
    where they do not fit. `version` is 3, which most readers support, 2, with coarser rotations,
    or 4. `harmonic_step` is in 1/128; 1 is the finest. `path` is for messages. FormatError if there
    are no Gaussians, one is too far away, or a parameter is not finite.
    """
    if version not in VERSIONS:
        raise ValueError(f"SPZ version {version} is not one of {VERSIONS}")
    values = SplatArrays.from_parameters(to_arrays(splats, path.name))
    means, quats, log_scales = values.means, values.quats, values.log_scales
    large = int((log_scales.max(axis=1) > _LARGEST_SCALE).sum())
    if large:
        logger.warning(
            "%s: %s Gaussians are made smaller: SPZ holds e^%g units, the largest has e^%.1f",
            path.name, f"{large:,}", _LARGEST_SCALE, log_scales.max())
    # the two larger axes of a Gaussian are what is seen of it
    fine = int((np.median(log_scales, axis=1) < -_SCALE_OFFSET).sum())
    if fine:
        logger.warning("%s: %s Gaussians are made larger: SPZ holds e^%d units and more",
                       path.name, f"{fine:,}", -_SCALE_OFFSET)
    bits = _fractional_bits(path, means, max(least_bits, _useful_bits(log_scales)))
    axes = None if up is None else _AXES_BY_UP[up]
    header = SpzHeader(version, len(splats), values.sh_degree, bits, axes, up, antialiased)
    return pack(header, [
        _position_bytes(means, bits),
        encode_opacities(values.logit_opacities),
        round_to_bytes(255 * (_COLOR * values.sh_dc + 0.5)),
        round_to_bytes(_SCALE_STEPS * (log_scales + _SCALE_OFFSET)),
        _vector_bytes(quats) if version < 3 else _rotation_bytes(quats),
        round_to_bytes(_HARMONIC + harmonic_step * np.rint(
            values.sh_rest * (_HARMONIC / harmonic_step))),
    ])


def load_spz(path: Path, *, axes: str | None = None) -> LoadedScene:
    """Returns the scene of an SPZ file of version 1 to 4, in the file's order and degree.

    It is turned from `axes`, or from those that the file names, as `axes.turn_from` does;
    without either it stays. Harmonics of degree 4 are cut, with a warning. FormatError if the file
    is missing, damaged, or of another format or version.
    """
    return spz_scene(path, read_contents(path), axes=axes)


def spz_scene(path: Path, data: bytes, *, axes: str | None = None) -> LoadedScene:
    """Returns the scene of the bytes of an SPZ file; see `load_spz`."""
    header, (places, opacities, colors, scales, rotations, harmonics) = unpack(path, data)
    n, kept = header.count, TERMS[min(header.sh_degree, len(TERMS) - 1)]
    warn_of_degree(path, header.sh_degree)
    coefficients = harmonics.reshape(n, _FILE_TERMS[header.sh_degree], 3)[:, :kept]
    splats = splats_from_arrays(path, {
        "means": _halves(places) if header.version == _HALVES else _positions(
            places, header.fractional_bits),
        "quats": _rotations(rotations.reshape(n, -1)),
        "log_scales": scales.astype(np.float32).reshape(n, 3) / _SCALE_STEPS - _SCALE_OFFSET,
        "logit_opacities": decode_opacities(opacities),
        "sh_dc": (colors.astype(np.float32).reshape(n, 3) / 255 - 0.5) / _COLOR,
        "sh_rest": (coefficients.astype(np.float32) - _HARMONIC) / _HARMONIC,
    })
    axes = axes or header.axes
    if axes is None:
        return LoadedScene(splats, header.up, header.antialiased)
    return LoadedScene(turn_from(axes, splats), up_of(axes), header.antialiased)


def _useful_bits(log_scales: Floats) -> int:
    """Returns the fewest fractional bits that round the median Gaussian by `_ROUNDING` at most."""
    size = float(np.median(log_scales)) / math.log(2)
    return math.ceil(-size - 1 - math.log2(_ROUNDING))


def _fractional_bits(path: Path, means: Floats, most: int) -> int:
    """Returns the most fractional bits, at most `most`, with which every position fits."""
    farthest = float(np.abs(means).max())
    for bits in range(min(most, _MAX_FRACTIONAL_BITS), _FEWEST_BITS - 1, -1):
        if np.rint(farthest * 2.0**bits) <= _MOST:
            return bits
    raise FormatError(
        f"A Gaussian lies {farthest:g} units from the origin, too far for {path}: up to "
        f"{FARTHEST:.0f} fit.",
        hint="Remove it, scale the scene down, or write a .ply.")


def _position_bytes(means: Floats, bits: int) -> Bytes:
    fixed = np.rint(means.astype(np.float64) * 2.0**bits).astype("<i4")
    return fixed.view(np.uint8).reshape(-1, 3, 4)[:, :, :3]


def _positions(data: Bytes, bits: int) -> Floats:
    wide = np.zeros((len(data) // 9, 3, 4), np.uint8)
    wide[:, :, 1:] = data.reshape(-1, 3, 3)
    fixed = wide.view("<i4")[:, :, 0] >> 8  # the shift carries the sign down
    return (fixed / 2.0**bits).astype(np.float32)


def _halves(data: Bytes) -> Floats:
    return data.view("<f2").astype(np.float32).reshape(-1, 3)


def _rotation_bytes(quats: Floats) -> Bytes:
    """Returns [N, 4] bytes of unit quaternions wxyz; in the file components are in order xyzw."""
    largest, others = encode_smallest_three(quats[:, _XYZW])
    magnitude = np.rint(np.abs(others) * (np.sqrt(2) * _MAGNITUDE)).astype(np.uint32)
    fields = np.minimum(magnitude, _MAGNITUDE) | np.uint32(512) * (others < 0)
    words = largest.astype(np.uint32) << 30 | fields[:, 0] << 20 | fields[:, 1] << 10 | fields[:, 2]
    return np.ascontiguousarray(words, "<u4").view(np.uint8).reshape(-1, 4)


def _vector_bytes(quats: Floats) -> Bytes:
    """Returns [N, 3] bytes of x, y and z, where w is at least 0."""
    return round_to_bytes(np.where(quats[:, :1] < 0, -1, 1) * quats[:, 1:] * 127.5 + 127.5)


def _rotations(data: Bytes) -> Floats:
    """Returns quaternions wxyz from [N, 4] bytes, or from the [N, 3] of versions 1 and 2."""
    if data.shape[1] == 3:
        vector = data.astype(np.float32) / 127.5 - 1
        real = np.sqrt(np.maximum(0, 1 - (vector * vector).sum(axis=1, keepdims=True)))
        return np.concatenate([real, vector], axis=1)
    word = np.ascontiguousarray(data).view("<u4")
    fields = word >> np.array([20, 10, 0], np.uint32) & 1023
    sizes = (fields & _MAGNITUDE) / (np.sqrt(2) * _MAGNITUDE)
    others = np.where(fields & 512, -sizes, sizes).astype(np.float32)
    largest: NDArray[np.int64] = (word[:, 0] >> 30).astype(np.int64)
    return decode_smallest_three(largest, others)[:, np.argsort(_XYZW)]


@dataclass(frozen=True)
class SpzHeader:
    """Version, count, degree, precision and axes of the arrays."""

    version: int  # 1 to 4
    count: int  # Gaussians, N
    sh_degree: int  # 0 to 4
    fractional_bits: int  # of the positions
    axes: str | None = None  # a name in AXES; None where the file does not say
    up: str | None = None  # the axis that is up, by a comment of our own
    antialiased: bool = False

    @property
    def sizes(self) -> tuple[int, ...]:
        """Bytes of positions, opacities, colours, scales, rotations and harmonics."""
        each = (6 if self.version == _HALVES else 9, 1, 3, 3, 3 if self.version < 3 else 4,
                3 * _FILE_TERMS[self.sh_degree])
        return tuple(self.count * size for size in each)

    @property
    def gaussian_bytes(self) -> int:
        """Bytes of a Gaussian."""
        return sum(self.sizes) // self.count


def pack(header: SpzHeader, arrays: list[Bytes]) -> bytes:
    """Returns the file of the six arrays, each of the header's size."""
    raw = [array.tobytes() for array in arrays]
    assert tuple(len(item) for item in raw) == header.sizes
    flags = _Flag.ANTIALIASED if header.antialiased else 0
    fields = (_MAGIC, header.version, header.count, header.sh_degree, header.fractional_bits)
    if header.version < 4:
        return _gzip(_HEAD.pack(*fields, flags, 0) + b"".join(raw), header.up)
    record = b"" if header.axes is None else _AXES_RECORD.pack(
        _Extension.AXES, 4, 1 + AXES.index(header.axes))
    flags |= _Flag.EXTENSIONS if record else 0
    raw = [item for item in raw if item]
    packed = [zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compress(item) for item in raw]
    sizes = [_SIZES.pack(len(small), len(large)) for small, large in zip(packed, raw, strict=True)]
    table = _HEAD.size + _MORE.size + len(record)
    head = _HEAD.pack(*fields, flags, len(raw)) + _MORE.pack(table)
    return b"".join([head, record, *sizes, *packed])


def _gzip(data: bytes, up: str | None) -> bytes:
    """Returns a stream of gzip whose header says which axis is up; the same bytes at any time."""
    packer = zlib.compressobj(wbits=-zlib.MAX_WBITS)
    comment = up_comment(up).encode("ascii")
    return b"".join([_GZIP_HEADER, comment, b"\0", packer.compress(data), packer.flush(),
                     struct.pack("<II", zlib.crc32(data), len(data) & 0xFFFFFFFF)])


def unpack(path: Path, data: bytes) -> tuple[SpzHeader, list[Bytes]]:
    """Returns the header and the six arrays of a file.

    FormatError if the data is damaged, of another format, or does not match its header.
    """
    try:
        if data.startswith(b"\x1f\x8b"):
            header, body, extensions = _unpack_gzip(path, data)
        elif data.startswith(_MAGIC):
            header, flags, streams = _parse(path, data[:_HEAD.size], len(data))
            if header.version == 4:
                body, extensions = _unpack_streams(path, data, header, flags, streams)
            else:
                body, extensions = _split_extensions(path, data[_HEAD.size:], header, flags)
        else:
            raise FormatError(f"{path} is not an SPZ file.")
    except (zlib.error, zstandard.ZstdError) as error:
        raise FormatError(f"{path} cannot be unpacked: {error}.") from error
    comment = _COMMENT.match(data)
    header = replace(header, axes=_read_extensions(path, extensions),
                     up=read_up_comment(comment[1].decode("ascii")) if comment else None)
    ends = np.cumsum(header.sizes)[:-1]
    return header, np.split(np.frombuffer(body, np.uint8), ends)


def _parse(path: Path, head: bytes, size: int) -> tuple[SpzHeader, int, int]:
    """Returns the header, its flags and the number of streams, checked against the file's size."""
    if len(head) < _HEAD.size:
        raise _truncated_error(path)
    magic, version, count, degree, bits, flags, streams = _HEAD.unpack(head)
    if magic != _MAGIC:
        raise FormatError(f"{path} is not an SPZ file.")
    if version not in (_HALVES, *VERSIONS):
        raise FormatError(f"{path} is of SPZ version {version}; 1 to 4 can be read.")
    if degree >= len(_FILE_TERMS):
        raise FormatError(f"{path} has harmonics of degree {degree}; at most 4 can be read.")
    if bits > _MAX_FRACTIONAL_BITS:
        raise FormatError(f"{path} has positions of {bits} fractional bits, above 24: damaged.")
    header = SpzHeader(
        version, count, degree, bits, antialiased=bool(flags & _Flag.ANTIALIASED))
    if not count or sum(header.sizes) > HARMLESS_BYTES + MAX_RATIO * size:
        raise FormatError(
            f"{path} promises {count} Gaussians, which do not fit into its {size} bytes.",
            hint="Copy the file again, or export it again from its source.")
    return header, flags, streams


def _unpack_gzip(path: Path, data: bytes) -> tuple[SpzHeader, bytes, bytes]:
    stream = zlib.decompressobj(wbits=31)
    head = stream.decompress(data, _HEAD.size)
    header, flags, _ = _parse(path, head, len(data))
    if header.version == 4:
        raise FormatError(f"{path} is of version 4 but packed as older ones are: it is damaged.")
    more = MOST_HEAD_BYTES if flags & _Flag.EXTENSIONS else header.gaussian_bytes
    body = stream.decompress(stream.unconsumed_tail, sum(header.sizes) + more)
    if not stream.eof and stream.decompress(stream.unconsumed_tail, 1):
        raise _too_long_error(path)
    if not stream.eof:
        raise _truncated_error(path)
    accept_surplus(path, len(stream.unused_data))  # which is not unpacked
    return header, *_split_extensions(path, body, header, flags)


def _split_extensions(
    path: Path, body: bytes, header: SpzHeader, flags: int
) -> tuple[bytes, bytes]:
    """Returns the arrays and the extensions behind them, where versions 2 and 3 have these."""
    size = sum(header.sizes)
    if len(body) < size:
        raise _truncated_error(path)
    if flags & _Flag.EXTENSIONS:
        return body[:size], body[size:]
    accept_surplus(path, len(body) - size, header.gaussian_bytes)
    return body[:size], b""


def _unpack_streams(
    path: Path, data: bytes, header: SpzHeader, flags: int, streams: int
) -> tuple[bytes, bytes]:
    """Returns the arrays and the extensions before them, where version 4 has these."""
    promised = [size for size in header.sizes if size]
    begin = _HEAD.size + _MORE.size
    if len(data) < begin:
        raise _truncated_error(path)
    table = _MORE.unpack_from(data, _HEAD.size)[0]
    start = table + _SIZES.size * streams
    if streams != len(promised) or table < begin or start > len(data):
        raise FormatError(f"{path} has {streams} streams instead of {len(promised)}: damaged.")
    extensions = data[begin:table] if flags & _Flag.EXTENSIONS else b""
    parts = []
    for i, size in enumerate(promised):
        packed, unpacked = _SIZES.unpack_from(data, table + _SIZES.size * i)
        stream, start = data[start:start + packed], start + packed
        # The zstd frame states a size too, and zstandard would allocate that much.
        if unpacked != size or zstandard.frame_content_size(stream) not in (-1, size):
            raise FormatError(f"{path} has a stream of {unpacked} bytes instead of {size}.")
        parts.append(zstandard.ZstdDecompressor().decompress(
            stream, max_output_size=size, allow_extra_data=False))
        if len(parts[-1]) != size:
            raise _truncated_error(path)
    if start > len(data):
        raise _truncated_error(path)
    accept_surplus(path, len(data) - start, header.gaussian_bytes)
    return b"".join(parts), extensions


def _read_extensions(path: Path, data: bytes) -> str | None:
    """Returns the axes that the extensions name, in AXES; None if none does.

    Those of unknown vendors are ignored, as the format requires, as are Adobe's limits of an orbit
    camera. FormatError if they are damaged or change the meaning of the arrays otherwise.
    """
    start, axes = 0, None
    while start < len(data):
        if start + _EXTENSION.size > len(data):
            raise _truncated_error(path)
        kind, size = _EXTENSION.unpack_from(data, start)
        if kind == _Extension.AXES:
            axes = _read_axes(path, data[start + _EXTENSION.size:start + _EXTENSION.size + size])
        elif kind >> 16 == _Extension.AXES >> 16 and kind != _Extension.ORBIT_CAMERA:
            raise FormatError(
                f"{path} has the extension {kind:#x}, which changes the meaning of its values.",
                hint="Write it again without extensions.")
        start += _EXTENSION.size + size
    if start > len(data):
        raise _truncated_error(path)
    return axes


def _read_axes(path: Path, payload: bytes) -> str | None:
    """Returns the name of the number in the extension of the axes; None for 0, unspecified."""
    number = int.from_bytes(payload, "little")
    if len(payload) != 4 or number > len(AXES):
        raise FormatError(
            f"{path} names axes by {payload[:8].hex()}, which is not one of the {len(AXES)} of the "
            "format.", hint="Give the axes with --axes, for example --axes rub.")
    return AXES[number - 1] if number else None


def _truncated_error(path: Path) -> FormatError:
    return FormatError(f"{path} ends too early: it is truncated.", hint="Copy the file again.")


def _too_long_error(path: Path) -> FormatError:
    return FormatError(f"{path} holds more than its header promises: it is damaged or malicious.")


def _write_with(path: Path, splats: SplatArrays, settings: WriteSettings) -> None:
    write_spz(
        path, splats.with_sphere(LARGEST_SCALE), version=settings.options.get("spz_version", 3),
        up=settings.up_axis, antialiased=settings.antialiased)


FORMAT = SplatFormat(
    load_spz, _write_with, load_unturned=lambda path: load_spz(path, axes=PLY))
