"""Camera RAW: a set of photos is developed alike, so that a point has one colour in all of them.

One white balance and one saturation per camera, one brightness for the whole set, and differences
of exposure are undone. What LibRaw would choose per photo (brightness, maximum) is switched off,
and what it leaves out of a DNG is added (`dng_corrections`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import rawpy
from numpy.typing import NDArray

from recon_cli.capture.dng_corrections import Warp, correct_shading, read_corrections, turn
from recon_cli.capture.frame_measures import shrink
from recon_cli.capture.images import Photo, check_size, open_raw
from recon_cli.capture.raw_exposure import RawMeasures, exposures, measure_view, nominal_ev
from recon_cli.capture.unreadable import unreadable_error
from recon_cli.errors import InputError
from recon_cli.workspace.summaries import JsonRecord

SRGB = (2.4, 12.92)  # IEC 61966-2-1: power and slope of the straight part
LOOK_PIXELS = 800  # longer side of the small views that exposures are measured on
SATURATED = 0.99  # of the maximum; interpolation and rounding take the rest
# LibRaw's own thresholds: 1 % of the pixels exceed white (auto_bright_thr), and a maximum of the
# data above .75 of the nominal one is where the sensor saturates (adjust_maximum_thr).
BLOWN_SHARE, SATURATES_ABOVE = 0.01, 0.75
# A photo counts as clipped from this share of its pixels on; fewer are lamps and glints.
CLIPPED_SHARE = 0.001
# White is lowered until all photos clip at one radiance, but clips no more of the set than this.
SACRIFICED_SHARE = 0.1
MOST_BRIGHTENED = 8.0  # LibRaw's limit for exp_shift


T = TypeVar("T")
CameraSettings = tuple[tuple[float, ...], int]  # multipliers and saturation of one camera


@dataclass(frozen=True)
class RawShot(JsonRecord):
    """How one photo is developed."""

    multipliers: tuple[float, ...]  # red, green, blue, second green
    saturation: int  # sensor value that is white, black level included
    gain_ev: float  # stops of brightening after white balance


@dataclass(frozen=True)
class RawPlan(JsonRecord):
    """How the RAW photos of a folder are developed, by their names."""

    shots: Mapping[str, RawShot]
    broken: Mapping[str, str]  # why a photo cannot be developed


@dataclass(frozen=True)
class _Header:
    """The values of a photo's header that planning needs."""

    path: Path
    camera: tuple[object, ...]
    multipliers: tuple[float, ...]
    white_level: int
    highest: int
    ev: float | None
    f_number: float | None


def plan_raw(
    paths: Mapping[str, Path], *, step: Callable[[], None] = lambda: None
) -> RawPlan:
    """Returns how to develop RAW photos of one scene, by their names in order, alike.

    It calls `step` per photo.
    """
    broken: dict[str, str] = {}
    names = {path: name for name, path in paths.items()}
    headers = [header for path in names
               if (header := _try_read(_read_header, path, names[path], broken))]
    common = _by_camera(headers)
    readable: list[tuple[_Header, RawMeasures]] = []
    for header in headers:
        measure = partial(_measure, shared=common[header.camera])
        view = _try_read(measure, header.path, names[header.path], broken)
        if view is not None:
            readable.append((header, view))
        step()
    if not readable:
        return RawPlan({}, broken)
    measures = [view for _, view in readable]
    ev = exposures(measures, _nominal([header for header, _ in readable]))
    gains = -ev - math.log2(_white(measures, ev))
    return RawPlan({
        names[header.path]: RawShot(*common[header.camera], float(gain))
        for (header, _), gain in zip(readable, gains, strict=True)}, broken)


def develop(photo: Photo, plan: RawPlan) -> NDArray[np.uint8]:
    """Returns a RAW photo as upright sRGB, [H, W, 3]; InputError if it is, or was, damaged."""
    shot = plan.shots.get(photo.name)
    if shot is None:
        raise InputError(plan.broken[photo.name], hint="")  # the reason says what helps
    try:
        with _open_corrected(photo.path) as (raw, warp):
            flip = raw.sizes.flip
            rgb = np.asarray(raw.postprocess(
                **_develop_options(shot.multipliers, shot.saturation), bright=2.0 ** shot.gain_ev,
                gamma=SRGB, output_color=rawpy.ColorSpace.sRGB, output_bps=8,
                user_flip=None if warp is None else 0), np.uint8)
            if warp is not None:
                rgb = turn(warp.apply(rgb), flip)
    except rawpy.LibRawError as error:
        raise unreadable_error(photo.path, error) from error
    check_size(photo, rgb)
    return rgb


