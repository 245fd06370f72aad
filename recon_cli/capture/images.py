"""One photo: its upright size, its lens by EXIF, and its pixels as 8-bit RGB.

Pillow reads photos, LibRaw the headers of camera RAW. A photo is read completely or refused with an
InputError. Colours become sRGB, see `colour_profile`.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cache
from io import BytesIO
from pathlib import Path
from threading import Lock
from typing import Any

import cv2
import numpy as np
import pillow_heif
import rawpy
from numpy.typing import NDArray
from PIL import ExifTags, Image

from recon_cli.capture.colour_profile import Coding, convert_coding, read_coding, to_srgb
from recon_cli.capture.exif import ExifLens, read_exposure, read_lens
from recon_cli.capture.limits import MEASURE_SIZE
from recon_cli.capture.tiff import WHITE, UnsupportedError, is_misread, read_tiff
from recon_cli.capture.unreadable import BROKEN, DAMAGED, unreadable_error
from recon_cli.capture.video_colour import full_range_white
from recon_cli.capture.xmp import PanoramaArea, is_panorama, panorama_area, read_xmp
from recon_cli.errors import InputError
from recon_cli.io.images import decode_file, fit_size
from recon_cli.machine import free_memory_bytes

RAW_SUFFIXES = frozenset({
    ".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dcr", ".dng", ".erf", ".iiq", ".kdc", ".mef",
    ".mos", ".mrw", ".nef", ".nrw", ".orf", ".pef", ".raf", ".raw", ".rw2", ".rwl", ".sr2",
    ".srf", ".srw", ".x3f"})
# What cameras and converters write. Pillow also opens documents (EPS by way of Ghostscript).
FORMATS = ("JPEG", "PNG", "TIFF", "WEBP", "AVIF", "HEIF", "BMP", "JPEG2000", "PPM", "JXL")
ANIMATED = frozenset({"WEBP", "PNG", "AVIF", "HEIF"})  # those that may hold a film, or a burst
# A file with one of these endings that cannot be read is a broken photo; any other is not a photo.
PHOTO_SUFFIXES = RAW_SUFFIXES | {
    ".avif", ".bmp", ".heic", ".heif", ".hif", ".jp2", ".jpe", ".jpeg", ".jpg", ".jxl", ".pgm",
    ".png", ".ppm", ".tif", ".tiff", ".webp"}
# What undoes each orientation of EXIF 2.32, section 4.6.4; 1 is upright.
TURNS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT, 3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM, 5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270, 7: Image.Transpose.TRANSVERSE, 8: Image.Transpose.ROTATE_90}
QUARTER_TURNS = frozenset({5, 6, 7, 8})  # those of them that swap width and height

# Bytes of memory for a pixel while it is read: the peaks of pictures of 24 megapixels were 14 to 18
# (Pillow's copies before and after it is turned, and arrays), and 17 to 30 with 16 bits.
PIXEL_BYTES, WIDE_PIXEL_BYTES = 20, 32
# JPEG 2000, ITU-T T.800, A.5.1: how a code stream starts, and the place of the first component's
# depth behind, one of three bytes each; the number of components lies before it.
CODE_STREAM, COMPONENTS, DEPTHS = b"\xff\x4f\xff\x51", 40, 42

# Of sensors whose values are stored in 16 bits as they are.
NARROW = tuple(2**bits - 1 for bits in (8, 10, 12, 14))


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
    coding: Coding | None = None  # of colours that are converted to sRGB, but by an ICC profile

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
            mode, wide, pictures = image.mode, _is_wide(path, image), _count_pictures(image)
            coding = read_coding(path, image)
            exif, (width, height) = image.getexif(), _size_in_file(image)
            lens = read_lens(exif, width, height)
            exposure, xmp = read_exposure(exif), read_xmp(image)
            panorama = is_panorama(xmp, width, height)
            area = panorama_area(xmp, width, height)
            if _orientation(image) in QUARTER_TURNS:
                width, height = height, width
    except BROKEN as error:
        raise unreadable_error(path, error) from error
    return Photo(path, width, height, *lens, label=label, mode=mode, wide=wide,
                 pictures=pictures, panorama=panorama, area=area, exposure_ev=exposure,
                 coding=coding)


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

    They may be reduced, to `MEASURE_SIZE` pixels or more on the longer side.
    JPEG decodes to gray and to a fraction of its size in a quarter of the time.
    """
    try:
        with open_image(photo.path) as image:
            image.draft("L", fit_size(*image.size, MEASURE_SIZE))
            if (image.mode in ("L", "RGB") and not photo.wide and photo.coding is None
                    and not is_misread(image) and not image.has_transparency_data):
                gray = image.convert("L")
                turn = TURNS.get(_orientation(image))
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
            hint=DAMAGED)


