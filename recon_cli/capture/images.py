"""One photo: its upright size, and its pixels as 8-bit RGB, from Pillow or, for RAW, LibRaw.

A photo is read whole or refused; half a JPEG never passes. Colour profiles are not applied, so
that the photos of one camera stay comparable, and no metadata is carried over.
"""

from __future__ import annotations

import struct
import warnings
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import rawpy
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageOps

from recon_cli.errors import InputError

RAW_SUFFIXES = frozenset({
    ".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dcr", ".dng", ".erf", ".iiq", ".kdc", ".mef",
    ".mos", ".mrw", ".nef", ".nrw", ".orf", ".pef", ".raf", ".raw", ".rw2", ".rwl", ".sr2",
    ".srf", ".srw", ".x3f",
})
# What cameras and converters write. Pillow also opens documents (EPS by way of Ghostscript).
FORMATS = ("JPEG", "PNG", "TIFF", "WEBP", "AVIF", "BMP", "JPEG2000", "PPM")
# A file so named that cannot be read is a broken photo; any other that cannot is no photo.
PHOTO_SUFFIXES = RAW_SUFFIXES | {
    ".avif", ".bmp", ".heic", ".heif", ".hif", ".jp2", ".jpe", ".jpeg", ".jpg", ".pgm", ".png",
    ".ppm", ".tif", ".tiff", ".webp",
}
# What Pillow raises on damaged files, by format; OSError includes what it cannot identify.
BROKEN = (
    OSError, SyntaxError, ValueError, EOFError, IndexError, OverflowError, struct.error,
    Image.DecompressionBombError,
)
QUARTER_TURNS = frozenset({5, 6, 7, 8})  # EXIF orientations that swap width and height
RAW_QUARTER_TURNS = frozenset({5, 6})  # LibRaw: flip
FILM_DIAGONAL = 43.267  # mm; CIPA DCG-001 defines the 35 mm equivalent by the diagonal


@dataclass(frozen=True)
class Photo:
    """A photo whose header could be read.

    Attributes:
        path: its file.
        width: width in pixels once upright.
        height: height in pixels once upright.
        focal_px: focal length in pixels by EXIF's 35 mm equivalent, None where it is not given.
    """

    path: Path
    width: int
    height: int
    focal_px: float | None


def inspect_photo(path: Path) -> Photo:
    """Returns a photo's size and focal length from its header.

    Raises:
        InputError: the header cannot be read.
    """
    if path.suffix.lower() in RAW_SUFFIXES:
        return _inspect_raw(path)
    try:
        with _opened(path) as image:
            exif = image.getexif()
            width, height = image.size
            if exif.get(ExifTags.Base.Orientation) in QUARTER_TURNS:
                width, height = height, width
            equivalent = exif.get_ifd(ExifTags.IFD.Exif).get(ExifTags.Base.FocalLengthIn35mmFilm)
    except BROKEN as error:
        raise _refused(path, error) from error
    focal = float(np.hypot(width, height)) * equivalent / FILM_DIAGONAL if equivalent else None
    return Photo(path, width, height, focal)


def read_photo(photo: Photo) -> NDArray[np.uint8]:
    """Returns a photo's pixels, upright RGB, [H, W, 3].

    Raises:
        InputError: the file is truncated, damaged, or holds pixels that are no colours.
    """
    rgb = _pixels(photo.path)
    height, width = rgb.shape[:2]
    if (width, height) != (photo.width, photo.height):
        raise InputError(
            f"{photo.path.name} holds {width}x{height} pixels, but its header says "
            f"{photo.width}x{photo.height}.")
    return rgb


def _pixels(path: Path) -> NDArray[np.uint8]:
    if path.suffix.lower() in RAW_SUFFIXES:
        return _read_raw(path)
    try:
        with _opened(path) as image:
            image.verify()  # checksums, which loading passes over; uses the image up
        with _opened(path) as image:
            return _as_rgb(ImageOps.exif_transpose(image))
    except BROKEN as error:
        raise _refused(path, error) from error


@cache
def _formats() -> tuple[str, ...]:
    """Returns those of `FORMATS` that this Pillow knows; AVIF came late."""
    Image.init()
    return tuple(name for name in FORMATS if name in Image.OPEN)


def _opened(path: Path) -> Image.Image:
    with warnings.catch_warnings():
        # Pillow warns from 89 megapixels, which phones reach, and refuses from twice that.
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        return Image.open(path, formats=_formats())


def _as_rgb(image: Image.Image) -> NDArray[np.uint8]:
    """Returns any mode as RGB; what is transparent shows black, as behind a splat."""
    if image.mode.startswith("I"):
        wide = np.asarray(image).astype(np.float64)  # 16 bits, whatever the mode could hold
        gray = np.clip(np.round(wide * (255 / 65535)), 0, 255).astype(np.uint8)
        return np.repeat(gray[:, :, None], 3, axis=2)
    if image.mode == "F":
        raise ValueError("its pixels are floating point, of unknown range")
    if image.has_transparency_data:
        black = Image.new("RGBA", image.size, (0, 0, 0, 255))
        image = Image.alpha_composite(black, image.convert("RGBA"))
    return np.array(image.convert("RGB"))


def _inspect_raw(path: Path) -> Photo:
    try:
        with rawpy.imread(str(path)) as raw:
            sizes = raw.sizes
    except rawpy.LibRawError as error:
        raise _refused(path, error) from error
    width, height = sizes.iwidth, sizes.iheight
    if sizes.flip in RAW_QUARTER_TURNS:
        width, height = height, width
    return Photo(path, width, height, None)


def _read_raw(path: Path) -> NDArray[np.uint8]:
    """Returns a developed RAW; brightness stays as exposed, so that photos match each other."""
    try:
        with rawpy.imread(str(path)) as raw:
            rgb = raw.postprocess(use_camera_wb=True, no_auto_bright=True, output_bps=8)
    except rawpy.LibRawError as error:
        raise _refused(path, error) from error
    if not rgb.any():  # how LibRaw answers a compression that it does not know
        raise InputError(f"{path.name} holds only black pixels.")
    return np.asarray(rgb, np.uint8)


def _refused(path: Path, error: Exception) -> InputError:
    reason = error.args[0] if error.args else type(error).__name__
    if isinstance(error, OSError) and error.strerror:
        reason = error.strerror
    if isinstance(reason, bytes):
        reason = reason.decode(errors="replace")
    return InputError(f"{path.name} cannot be read: {reason}.")
