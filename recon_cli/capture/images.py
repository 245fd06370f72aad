"""One photo: its upright size, its lens by EXIF, and its pixels as 8-bit RGB.

Pillow reads photos, LibRaw the headers of camera RAW. A photo is read completely or refused with an
InputError. Colours become sRGB by the embedded profile.
"""

from __future__ import annotations

import math
import struct
import warnings
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pillow_heif
import rawpy
from numpy.typing import NDArray
from PIL import ExifTags, Image, UnidentifiedImageError

from recon_cli.capture.colour_profile import to_srgb
from recon_cli.capture.xmp import PanoramaArea, is_panorama, panorama_area, read_xmp
from recon_cli.errors import InputError
from recon_cli.io.images import fit_size

RAW_SUFFIXES = frozenset({
    ".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dcr", ".dng", ".erf", ".iiq", ".kdc", ".mef",
    ".mos", ".mrw", ".nef", ".nrw", ".orf", ".pef", ".raf", ".raw", ".rw2", ".rwl", ".sr2",
    ".srf", ".srw", ".x3f"})
# What cameras and converters write. Pillow also opens documents (EPS by way of Ghostscript).
FORMATS = ("JPEG", "PNG", "TIFF", "WEBP", "AVIF", "HEIF", "BMP", "JPEG2000", "PPM")
ANIMATED = frozenset({"WEBP", "PNG", "AVIF", "HEIF"})  # those that may hold a film, or a burst
# A file with one of these endings that cannot be read is a broken photo; any other is not a photo.
PHOTO_SUFFIXES = RAW_SUFFIXES | {
    ".avif", ".bmp", ".heic", ".heif", ".hif", ".jp2", ".jpe", ".jpeg", ".jpg", ".pgm", ".png",
    ".ppm", ".tif", ".tiff", ".webp"}
# What Pillow and pillow_heif raise on damaged files; OSError includes unidentified ones.
BROKEN = (
    OSError, SyntaxError, ValueError, EOFError, IndexError, OverflowError, struct.error,
    RuntimeError, Image.DecompressionBombError)
# What undoes each orientation of EXIF 2.32, section 4.6.4; 1 is upright.
TURNS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT, 3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM, 5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270, 7: Image.Transpose.TRANSVERSE, 8: Image.Transpose.ROTATE_90}
QUARTER_TURNS = frozenset({5, 6, 7, 8})  # those of them that swap width and height
RAW_QUARTER_TURNS = frozenset({5, 6})  # LibRaw: flip
# TIFF 6.0: ImageWidth, ImageLength, BitsPerSample, PlanarConfiguration and its value for planes.
WIDTH, LENGTH, BITS, PLANAR, APART = 256, 257, 258, 284, 2
FILM_DIAGONAL = 43.267  # mm; CIPA DCG-001 defines the 35 mm equivalent by the diagonal
# EXIF 2.32, FocalPlaneResolutionUnit, in mm; 4 and 5 are not in it but in TIFF/EP (ISO 12234-2).
UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
# Sensors of phones are 4 mm wide, of medium format 54 mm: values far outside are wrong.
SENSOR_MM = (2.0, 70.0)


WHITE = 65535
GRAY_SIZE = 960  # pixels of the longer side, at least, at which measures are taken
# Those of sensors with 8, 10, 12 and 14 bits, whose values are stored in 16 as they are.
NARROW = (255, 1023, 4095, 16383)