class _AnySize:
    """Pillow without its limit of 179 megapixels, which holds for all threads of a process.

    Phones take more; and a machine with little memory cannot hold as many.
    """

    def __init__(self) -> None:
        self._lock, self._users, self._limit = Lock(), 0, Image.MAX_IMAGE_PIXELS

    def __enter__(self) -> None:
        with self._lock:
            if self._users == 0:
                self._limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
            self._users += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._users -= 1
            if self._users == 0:
                Image.MAX_IMAGE_PIXELS = self._limit


_ANY_SIZE = _AnySize()


@contextmanager
def open_image(path: Path) -> Iterator[Image.Image]:
    """Opens a picture, of which only the header has been read.

    InputError where the memory that is free cannot hold it.
    """
    with _ANY_SIZE, Image.open(path, formats=_formats()) as image:
        if image.format == "TIFF":
            image.filename = ""  # of a file that it maps to memory, it would turn the size alone
        width, height = image.size
        wanted = width * height * (WIDE_PIXEL_BYTES if _is_wide(path, image) else PIXEL_BYTES)
        if wanted > (free := free_memory_bytes()):
            raise InputError(
                f"{path.name} has {width}x{height} pixels: reading it takes {wanted / 1e9:.1f} GB "
                f"of memory, and {free / 1e9:.1f} GB are free.",
                hint="Close other programs, or reduce it: a side of 4000 pixels is plenty.")
        yield image


@cache
def _formats() -> tuple[str, ...]:
    """Returns those of `FORMATS` that this Pillow knows, with HEIF, and JPEG XL if installed."""
    Image.init()
    pillow_heif.register_heif_opener()
    with suppress(ImportError):
        import pillow_jxl  # noqa: F401  it registers itself
    return tuple(name for name in FORMATS if name in Image.OPEN)


def _size_in_file(image: Image.Image) -> tuple[int, int]:
    """Returns width and height before rotation; for a TIFF, Pillow gives those after it."""
    tags = getattr(image, "tag_v2", {})
    return (tags.get(ExifTags.Base.ImageWidth, image.width),
            tags.get(ExifTags.Base.ImageLength, image.height))


def _orientation(image: Image.Image) -> int:
    """Returns the orientation by EXIF that its pixels are not turned by yet, 1 if upright.

    libheif has turned HEIC (irot, ISO 23008-12), and cleared that of EXIF. A decoder of JPEG XL has
    turned the picture too (ISO 18181-2), but for one that is a JPEG, repacked.
    """
    if image.format == "JXL" and not getattr(image, "jpeg", False):
        return 1
    return int(image.getexif().get(ExifTags.Base.Orientation, 1))


def find_white(paths: Iterable[Path]) -> int:
    """Returns the brightest value that pictures of 16 bits can hold: 65535, or less.

    Cameras of 8 to 14 bits store their values in 16 without scaling them: then no picture of a set
    has a value above 4095, say. Unreadable files are left to their reader.
    """
    brightest = 0
    for path in paths:
        with suppress(*BROKEN, InputError), open_image(path) as image:
            if _is_wide(path, image):
                values = _read_wide(path, image)
                colours = values if values.ndim == 2 else values[..., :3]
                brightest = max(brightest, int(colours.max()))
        if brightest > max(NARROW):
            return WHITE
    return next((white for white in NARROW if 0 < brightest <= white), WHITE)


def choose_white(wide: Sequence[Path], notice: Callable[[str], None]) -> int:
    """Returns `find_white` of pictures of 16 bits, with a notice where it is below 65535."""
    white = find_white(wide)
    if white < WHITE:
        notice(f"The {len(wide)} pictures of 16 bits hold values of {white.bit_length()} bits, up "
               f"to {white}: {white} is taken for white, instead of {WHITE}.")
    return white


def is_wide(path: Path) -> bool:
    """Returns whether a picture that can be read has values of 16 bits."""
    with suppress(*BROKEN, InputError), open_image(path) as image:
        return _is_wide(path, image)
    return False


def _decode(path: Path, *, upright: bool, white: int = WHITE) -> Image.Image:
    """Returns a picture of 8 bits a channel, in any mode, if `upright` rotated as EXIF says."""
    try:
        with open_image(path) as image:
            image.verify()  # checksums, which loading ignores; consumes the image
        with open_image(path) as image:
            coding = read_coding(path, image)
            stored = getattr(image, "tag_v2", {}).get(ExifTags.Base.Orientation, 1)
            # first: reading the EXIF of a PNG consumes its tiles
            eight = (to_srgb(_eight_bits(path, image, white)) if coding is None
                     else convert_coding(*_read_signal(path, image), coding))
            turn = TURNS.get(_orientation(image))
            if not upright:  # what Pillow loads of a TIFF it has turned; 6 and 8 undo each other
                turn = TURNS.get({6: 8, 8: 6}.get(stored, stored)) if turn is None else None
            return eight if turn is None else eight.transpose(turn)
    except BROKEN as error:
        raise unreadable_error(path, error) from error


