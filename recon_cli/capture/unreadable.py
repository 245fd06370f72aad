"""Why a picture cannot be read, and what helps: whether it is damaged, or in an unusual coding."""

from __future__ import annotations

import struct
from contextlib import suppress
from pathlib import Path

import rawpy
from PIL import ExifTags, UnidentifiedImageError

from recon_cli.capture.tiff import TagValue, UnsupportedError, describe, read_directories
from recon_cli.errors import InputError

# What Pillow and pillow_heif raise on damaged files; OSError includes unidentified ones.
BROKEN = (
    OSError, SyntaxError, ValueError, EOFError, IndexError, OverflowError, struct.error,
    RuntimeError)
JXL_STARTS = (b"\xff\x0a", b"\x00\x00\x00\x0cJXL \r\n\x87\n")
DAMAGED = "Copy it from the camera again, or leave it out."
UNKNOWN_RAW = ("If the camera's program opens it, save it there as JPEG or TIFF; else copy it from "
               "the camera again.")
OTHERWISE = "It is not damaged: save it as JPEG, or PNG of 8 or 16 bits, or leave it out."


def unreadable_error(path: Path, error: Exception) -> InputError:
    """Returns the error for a picture that a library does not read."""
    reason, hint = _describe_coding(path, error)
    if not reason:
        reason, hint = _reason(path, error), (
            OTHERWISE if isinstance(error, UnsupportedError)
            else UNKNOWN_RAW if isinstance(error, rawpy.LibRawFileUnsupportedError) else DAMAGED)
    return InputError(f"{path.name} cannot be read: {reason}.", hint=hint)


def _describe_coding(path: Path, error: Exception) -> tuple[str, str]:
    """Returns why no library knows a picture that is not damaged, and a hint; else ""."""
    with suppress(*BROKEN):
        if isinstance(error, rawpy.LibRawFileUnsupportedError) and any(
                tags.get(ExifTags.Base.Compression) == TagValue.JPEG_XL
                for tags in read_directories(path)):
            return ("its pixels are compressed by JPEG XL, which LibRaw does not decode",
                    "It is not damaged: let the camera or Adobe DNG Converter write DNG without "
                    "JPEG XL, or save it as JPEG or TIFF.")
        if isinstance(error, UnidentifiedImageError):
            with path.open("rb") as file:
                head = file.read(16)
            if head.startswith(JXL_STARTS):
                return ("JPEG XL needs the package pillow-jxl-plugin",
                        "Install it beside recon (python -m pip install pillow-jxl-plugin), or "
                        "convert the photos: djxl photo.jxl photo.png")
            if tags := next(iter(read_directories(path)), None):
                return describe(tags), OTHERWISE
    return "", ""


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
    return text.split(" (")[0] if text.startswith("image file is truncated") else text.rstrip(".")
