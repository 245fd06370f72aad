"""Reads a picture's projection from its XMP, as cameras and stitchers of panoramas write it."""

from __future__ import annotations

import re
from dataclasses import dataclass

from PIL import ExifTags, Image

from recon_cli.capture.limits import SAME_SHAPE

# Google's Photo Sphere, as elements or as attributes.
_VALUE = rb"""(?:>|\s*=\s*["'])\s*"""
_PROJECTION = re.compile(rb"GPano:ProjectionType" + _VALUE + rb"([A-Za-z]+)")
_AREA = {name: re.compile(rb"GPano:" + name.encode() + _VALUE + rb"(\d{1,7})") for name in (
    "CroppedAreaImageWidthPixels", "CroppedAreaImageHeightPixels", "FullPanoWidthPixels",
    "FullPanoHeightPixels", "CroppedAreaLeftPixels", "CroppedAreaTopPixels")}


def read_xmp(image: Image.Image) -> bytes:
    """Returns the XMP of a picture; empty where there is none."""
    value = image.info.get("xmp") or getattr(image, "tag_v2", {}).get(
        ExifTags.Base.XMLPacket) or b""
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
    sides = _find(xmp, "CroppedAreaImageWidthPixels", "CroppedAreaImageHeightPixels")
    wanted = sides[0] / sides[1] if all(sides) else 2.0
    return abs(width / height / wanted - 1) <= SAME_SHAPE


@dataclass(frozen=True)
class PanoramaArea:
    """The part of the full sphere that a panorama shows, in pixels of the full panorama."""

    left: int
    top: int
    width: int
    height: int
    full_width: int
    full_height: int

    @property
    def is_full(self) -> bool:
        """Whether it is all of it."""
        return (self.width, self.height) == (self.full_width, self.full_height)


def panorama_area(xmp: bytes, width: int, height: int) -> PanoramaArea | None:
    """Returns the area that an equirectangular panorama of this size shows, by its XMP.

    None of any other picture. Where the XMP does not say where its part of the sphere lies, that is
    in the middle.
    """
    projection = _PROJECTION.search(xmp)
    if projection is None or projection[1].lower() != b"equirectangular" or not is_panorama(
            xmp, width, height):
        return None
    shown, = _find(xmp, "CroppedAreaImageWidthPixels")
    scale = width / shown if shown else 1.0  # of a reduced picture
    full_width, full_height, left, top = (round(scale * value) for value in _find(
        xmp, "FullPanoWidthPixels", "FullPanoHeightPixels", "CroppedAreaLeftPixels",
        "CroppedAreaTopPixels"))
    if full_width >= width and full_height >= height:
        return PanoramaArea(min(left, full_width - width), min(top, full_height - height),
                            width, height, full_width, full_height)
    full_width = max(width, 2 * height)
    full_height = full_width // 2 if full_width > width else max(height, width // 2)
    return PanoramaArea((full_width - width) // 2, (full_height - height) // 2, width, height,
                        full_width, full_height)


def _find(xmp: bytes, *names: str) -> list[int]:
    """Returns numbers of the XMP by their names; 0 for those that it lacks."""
    matches = [_AREA[name].search(xmp) for name in names]
    return [int(match[1]) if match else 0 for match in matches]
