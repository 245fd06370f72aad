"""Samples of TIFF files that Pillow drops or takes for others: 16 bits, and planes with extra ones.

Pillow keeps 8 bits of a colour, OpenCV takes any fourth sample for opacity, and both mix up planes.
So libtiff, by way of Pillow, is given what it reads right: gray pictures. Rows of S samples are
rows of S times as many grays, and a plane is a picture of its own. What the samples mean is decided
here, by TIFF 6.0.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from enum import IntEnum
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, TiffImagePlugin, TiffTags
from PIL.ExifTags import Base as Tag

# The tags of a picture's bytes that a directory of grays shares with the picture.
COPIED = (Tag.ImageLength, Tag.Compression, Tag.FillOrder, Tag.RowsPerStrip, Tag.TileLength)
WHITE = int(np.iinfo(np.uint16).max)


class Photometric(IntEnum):
    """What samples mean: TIFF 6.0, sections 8 and 16, and DNG 1.7."""

    WHITE_IS_ZERO = 0
    BLACK_IS_ZERO = 1
    RGB = 2
    CMYK = 5
    MOSAIC = 32803
    LINEAR = 34892


class Extra(IntEnum):
    """Extra samples that are opacity (TIFF 6.0, section 18), which colours were multiplied by."""

    ASSOCIATED = 1
    UNASSOCIATED = 2


class TagValue(IntEnum):
    """Other values of tags: TIFF 6.0, sections 8, 14 and 19, BigTIFF, and DNG 1.7."""

    PLANES_APART = 2  # of the planar configuration
    DIFFERENCES = 2  # of the predictor
    FLOAT = 3  # of the sample format
    BIG = 43  # the version of BigTIFF
    JPEG_XL = 52546  # of the compression


_COLOURS: dict[int, int] = {
    Photometric.WHITE_IS_ZERO: 1, Photometric.BLACK_IS_ZERO: 1, Photometric.RGB: 3,
    Photometric.CMYK: 4}  # samples of a colour


class UnsupportedError(ValueError):
    """A picture that is not damaged, in a coding that is not read."""


def is_misread(image: Image.Image) -> bool:
    """Returns whether a file is a TIFF that Pillow opens, but loses samples of."""
    tags = getattr(image, "tag_v2", {})
    apart = tags.get(Tag.PlanarConfiguration) == TagValue.PLANES_APART and Tag.ExtraSamples in tags
    return apart or (16 in tags.get(Tag.BitsPerSample, ()) and image.mode != "I")  # "I" is signed


def read_tiff(path: Path, image: Image.Image) -> NDArray[np.uint16]:
    """Returns the pixels of a TIFF file as stored: RGB or RGBA, [H, W, 3 or 4], up to 65535."""
    tags: Mapping[int, Any] = image.tag_v2  # type: ignore[attr-defined]
    kind, samples = tags.get(Tag.PhotometricInterpretation, 1), tags.get(Tag.SamplesPerPixel, 1)
    wanted, bits = _COLOURS.get(kind, 0), tags.get(Tag.BitsPerSample, (1,))
    if not 0 < wanted <= samples or set(bits) not in ({8}, {16}) or set(
            tags.get(Tag.SampleFormat, (1,))) != {1}:
        raise UnsupportedError(describe(tags))
    values = _read_samples(path.read_bytes(), tags, samples)
    if values.dtype == np.uint8:
        values = values * np.uint16(WHITE // 255)
    # without the tag one more sample is opacity, as for Pillow
    extra = tags.get(Tag.ExtraSamples, (Extra.UNASSOCIATED,) if samples == wanted + 1 else ())
    return _to_rgba(values, kind, extra)


def read_directories(path: Path) -> Iterator[Mapping[int, Any]]:
    """Yields the tags of the first picture of a file like a TIFF, and of those below it."""
    with path.open("rb") as file:
        head = file.read(8)
        head += file.read(8) if TagValue.BIG in head[2:4] else b""
        tags = TiffImagePlugin.ImageFileDirectory_v2(head)
        places = [tags.next]
        for place in places:  # those below the first are added while it goes
            tags = TiffImagePlugin.ImageFileDirectory_v2(head)
            file.seek(place)
            tags.load(file)
            if len(places) == 1:
                below = tags.get(Tag.SubIFDs, ())
                places += below if isinstance(below, tuple) else (below,)
            yield tags


def describe(tags: Mapping[int, Any]) -> str:
    """Returns the reason why the samples of a TIFF file are not read."""
    number = "floating point" if TagValue.FLOAT in tags.get(Tag.SampleFormat, ()) else "integer"
    bits = "/".join(str(value) for value in sorted(set(tags.get(Tag.BitsPerSample, (1,)))))
    samples, compression, kind = (tags.get(tag, 1) for tag in (
        Tag.SamplesPerPixel, Tag.Compression, Tag.PhotometricInterpretation))
    return (f"its pixels are {samples} {number} samples of {bits} bits (compression "
            f"{compression}, photometric interpretation {kind}), which is not supported")


def _read_samples(data: bytes, tags: Mapping[int, Any], samples: int) -> NDArray[Any]:
    """Returns all samples, [H, W, samples], of 8 or 16 bits."""
    if tags.get(Tag.PlanarConfiguration) == TagValue.PLANES_APART:
        return np.stack([_read_gray(data, tags, plane=at, planes=samples)
                         for at in range(samples)], axis=2)
    rows = _read_gray(data, tags, columns=samples)
    values = rows.reshape(len(rows), -1, samples)
    if samples > 1 and tags.get(Tag.Predictor) == TagValue.DIFFERENCES:
        step = tags.get(Tag.TileWidth, tags[Tag.ImageWidth])
        for start in range(0, tags[Tag.ImageWidth], step):
            part = values[:, start:start + step]
            part[:] = np.cumsum(part, axis=1, dtype=part.dtype)
    return values


def _read_gray(
    data: bytes, tags: Mapping[int, Any], *, columns: int = 1, plane: int = 0, planes: int = 1,
) -> NDArray[Any]:
    """Returns a plane of several, or rows of so many columns a pixel, [H, columns * W]."""
    entries: dict[int, tuple[int, ...]] = {tag: (tags[tag],) for tag in COPIED if tag in tags}
    entries |= {
        tag: (tags[tag] * columns,) for tag in (Tag.ImageWidth, Tag.TileWidth) if tag in tags}
    for tag in (Tag.StripOffsets, Tag.StripByteCounts, Tag.TileOffsets, Tag.TileByteCounts):
        if tag in tags:
            count = len(tags[tag]) // planes
            entries[tag] = tags[tag][plane * count:(plane + 1) * count]
    # between columns of one pixel there are no differences
    predictor = tags.get(Tag.Predictor, 1) if columns == 1 else 1
    entries |= {
        Tag.BitsPerSample: (max(tags[Tag.BitsPerSample]),), Tag.Predictor: (predictor,),
        Tag.PhotometricInterpretation: (Photometric.BLACK_IS_ZERO,), Tag.SamplesPerPixel: (1,)}
    with Image.open(BytesIO(_with_directory(data, entries)), formats=("TIFF",)) as gray:
        pixels = np.asarray(gray)
    return pixels.astype(np.uint8 if pixels.itemsize == 1 else np.uint16)


def _with_directory(data: bytes, entries: Mapping[int, tuple[int, ...]]) -> bytes:
    """Returns a TIFF file with another directory of its first picture, at its end."""
    order = "<" if data[:2] == b"II" else ">"
    big = struct.unpack_from(f"{order}H", data, 2) == (TagValue.BIG,)
    number, kind, size, head = ("Q", TiffTags.LONG8, 8, 8) if big else ("I", TiffTags.LONG, 4, 4)
    start = len(data) + len(data) % 2
    table, values = struct.pack(f"{order}{'Q' if big else 'H'}", len(entries)), b""
    behind = start + len(table) + len(entries) * (4 + 2 * size) + size
    for tag, content in sorted(entries.items()):
        packed = struct.pack(f"{order}{len(content)}{number}", *content)
        place = packed
        if len(content) > 1:
            place = struct.pack(f"{order}{number}", behind + len(values))
            values += packed
        table += struct.pack(f"{order}HH{number}", tag, kind, len(content)) + place
    end = struct.pack(f"{order}{number}", 0)
    first = struct.pack(f"{order}{number}", start)
    return b"".join((data[:head], first, data[head + size:], bytes(start - len(data)), table, end,
                     values))


def _to_rgba(
    values: NDArray[np.uint16], kind: int, extra: tuple[int, ...]
) -> NDArray[np.uint16]:
    """Returns samples [H, W, S] as RGB, and the opacity where an extra sample holds it."""
    colours = _COLOURS[kind]
    rgb = values[..., :colours]
    if kind == Photometric.WHITE_IS_ZERO:
        rgb = WHITE - rgb
    elif kind == Photometric.CMYK:  # of inks as Pillow takes them
        light = WHITE - rgb.astype(np.uint32)
        rgb = ((light[..., :3] * light[..., 3:] + WHITE // 2) // WHITE).astype(np.uint16)
    rgb = np.broadcast_to(rgb, (*values.shape[:2], 3))
    alphas = [at for at, role in enumerate(extra) if role in (Extra.ASSOCIATED, Extra.UNASSOCIATED)]
    if not alphas or values.shape[2] <= colours + alphas[0]:
        return np.ascontiguousarray(rgb)
    alpha = values[..., colours + alphas[0], None]
    if extra[alphas[0]] == Extra.ASSOCIATED:  # the colours were multiplied by it
        part = rgb.astype(np.uint32) * WHITE // np.maximum(alpha, 1)
        rgb = np.minimum(part, WHITE).astype(np.uint16)
    return np.concatenate([rgb, alpha], axis=2)