def _eight_bits(path: Path, image: Image.Image, white: int) -> Image.Image:
    if image.mode == "F":
        raise UnsupportedError("its pixels are floating point, of unknown range")
    if not _is_wide(path, image) and not is_misread(image):
        image.load()
        return image.convert("LA") if image.mode == "La" else image  # it has no way to RGB
    eight = Image.fromarray(_to_8bit(
        _read_wide(path, image), white if _is_wide(path, image) else WHITE))
    if profile := image.info.get("icc_profile"):
        eight.info["icc_profile"] = profile
    return eight


def _is_wide(path: Path, image: Image.Image) -> bool:
    """Returns whether values have more than 8 bits; of colours Pillow would drop the others."""
    bits = getattr(image, "tag_v2", {}).get(ExifTags.Base.BitsPerSample, (8,))
    if image.mode[0] == "I" or max(bits) > 8:
        return True
    if image.format == "JPEG2000":
        return _jpeg2000_white(path) > 255
    return any(";16B" in str(tile.args) for tile in getattr(image, "tile", ()))  # BGR;16 is 5-6-5


def _jpeg2000_white(path: Path) -> int:
    """Returns the brightest value of a JPEG 2000 of unsigned samples; 255 if it is damaged."""
    data = path.read_bytes()
    start = data.find(CODE_STREAM)
    if start < 0 or start + DEPTHS > len(data):
        return 255
    count, = struct.unpack_from(">H", data, start + COMPONENTS)
    depths = data[start + DEPTHS:start + DEPTHS + 3 * count:3]
    return (1 << max(depths, default=7) % 128 + 1) - 1


def _read_wide(path: Path, image: Image.Image) -> NDArray[Any]:
    """Returns values of 16 bits, gray [H, W] or RGB or RGBA [H, W, 3 or 4]."""
    if is_misread(image):
        return read_tiff(path, image)
    if image.mode[0] == "I" and image.format != "JPEG2000":
        return np.asarray(image)
    wide = None if image.mode == "LA" and image.format == "JPEG2000" else decode_file(
        path, cv2.IMREAD_UNCHANGED)
    if wide is None or wide.dtype != np.uint16 or image.mode == "CMYK":
        raise UnsupportedError(f"its pixels of {image.mode} with 16 bits are not supported")
    if wide.ndim == 3:
        wide = cv2.cvtColor(
            wide, cv2.COLOR_BGR2RGB if wide.shape[2] == 3 else cv2.COLOR_BGRA2RGBA)
    if image.format == "JPEG2000" and (white := _jpeg2000_white(path)) < WHITE:
        wide = (wide.astype(np.uint32) * WHITE // white).astype(np.uint16)
    return np.asarray(wide, np.uint16)


def _read_signal(path: Path, image: Image.Image) -> tuple[NDArray[np.uint16], int]:
    """Returns a picture as coded, [H, W, 3 or 4], and the value of its white."""
    bits = image.info.get("bit_depth", 8) if image.format == "HEIF" else 8
    if bits > 8:
        deep = pillow_heif.open_heif(path, convert_hdr_to_8bit=False)
        values, white = np.asarray(deep), full_range_white(bits)
    elif _is_wide(path, image) or is_misread(image):
        values, white = np.asarray(_read_wide(path, image)), WHITE
    else:
        image = image.convert("RGBA" if image.has_transparency_data else "RGB")
        values, white = np.asarray(image).astype(np.uint16) * (WHITE // 255), WHITE
    if values.ndim == 2:
        values = np.repeat(values[..., None], 3, axis=2)
    return np.asarray(values, np.uint16), white


def _to_8bit(wide: NDArray[Any], white: int) -> NDArray[np.uint8]:
    """Returns 16-bit values in 8 bits; `white` becomes 255."""
    if wide.size and (wide.min() < 0 or wide.max() > WHITE):  # a mode of 32 bits
        raise ValueError(f"its pixels reach from {wide.min()} to {wide.max()}, not to {WHITE}")
    return np.asarray(cv2.convertScaleAbs(wide.astype(np.uint16, copy=False), alpha=255 / white),
                      np.uint8)


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
    if sizes.flip & 4:  # the bit of a quarter turn
        width, height = height, width
    return Photo(path, width, height, lens.focal_px, lens.camera, lens.focal_mm or focal or None)
