"""Lens and exposure of a photo by its EXIF."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from PIL import ExifTags, Image

FILM_DIAGONAL = 43.267  # mm; CIPA DCG-001 defines the 35 mm equivalent by the diagonal
# EXIF 2.32, FocalPlaneResolutionUnit, in mm; 4 and 5 are not in it but in TIFF/EP (ISO 12234-2).
UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
# Sensors of phones are 4 mm wide, of medium format 54 mm: values far outside are wrong.
SENSOR_MM = (2.0, 70.0)


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