def _develop_options(multipliers: Sequence[float], saturation: int) -> dict[str, Any]:
    """Returns the options that LibRaw would otherwise choose per photo."""
    return {
        "user_wb": list(multipliers), "user_sat": saturation, "no_auto_bright": True,
        "adjust_maximum_thr": 0.0, "highlight_mode": rawpy.HighlightMode.Clip}


@contextmanager
def _open_corrected(path: Path) -> Iterator[tuple[rawpy.RawPy, Warp | None]]:
    """Opens a RAW photo without the shading of its lens; yields its distortion, too."""
    corrections = read_corrections(path)
    with open_raw(path) as raw:
        correct_shading(raw, corrections.gains)
        yield raw, corrections.warp


def _try_read(
    read: Callable[[Path], T], path: Path, name: str, broken: dict[str, str]
) -> T | None:
    """Returns what `read` does, or None with the reason in `broken` by the photo's name."""
    try:
        return read(path)
    except InputError as error:
        reason = error
    except rawpy.LibRawError as error:
        reason = unreadable_error(path, error)
    broken[name] = f"{reason.message} {reason.hint}"
    return None


def _read_header(path: Path) -> _Header:
    with _open_corrected(path) as (raw, _):
        shot, white = raw.other, int(raw.white_level)
        highest = int(raw.raw_image_visible.max())
        if highest == 0:  # how LibRaw answers a compression that it does not know
            raise InputError(
                f"{path.name} holds only black pixels.",
                hint="Convert it to DNG or TIFF with the camera's own program, or leave it out.")
        f_number = shot.aperture if shot.aperture > 0 else None
        # Per camera and bit depth: a maximum of 4095 says nothing about 16383.
        camera = (raw.rgb_xyz_matrix.tobytes(), raw.color_desc, round(math.log2(max(white, 1))))
        return _Header(
            path, camera, _read_white_balance(raw), white, highest,
            nominal_ev(shot.shutter_speed, shot.iso_speed), f_number)


def _read_white_balance(raw: rawpy.RawPy) -> tuple[float, ...]:
    """Returns the white balance as shot, else that of daylight, with green as 1."""
    for balance in (raw.camera_whitebalance, raw.daylight_whitebalance):
        red, green, blue, second = (float(value) for value in balance)
        if all(math.isfinite(value) and value > 0 for value in (red, green, blue)):
            return (red / green, 1.0, blue / green, (second or green) / green)
    return (1.0, 1.0, 1.0, 1.0)


def _by_camera(headers: Sequence[_Header]) -> dict[tuple[object, ...], CameraSettings]:
    """Returns for each camera the white balance of its median photo, and where it saturates."""
    common = {}
    for camera in {header.camera for header in headers}:
        own = [header for header in headers if header.camera == camera]
        warmth = sorted(own, key=lambda header: header.multipliers[0] / header.multipliers[2])
        nominal = min(header.white_level for header in own)
        highest = max(header.highest for header in own)
        real = SATURATES_ABOVE * nominal < highest < nominal
        common[camera] = warmth[(len(own) - 1) // 2].multipliers, highest if real else nominal
    return common


def _measure(path: Path, shared: CameraSettings) -> RawMeasures:
    with _open_corrected(path) as (raw, _):
        wide = raw.postprocess(
            **_develop_options(*shared), half_size=True, gamma=(1, 1),
            output_color=rawpy.ColorSpace.raw, output_bps=16)
    linear = wide.astype(np.float32) / 65535
    clipped = (linear.max(axis=2) >= SATURATED).astype(np.float32)
    small, touched = (shrink(plane, LOOK_PIXELS) for plane in (linear, clipped))
    return measure_view(small, touched > 0)


def _nominal(headers: Sequence[_Header]) -> list[float | None]:
    """Returns exposures by EXIF; a lens that never gives its f-number is assumed to keep it."""
    if all(header.f_number is None for header in headers):
        return [header.ev for header in headers]
    return [
        None if header.ev is None or header.f_number is None
        else header.ev - 2 * math.log2(header.f_number) for header in headers]


def _white(measures: Sequence[RawMeasures], ev: NDArray[np.float64]) -> float:
    """Returns the radiance that becomes white, where saturation of the median photo has 1."""
    radiance = np.concatenate([
        view.brightest * 2.0 ** -own for view, own in zip(measures, ev, strict=True)])
    bright, floor = np.quantile(radiance, [1 - BLOWN_SHARE, 1 - SACRIFICED_SHARE], method="lower")
    white = min(1.0, max(float(bright), 1 / MOST_BRIGHTENED))
    clips = [
        2.0 ** -own for view, own in zip(measures, ev, strict=True)
        if view.clipped_share > CLIPPED_SHARE]
    return float(min([white, *(max(at, float(floor)) for at in clips)]))
