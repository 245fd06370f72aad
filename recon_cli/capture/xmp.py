"""Reads a picture's projection from its XMP, as cameras and stitchers of panoramas write it."""

from __future__ import annotations

import re

from PIL import Image

TAG = 700  # of TIFF: XMP specification, part 3
# Google's Photo Sphere, as elements or as attributes.
_VALUE = rb"""(?:>|\s*=\s*["'])\s*"""
_PROJECTION = re.compile(rb"GPano:ProjectionType" + _VALUE + rb"([A-Za-z]+)")
_SIZE = tuple(re.compile(rb"GPano:CroppedAreaImage" + side + _VALUE + rb"(\d{1,7})")
              for side in (b"WidthPixels", b"HeightPixels"))
_ASPECT = 0.02  # a picture reduced to whole pixels keeps its aspect this well


def read_xmp(image: Image.Image) -> bytes:
    """Returns the XMP of a picture; empty where there is none."""
    value = image.info.get("xmp") or getattr(image, "tag_v2", {}).get(TAG) or b""
    if isinstance(value, str):
        return value.encode(errors="replace")
    return value if isinstance(value, bytes) else b""  # numbers, in a TIFF of a wrong type


def is_panorama(xmp: bytes, width: int, height: int) -> bool:
    """Returns whether a picture's XMP says that it is not a perspective picture.

    Pictures cut from a panorama often keep its XMP: then their shape is another.
    """
    projection = _PROJECTION.search(xmp)
    if projection is None or projection[1].lower() in (b"rectilinear", b"perspective"):
        return False
    sides = [int(match[1]) for pattern in _SIZE if (match := pattern.search(xmp))]
    wanted = sides[0] / sides[1] if len(sides) == 2 and all(sides) else 2.0
    return abs(width / height / wanted - 1) <= _ASPECT