@dataclass(frozen=True)
class Photo:
    """A photo whose header could be read; camera and focal lengths are those of EXIF."""

    path: Path
    width: int  # once upright
    height: int
    focal_px: float | None
    camera: str = ""  # maker and model
    focal_mm: float | None = None
    label: str = ""  # its path below the folder that was given, if it lies deeper
    mode: str = "RGB"  # Pillow's, of the file
    wide: bool = False  # its values have 16 bits
    pictures: int = 1  # of an animation, of which the first one is read
    panorama: bool = False  # its metadata says that no pinhole camera took it
    area: PanoramaArea | None = None  # of the sphere, where it is equirectangular by its metadata
    exposure_ev: float | None = None  # log2 of exposure time, ISO and aperture, None if unknown

    @property
    def name(self) -> str:
        """Its name in messages and records, unique within a capture."""
        return self.label or self.path.name

    @property
    def is_raw(self) -> bool:
        """Whether it holds sensor values, which `raw.develop` turns into colours."""
        return self.path.suffix.lower() in RAW_SUFFIXES

    @property
    def has_exif(self) -> bool:
        """Whether camera or focal length are known."""
        return bool(self.camera) or self.focal_px is not None or self.focal_mm is not None


def inspect_photo(path: Path, label: str = "") -> Photo:
    """Returns a photo's size, camera and focal length; InputError if damaged or far too large."""
    if path.suffix.lower() in RAW_SUFFIXES:
        return replace(_inspect_raw(path), label=label)
    try:
        with open_image(path) as image:
            # before the EXIF, for reading that of a PNG consumes its tiles
            mode, wide, pictures = image.mode, _is_wide(image), _count_pictures(image)
            exif, (width, height) = image.getexif(), _size_in_file(image)
            lens = read_lens(exif, width, height)
            exposure, xmp = read_exposure(exif), read_xmp(image)
            panorama = is_panorama(xmp, width, height)
            area = panorama_area(xmp, width, height)
            if exif.get(ExifTags.Base.Orientation) in QUARTER_TURNS:
                width, height = height, width
    except BROKEN as error:
        raise unreadable_error(path, error) from error
    return Photo(path, width, height, *lens, label=label, mode=mode, wide=wide,
                 pictures=pictures, panorama=panorama, area=area, exposure_ev=exposure)


def _count_pictures(image: Image.Image) -> int:
    """Returns how many pictures an animation, or a burst in one HEIC, holds; else 1.

    The further pages of a TIFF and of a JPEG are thumbnails and gain maps.
    """
    return getattr(image, "n_frames", 1) if image.format in ANIMATED else 1


def read_photo(photo: Photo, white: int = WHITE) -> NDArray[np.uint8]:
    """Returns a photo's pixels, upright RGB, [H, W, 3]; `raw.develop` reads RAW instead.

    `white` is the brightest value that 16 bits hold, see `find_white`.
    """
    if photo.is_raw:
        raise ValueError(f"{photo.path.name} is camera RAW")
    rgb = _on_black(_decode(photo.path, upright=True, white=white))
    check_size(photo, rgb)
    return rgb


def read_gray(photo: Photo, white: int = WHITE) -> NDArray[np.uint8]:
    """Returns the gray values of a photo, upright.

    They may be reduced, to `GRAY_SIZE` pixels or more on the longer side.
    JPEG decodes to gray and to a fraction of its size in a quarter of the time.
    """
    try:
        with open_image(photo.path) as image:
            image.draft("L", fit_size(*image.size, GRAY_SIZE))
            if (image.mode in ("L", "RGB") and not photo.wide
                    and not image.has_transparency_data):
                gray = image.convert("L")
                turn = TURNS.get(image.getexif().get(ExifTags.Base.Orientation, 1))
                return np.array(gray if turn is None else gray.transpose(turn))
    except BROKEN as error:
        raise unreadable_error(photo.path, error) from error
    return np.asarray(cv2.cvtColor(read_photo(photo, white), cv2.COLOR_RGB2GRAY), np.uint8)


def read_alpha(photo: Photo) -> NDArray[np.uint8] | None:
    """Returns a photo's opacity, upright, [H, W], 255 for opaque; None where it holds none."""
    if photo.is_raw:
        return None
    try:
        with open_image(photo.path) as header:
            if not header.has_transparency_data:
                return None
    except BROKEN as error:
        raise unreadable_error(photo.path, error) from error
    alpha = _alpha(_decode(photo.path, upright=True))
    check_size(photo, alpha)
    return alpha


