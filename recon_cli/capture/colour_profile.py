"""Colours of a picture as sRGB: by its codes of H.273, its ICC profile, or its EXIF.

Phones write Display P3, cameras PQ and HLG. Shown as sRGB their colours are dull, and a photo
beside a video of the same phone would differ: codes are converted as those of video are. A profile
that is sRGB by its values leaves the pixels as they are.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import av
import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageCms

from recon_cli.capture import video_colour
from recon_cli.capture.video_colour import ADOBE_RGB, PRIMARIES, TRANSFERS, WIDE_GAMUTS, Transfer

# Profiles of sRGB by several makers differ by rounding; Display P3 differs by up to 60 of 255.
_SAME = 2
_FLAGS = ImageCms.Flags.BLACKPOINTCOMPENSATION


class Coding(NamedTuple):
    """The colours of a picture that is neither sRGB nor described by an ICC profile alone."""

    primaries: int  # H.273 code, or ADOBE_RGB
    transfer: Transfer | None  # None for SDR

    @property
    def words(self) -> str:
        """Its name in a notice."""
        gamut = WIDE_GAMUTS.get(self.primaries, "")
        if self.transfer is None:
            return f"in {gamut}"
        assumed = "" if self.primaries in PRIMARIES else ", whose primaries are taken for BT.2020"
        return f"HDR ({self.transfer.value}{assumed})"


def read_coding(path: Path, image: Image.Image) -> Coding | None:
    """Returns the codes that a picture's colours are to be converted by; None if there are none.

    HDR counts before an ICC profile, which describes no more than the white of SDR; a profile
    counts before codes of SDR.
    """
    for primaries, curve in _codes(path, image):
        if (transfer := TRANSFERS.get(curve)) is not None:
            return Coding(primaries, transfer)
        if primaries in WIDE_GAMUTS and not image.info.get("icc_profile"):
            return Coding(primaries, None)
    if image.format == "PNG":  # reading its EXIF consumes its tiles
        return None
    exif = image.getexif()
    space = exif.get_ifd(ExifTags.IFD.Exif).get(ExifTags.Base.ColorSpace)
    index = None
    with suppress(KeyError):  # Pillow 11.1 raises it where there is no such directory
        index = exif.get_ifd(ExifTags.IFD.Interop).get(ExifTags.Interop.InteropIndex)
    # DCF 2.0: uncalibrated, and the index of its option file; 2 is not in EXIF 2.32, but is written
    if not image.info.get("icc_profile") and image.mode in ("RGB", "RGBA") and (
            space == 2 or (space, index) == (0xFFFF, "R03")):
        return Coding(ADOBE_RGB, None)
    return None


def convert_coding(
    signal: NDArray[np.uint16],  # [H, W, 3 or 4]
    white: int,
    coding: Coding,
) -> Image.Image:
    """Returns a signal from 0 to `white` as sRGB of 8 bits, with its opacity if there is one."""
    rgb = video_colour.to_srgb(np.ascontiguousarray(signal[..., :3]), coding.transfer,
                               primaries=coding.primaries, white=white)
    if signal.shape[2] == 3:
        return Image.fromarray(rgb)
    return Image.fromarray(np.dstack([rgb, (signal[..., 3] >> 8).astype(np.uint8)]))


def _codes(path: Path, image: Image.Image) -> Iterator[tuple[int, int]]:
    """Yields primaries and transfer as codes of H.273: of the file's profile, then of the file."""
    profile = image.info.get("icc_profile")
    if isinstance(profile, bytes):
        with suppress(struct.error):  # it ends too soon
            count, = struct.unpack_from(">I", profile, 128)  # its header comes before the table
            for at in range(min(count, len(profile) // 12)):
                name, start = struct.unpack_from(">4sI", profile, 132 + 12 * at)
                if name == b"cicp":  # ICC.1:2022, 9.2.17
                    yield struct.unpack_from("2B", profile, start + 8)
    if image.format == "PNG":
        yield from _png_codes(path)
    elif image.format in ("AVIF", "HEIF"):
        nclx = image.info.get("nclx_profile")
        yield ((nclx["color_primaries"], nclx["transfer_characteristics"]) if nclx
               else _stream_codes(path, image.size))


def _png_codes(path: Path) -> Iterator[tuple[int, int]]:
    """Yields the codes of a PNG's chunk cICP."""
    with path.open("rb") as file:
        file.seek(8)  # what every PNG begins with
        while len(head := file.read(8)) == 8:
            length, kind = struct.unpack(">I4s", head)
            if kind == b"cICP":
                yield struct.unpack("2B", file.read(2))
            if kind in (b"cICP", b"IDAT"):
                return
            file.seek(length + 4, io.SEEK_CUR)


def _stream_codes(path: Path, size: tuple[int, int]) -> tuple[int, int]:
    """Returns the codes of an AVIF or HEIC, also where only its stream holds them; 2 is unknown."""
    with suppress(av.error.FFmpegError), path.open("rb") as file, av.open(file) as container:
        streams = sorted(  # beside the picture, or its tiles, there may be a thumbnail
            container.streams.video, key=lambda stream: (stream.width, stream.height) != size)
        for stream in streams[:1]:
            context = stream.codec_context
            return int(context.color_primaries), int(context.color_trc)
    return 2, 2


def to_srgb(image: Image.Image) -> Image.Image:
    """Returns an 8-bit RGB or RGBA picture in sRGB; others, and those without a profile, as is.

    A profile that cannot be read counts as none, as in browsers.
    """
    profile = image.info.get("icc_profile")
    if image.mode not in ("RGB", "RGBA") or not isinstance(profile, bytes) or not profile:
        return image
    transform = _transform(profile)
    if transform is None:
        return image
    alpha = None
    if image.has_transparency_data:  # by a channel, or by one colour that another would replace
        image = image.convert("RGBA")
        alpha = image.getchannel("A")
    colours = ImageCms.applyTransform(image.convert("RGB"), transform)
    assert colours is not None  # it was not told to work in place
    if alpha is not None:
        colours.putalpha(alpha)
    return colours


@lru_cache(maxsize=16)
def _transform(profile: bytes) -> ImageCms.ImageCmsTransform | None:
    """Returns the way from an RGB profile to sRGB; None for sRGB itself and for a broken one."""
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        if source.profile.xcolor_space.strip() != "RGB":
            return None
        transform = ImageCms.buildTransform(
            source, ImageCms.createProfile("sRGB"), "RGB", "RGB",
            ImageCms.Intent.RELATIVE_COLORIMETRIC, _FLAGS)
        steps = np.linspace(0, 255, 9).round().astype(np.uint8)
        colours = np.stack(np.meshgrid(steps, steps, steps), -1).reshape(27, 27, 3)
        moved = ImageCms.applyTransform(Image.fromarray(colours), transform)
    except (ImageCms.PyCMSError, OSError, ValueError):
        return None
    difference = np.abs(np.asarray(moved).astype(int) - colours).max()
    return transform if difference > _SAME else None
