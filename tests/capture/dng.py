"""Camera RAW that the tests make: a picture seen by a sensor with a mosaic, as a DNG file."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

BLACK, WHITE = 512, 16383  # a sensor of 14 bits
# Linear sRGB from XYZ (IEC 61966-2-1): what DNG calls the colour matrix, for a sensor of sRGB.
SRGB_OF_XYZ = np.array([
    [3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])
RESPONSE = (0.5, 1.0, 0.625)  # of the sensor's red, green and blue to white light
BYTE, ASCII, SHORT, LONG, RATIONAL, UNDEFINED, SRATIONAL = 1, 2, 3, 4, 5, 7, 10
BEFORE, AFTER = 51009, 51022  # tags of the opcodes before and after demosaicing
GAIN_MAP = 9
SIZE = 96, 144  # height and width of a picture with a map of gains
SIZES = {BYTE: "B", SHORT: "H", LONG: "I"}
Entry = tuple[int, int, object]  # tag, type, values


@dataclass(frozen=True)
class Shot:
    """The metadata that a camera writes beside the pixels.

    Attributes:
        seconds: exposure time.
        iso: sensitivity.
        f_number: aperture.
        neutral: what the camera takes for white, as shares of green.
        with_exif: whether exposure and focal length are written at all.
        focal_35mm: 35 mm equivalent of the focal length.
        orientation: as EXIF counts.
        model: name of the camera.
        more: other tags with opaque values, by tag.
        compression: as it is named, though the pixels have none.
        demosaiced: whether the colours of all pixels are stored instead of a mosaic.
    """

    seconds: Fraction = Fraction(1, 60)
    iso: int = 100
    f_number: Fraction = Fraction(2)
    neutral: tuple[float, float, float] = RESPONSE
    with_exif: bool = True
    focal_35mm: int = 26
    orientation: int = 1
    model: str = "Mosaic One"
    more: Mapping[int, bytes] = field(default_factory=dict)
    compression: int = 1
    demosaiced: bool = False


def linear(rgb: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Returns light from sRGB of 8 bits, 1 for white."""
    share = rgb / 255.0
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def mosaic(light: NDArray[np.float64]) -> NDArray[np.uint16]:
    """Returns what an RGGB sensor reads of light [H, W, 3], 1 where its green saturates."""
    seen = light * RESPONSE
    height, width = (side // 2 * 2 for side in light.shape[:2])
    cells = np.empty((height, width))
    for (y, x), channel in {(0, 0): 0, (0, 1): 1, (1, 0): 1, (1, 1): 2}.items():
        cells[y::2, x::2] = seen[y:height:2, x:width:2, channel]
    return _quantized(cells)


def _quantized(values: NDArray[np.float64]) -> NDArray[np.uint16]:
    return np.clip(np.round(BLACK + values * (WHITE - BLACK)), 0, WHITE).astype(np.uint16)


def write_shot(path: Path, light: NDArray[np.float64], shot: Shot) -> Path:
    """Writes light [H, W, 3] as it falls onto the sensor, exposure included, as a DNG."""
    cells = _quantized(light * RESPONSE) if shot.demosaiced else mosaic(light)
    height, width = cells.shape[:2]
    pixels = cells.astype("<u2").tobytes()
    matrix = (np.diag(RESPONSE) @ SRGB_OF_XYZ).ravel()
    planes = 3 if shot.demosaiced else 1
    main: list[Entry] = [
        (254, LONG, [0]), (256, LONG, [width]), (257, LONG, [height]), (258, SHORT, [16] * planes),
        (259, SHORT, [shot.compression]), (262, SHORT, [34892 if shot.demosaiced else 32803]),
        (271, ASCII, "Test"), (272, ASCII, shot.model), (273, LONG, [8]),
        (274, SHORT, [shot.orientation]), (277, SHORT, [planes]), (278, LONG, [height]),
        (279, LONG, [len(pixels)]), (50706, BYTE, [1, 4, 0, 0]), (50707, BYTE, [1, 1, 0, 0]),
        (50708, ASCII, f"Test {shot.model}"), (50714, SHORT, [BLACK] * planes),
        (50717, LONG, [WHITE] * planes), (50721, SRATIONAL, matrix),
        (50728, RATIONAL, shot.neutral), (50778, SHORT, [21]),
        *((tag, UNDEFINED, value) for tag, value in shot.more.items()),
    ]
    if not shot.demosaiced:
        main += [(33421, SHORT, [2, 2]), (33422, BYTE, [0, 1, 1, 2])]
    detail: list[Entry] = [
        (33434, RATIONAL, [shot.seconds]), (33437, RATIONAL, [shot.f_number]),
        (34855, SHORT, [shot.iso]), (37386, RATIONAL, [Fraction(436, 100)]),
        (41989, SHORT, [shot.focal_35mm]),
    ]
    body = pixels
    if shot.with_exif:
        main.append((34665, LONG, [8 + len(body)]))
        body += _directory(detail, 8 + len(body))
    start = 8 + len(body)
    path.write_bytes(b"II*\0" + struct.pack("<I", start) + body + _directory(main, start))
    return path


def opcodes(*items: tuple[int, bytes]) -> bytes:
    """Returns a list of opcodes and their parameters; big-endian in any file."""
    data = struct.pack(">I", len(items))
    for code, parameters in items:
        data += struct.pack(">4I", code, 0x01030000, 0, len(parameters)) + parameters
    return data


def gain_map(gains, *, first=(0, 0), pitch=(1, 1), plane=0, planes=1, size=SIZE):
    """Returns the opcode of gains [V, H, P] in a grid over the picture, from edge to edge."""
    down, across, parts = gains.shape
    return GAIN_MAP, struct.pack(
        ">10I4dI", *first, *size, plane, planes, *pitch, down, across, 1 / (down - 1),
        1 / (across - 1), 0, 0, parts) + gains.astype(">f4").tobytes()


def _directory(entries: list[Entry], start: int) -> bytes:
    """Returns a TIFF directory that lies `start` bytes into the file, its values behind it."""
    beyond = start + 2 + 12 * len(entries) + 4
    table, values = struct.pack("<H", len(entries)), b""
    for tag, kind, content in sorted(entries, key=lambda entry: entry[0]):
        data, count = _packed(kind, content)
        place = data.ljust(4, b"\0")
        if len(data) > 4:
            place = struct.pack("<I", beyond + len(values))
            values += data + b"\0" * (len(data) % 2)
        table += struct.pack("<HHI", tag, kind, count) + place
    return table + bytes(4) + values


def _packed(kind: int, content) -> tuple[bytes, int]:
    if kind == ASCII:
        data = content.encode() + b"\0"
        return data, len(data)
    if kind == UNDEFINED:
        return content, len(content)
    if kind in SIZES:
        return struct.pack(f"<{len(content)}{SIZES[kind]}", *content), len(content)
    fractions = [Fraction(value).limit_denominator(1_000_000) for value in content]
    sign = "i" if kind == SRATIONAL else "I"
    return b"".join(
        struct.pack(f"<2{sign}", one.numerator, one.denominator) for one in fractions), len(content)