def read_rgb(path: Path) -> NDArray[np.uint8]:
    """Returns any picture's pixels, upright, as RGB, [H, W, 3], on black where transparent."""
    return _on_black(_decode(path, upright=True))


def read_as_stored(
    path: Path, white: int = WHITE
) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None]:
    """Returns RGB [H, W, 3] and opacity ([H, W] or None) of a picture; ignores EXIF orientation."""
    image = _decode(path, upright=False, white=white)
    return _on_black(image), _alpha(image) if image.has_transparency_data else None


def _alpha(image: Image.Image) -> NDArray[np.uint8]:
    return np.array(image.convert("RGBA").getchannel("A"))


def _on_black(image: Image.Image) -> NDArray[np.uint8]:
    """Returns RGB, [H, W, 3], on black where transparent, as behind splats."""
    if image.has_transparency_data:
        black = Image.new("RGBA", image.size, (0, 0, 0, 255))
        image = Image.alpha_composite(black, image.convert("RGBA"))
    return np.array(image.convert("RGB"))


def check_size(photo: Photo, pixels: NDArray[np.uint8]) -> None:
    """Raises InputError when pixels [H, W, ...] are not of the size in the photo's header."""
    height, width = pixels.shape[:2]
    if (width, height) != (photo.width, photo.height):
        raise InputError(
            f"{photo.path.name} holds {width}x{height} pixels, but its header says "
            f"{photo.width}x{photo.height}.",
            hint="Copy it from the camera again, or leave it out.")


def open_image(path: Path) -> Image.Image:
    """Returns a picture of which only the header has been read."""
    with warnings.catch_warnings():
        # Pillow warns from 89 megapixels, which phones reach, and refuses from twice that.
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        return Image.open(path, formats=_formats())


def unreadable_error(path: Path, error: Exception) -> InputError:
    """Returns the error for a picture that a library does not read."""
    return InputError(
        f"{path.name} cannot be read: {_reason(path, error)}.",
        hint="Copy it from the camera again, or leave it out.")


def _reason(path: Path, error: Exception) -> str:
    """Returns the message of a library, or a plainer one for common cases."""
    if path.is_file() and path.stat().st_size == 0:
        return "it is empty (0 bytes)"
    if isinstance(error, UnidentifiedImageError):
        return "it is not a picture of a known format"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    words = error.args[0] if error.args else type(error).__name__
    text = words.decode(errors="replace") if isinstance(words, bytes) else str(words)
    if isinstance(error, Image.DecompressionBombError):
        return text.split(", could be")[0]  # the rest is about an attack
    return text.split(" (")[0] if text.startswith("image file is truncated") else text.rstrip(".")


@cache
def _formats() -> tuple[str, ...]:
    """Returns those of `FORMATS` that this Pillow knows, with HEIF registered."""
    Image.init()
    pillow_heif.register_heif_opener()
    return tuple(name for name in FORMATS if name in Image.OPEN)


def _size_in_file(image: Image.Image) -> tuple[int, int]:
    """Returns width and height before rotation; for a TIFF, Pillow gives those after it."""
    tags = getattr(image, "tag_v2", {})
    return tags.get(WIDTH, image.width), tags.get(LENGTH, image.height)


def find_white(paths: Iterable[Path]) -> int:
    """Returns the brightest value that pictures of 16 bits can hold: 65535, or less.

    Cameras of 8 to 14 bits store their values in 16 without scaling them: then no picture of a set
    has a value above 4095, say. Unreadable files are left to their reader.
    """
    brightest = 0
    for path in paths:
        with suppress(*BROKEN), open_image(path) as image:
            if _is_wide(image):
                values = np.asarray(image) if image.mode[0] == "I" else _read_wide(path, image)
                brightest = max(brightest, int(values.max()))
        if brightest > max(NARROW):
            return WHITE
    return next((white for white in NARROW if 0 < brightest <= white), WHITE)


