"""What a photo's EXIF says of the camera and its lens; everything else in it is left behind."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from PIL import ExifTags, Image

FILM_DIAGONAL = 43.267  # mm; CIPA DCG-001 defines the 35 mm equivalent by the diagonal
# EXIF 2.32, FocalPlaneResolutionUnit, in mm; 4 and 5 are not in it but in TIFF/EP (ISO 12234-2).
UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
# Sensors of phones are 4 mm wide, of medium format 54 mm: what lies far outside was miswritten.
SENSOR_MM = (2.0, 70.0)


@dataclass(frozen=True)
class Lens:
    """What EXIF tells of the optics.

    Attributes:
        camera: maker and model, empty where not given.
        focal_mm: focal length in mm, None where not given.
        focal_px: focal length in pixels, None where it does not follow.
    """

    camera: str = ""
    focal_mm: float | None = None
    focal_px: float | None = None


def read_lens(exif: Image.Exif, width: int, height: int) -> Lens:
    """Returns camera and focal length of a picture of width x height pixels, as stored.

    The focal length in pixels comes from the 35 mm equivalent, by the diagonal; where that is
    missing, from the focal length and the width of the sensor, which is the width in pixels at the
    time of the shot over the resolution of the focal plane (EXIF 2.32, section 4.6.5).
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
    return Lens(_camera(exif), focal, pixels)


def _sensor_mm(detail: dict[int, Any]) -> float | None:
    """Returns the length of the sensor's longer side."""
    density = _positive(detail.get(ExifTags.Base.FocalPlaneXResolution))
    across = [
        _positive(detail.get(tag))
        for tag in (ExifTags.Base.ExifImageWidth, ExifTags.Base.ExifImageHeight)]
    unit = UNIT_MM.get(detail.get(ExifTags.Base.FocalPlaneResolutionUnit, 2))
    longer = max((side for side in across if side is not None), default=None)
    if density is None or longer is None or unit is None:
        return None
    size = longer / density * unit
    return size if SENSOR_MM[0] <= size <= SENSOR_MM[1] else None


def _camera(exif: Image.Exif) -> str:
    """Returns maker and model, the maker once."""
    maker, model = (
        str(exif.get(tag) or "").strip("\0 ") for tag in (ExifTags.Base.Make, ExifTags.Base.Model))
    return model if model.lower().startswith(maker.lower()) else f"{maker} {model}".strip()


def _positive(value: Any) -> float | None:
    """Returns a number of EXIF, which may be a fraction over zero, zero for unknown, or text."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) and number > 0 else None
