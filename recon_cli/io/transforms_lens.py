"""Intrinsics of a transforms.json: what instant-ngp and nerfstudio write, as a lens of COLMAP.

Both copy COLMAP's numbers, so the centre of the first pixel lies at 0.5 and nothing is shifted.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from typing import Any

from recon_cli.errors import FormatError
from recon_cli.io.calibration import checked_lens
from recon_cli.scene.lens import Lens

_FISHEYE = ("OPENCV_FISHEYE",)
# They share one meaning of k1, k2, p1, p2, and leave at zero what they do not have.
_PERSPECTIVE = (
    "OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV",
)
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # COLMAP's order in FULL_OPENCV

_LARGEST = sys.float_info.max


def read_lens(entry: Mapping[str, Any], size: tuple[int, int], where: str) -> Lens:
    """Returns the lens of a frame.

    Args:
        entry: the keys of the frame over those of the file.
        size: (width, height) of the image in pixels, for where w and h are not given.
        where: what a message calls the frame.

    Raises:
        FormatError: no focal length is given, the camera model is unknown, or a number is not one.
    """
    width = number(entry, "w", where) or float(size[0])
    height = number(entry, "h", where) or float(size[1])
    fx = _focal(entry, "x", width, where)
    fy = _focal(entry, "y", height, where)
    if fx is None and fy is None:
        raise FormatError(
            f"{where} has no focal length: neither fl_x nor camera_angle_x.",
            hint="Add fl_x, fl_y, cx, cy, w and h in pixels.")
    cx, cy = number(entry, "cx", where), number(entry, "cy", where)
    inner = (
        fx if fx is not None else fy, fy if fy is not None else fx,
        width / 2 if cx is None else cx, height / 2 if cy is None else cy)
    model, coefficients = _distortion(entry, where)
    params = [value for value in (*inner, *coefficients) if value is not None]
    return checked_lens(model, width, height, params, where)


def _focal(entry: Mapping[str, Any], axis: str, side: float, where: str) -> float | None:
    """Returns the focal length along an axis, given as such or as the angle of view."""
    focal = number(entry, f"fl_{axis}", where)
    if focal is not None:
        return focal
    angle = number(entry, f"camera_angle_{axis}", where)
    if angle is None:
        return None
    if not 0 < angle < math.pi:
        raise FormatError(
            f"{where} has camera_angle_{axis} = {angle:g}; needed are radians below pi.")
    return side / 2 / math.tan(angle / 2)


def _distortion(entry: Mapping[str, Any], where: str) -> tuple[str, tuple[float, ...]]:
    """Returns the camera model and its distortion coefficients."""
    named = entry.get("camera_model", "OPENCV_FISHEYE" if entry.get("is_fisheye") else "OPENCV")
    values = {key: number(entry, key, where) or 0.0 for key in _COEFFICIENTS}
    if named in _FISHEYE:
        if values["p1"] or values["p2"]:
            raise FormatError(f"{where}: {named} has no tangential distortion p1, p2.")
        return "OPENCV_FISHEYE", tuple(values[key] for key in ("k1", "k2", "k3", "k4"))
    if named not in _PERSPECTIVE:
        raise FormatError(
            f"{where} has the camera model {named}, known are "
            f"{', '.join(_PERSPECTIVE + _FISHEYE)}.",
            hint="Undistort the images first, for example with COLMAP's image_undistorter.")
    if not any(values.values()):
        return "PINHOLE", ()
    if named == "FULL_OPENCV" or values["k3"]:
        # nerfstudio's k4 is a fourth power of r^2, COLMAP's a divisor.
        if values["k4"] and named != "FULL_OPENCV":
            raise FormatError(f"{where} has k4 = {values['k4']:g}, which {named} does not have.")
        return "FULL_OPENCV", tuple(values[key] for key in _COEFFICIENTS)
    if values["k4"]:
        raise FormatError(f"{where} has k4 = {values['k4']:g}, which {named} does not have.")
    return "OPENCV", tuple(values[key] for key in ("k1", "k2", "p1", "p2"))


def number(entry: Mapping[str, Any], key: str, where: str) -> float | None:
    """Returns the number under a key, None where there is none.

    Raises:
        FormatError: what is there is no number that is finite.
    """
    value = entry.get(key)
    if value is None:
        return None
    # Whole numbers in JSON may be larger than any float.
    if type(value) not in (int, float) or not abs(value) <= _LARGEST:
        raise FormatError(f"{where} has {key} = {value!r:.40}; needed is a finite number.")
    return float(value)