def describe_white(count: int, white: int) -> str:
    """Returns the notice that pictures of 16 bits hold fewer, and are brightened."""
    return (f"The {count} pictures of 16 bits hold values of {white.bit_length()} bits, up to "
            f"{white}: {white} is taken for white, instead of {WHITE}.")


def is_wide(path: Path) -> bool:
    """Returns whether a picture that can be read has values of 16 bits."""
    with suppress(*BROKEN), open_image(path) as image:
        return _is_wide(image)
    return False


def _decode(path: Path, *, upright: bool, white: int = WHITE) -> Image.Image:
    """Returns a picture of 8 bits a channel, in any mode, if `upright` rotated as EXIF says.

    libheif has already rotated HEIC (irot, ISO 23008-12) and cleared the EXIF orientation.
    """
    try:
        with open_image(path) as image:
            image.verify()  # checksums, which loading ignores; consumes the image
        with open_image(path) as image:
            # first: reading the EXIF of a PNG consumes its tiles
            eight = to_srgb(_eight_bits(path, image, white))
            turn = TURNS.get(image.getexif().get(ExifTags.Base.Orientation, 1))
            return eight.transpose(turn) if upright and turn is not None else eight
    except BROKEN as error:
        raise unreadable_error(path, error) from error


def _eight_bits(path: Path, image: Image.Image, white: int) -> Image.Image:
    if image.mode == "F":
        raise ValueError("its pixels are floating point, of unknown range")
    if image.mode[0] == "I":
        return Image.fromarray(_to_8bit(np.asarray(image), white))
    if not _is_wide(image):
        image.load()
        return image
    eight = Image.fromarray(_to_8bit(_read_wide(path, image), white))
    if profile := image.info.get("icc_profile"):
        eight.info["icc_profile"] = profile
    return eight


def _is_wide(image: Image.Image) -> bool:
    """Returns whether values have 16 bits; of colours Pillow would drop the lower half."""
    if image.mode[0] == "I" or max(getattr(image, "tag_v2", {}).get(BITS, (8,))) > 8:
        return True
    return any(";16" in str(tile.args) for tile in getattr(image, "tile", ()))


def _read_wide(path: Path, image: Image.Image) -> NDArray[np.uint16]:
    """Returns colours of 16 bits, RGB or RGBA, [H, W, 3 or 4]."""
    if getattr(image, "tag_v2", {}).get(PLANAR) == APART:  # read wrongly by Pillow and OpenCV
        raise ValueError("its colours have 16 bits in separate planes, which is not supported")
    wide = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
    if wide is None or wide.dtype != np.uint16 or wide.ndim != 3:
        raise ValueError(f"its pixels of {image.mode} with 16 bits cannot be decoded")
    if image.format == "TIFF":  # OpenCV has turned it, whatever the flags
        image.getexif()[ExifTags.Base.Orientation] = 1
    order = cv2.COLOR_BGR2RGB if wide.shape[2] == 3 else cv2.COLOR_BGRA2RGBA
    return np.asarray(cv2.cvtColor(wide, order), np.uint16)


def _to_8bit(wide: NDArray[Any], white: int) -> NDArray[np.uint8]:
    """Returns 16-bit values in 8 bits; `white` becomes 255."""
    if wide.size and (wide.min() < 0 or wide.max() > WHITE):  # a mode of 32 bits
        raise ValueError(f"its pixels reach from {wide.min()} to {wide.max()}, not to {WHITE}")
    scaled = (wide.astype(np.uint32) * 255 + white // 2) // white
    return np.minimum(scaled, 255).astype(np.uint8)


def open_raw(path: Path) -> rawpy.RawPy:
    """Opens a RAW photo; rawpy itself takes no path that is not UTF-8."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        return rawpy.imread(BytesIO(path.read_bytes()))
    return rawpy.imread(str(path))


def _inspect_raw(path: Path) -> Photo:
    try:
        with open_raw(path) as raw:
            sizes, focal = raw.sizes, raw.other.focal_length
    except rawpy.LibRawError as error:
        raise unreadable_error(path, error) from error
    width, height, lens, exif = sizes.iwidth, sizes.iheight, ExifLens(), Image.Exif()
    # rawpy gives neither the 35 mm equivalent nor the camera. Most files are built like a TIFF.
    with suppress(*BROKEN), path.open("rb") as file:
        exif.load_from_fp(file)
        lens = read_lens(exif, width, height)
    if sizes.flip in RAW_QUARTER_TURNS:
        width, height = height, width
    return Photo(path, width, height, lens.focal_px, lens.camera, lens.focal_mm or focal or None)


class ExifLens(NamedTuple):
    """The optics by EXIF, in the order of the fields of `Photo`."""

    focal_px: float | None = None
    camera: str = ""  # maker and model
    focal_mm: float | None = None


def read_lens(exif: Image.Exif, width: int, height: int) -> ExifLens:
    """Returns camera and focal length of a picture of width x height pixels, as stored.

    The focal length in pixels comes from the 35 mm equivalent, by the diagonal, else from that in
    mm and the resolution of the focal plane (EXIF 2.32, section 4.6.5).
    """
    detail = exif.get_ifd(ExifTags.IFD.Exif)
    focal = _positive(detail.get(ExifTags.Base.FocalLength))
    film = _positive(detail.get(ExifTags.Base.FocalLengthIn35mmFilm))
    pixels = None
    if film is not None:
        pixels = math.hypot(width, height) * film / FILM_DIAGONAL
    elif focal is not None:
        sensor = _sensor_mm(detail)
        pixels = None if sensor is None else max(width, height) * focal / sensor
    maker, model = (
        str(exif.get(tag) or "").strip("\0 ") for tag in (ExifTags.Base.Make, ExifTags.Base.Model))
    camera = model if model.lower().startswith(maker.lower()) else f"{maker} {model}".strip()
    return ExifLens(pixels, camera, focal)


def read_exposure(exif: Image.Exif) -> float | None:
    """Returns log2(t S / (100 N^2)) of exposure time t, ISO S and f-number N; None without t or S.

    A lens that never gives its f-number, as of most phones, is taken to keep it.
    """
    detail = exif.get_ifd(ExifTags.IFD.Exif)
    seconds, f_number = (
        _positive(detail.get(tag)) for tag in (ExifTags.Base.ExposureTime, ExifTags.Base.FNumber))
    sensitivity = detail.get(ExifTags.Base.ISOSpeedRatings)
    if isinstance(sensitivity, tuple) and sensitivity:  # EXIF 2.2 allows several
        sensitivity = sensitivity[0]
    iso = _positive(sensitivity)
    if seconds is None or iso is None:
        return None
    return math.log2(seconds * iso / 100) - 2 * math.log2(f_number or 1.0)


def _sensor_mm(detail: dict[int, Any]) -> float | None:
    """Returns the length of the sensor's longer side."""
    density = _positive(detail.get(ExifTags.Base.FocalPlaneXResolution))
    sides = (_positive(detail.get(tag)) or 0.0
             for tag in (ExifTags.Base.ExifImageWidth, ExifTags.Base.ExifImageHeight))
    unit = UNIT_MM.get(detail.get(ExifTags.Base.FocalPlaneResolutionUnit, 2))
    if density is None or unit is None:
        return None
    size = max(sides) / density * unit
    return size if SENSOR_MM[0] <= size <= SENSOR_MM[1] else None


def _positive(value: Any) -> float | None:
    """Returns a positive EXIF number; None for text, zero or a fraction over zero."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) and number > 0 else None
