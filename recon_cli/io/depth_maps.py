"""Sensor depth of ingested frames: one map a frame at the sensor's own size, with its confidence.

ingest writes depth.json and depth/, for all frames that the data set itself does not hold out; who
trains leaves out those that --holdout does. A map is a PNG of 16 bits, named like its frame; levels
of confidence lie beside it as 8 bits.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import FormatError, ManifestError
from recon_cli.io.colmap_library import pycolmap
from recon_cli.io.images import decode_file, write_png
from recon_cli.scene.camera import Lens, make_lens
from recon_cli.workspace import atomic
from recon_cli.workspace.json_record import JsonRecord
from recon_cli.workspace.records import AGAIN, Confidence

DEPTH, LIST = "depth", "depth.json"
MEDIAN = 5  # pixels a side of the median that takes a sensor's noise, and leaves edges
_MOST = int(np.iinfo(np.uint16).max)
_WHOLE = 0.02  # of a unit: what float32 leaves of a multiple
_CONFIDENCE = ".confidence.png"
LEAST_POINTS = 20  # of a view, by which its own depth is judged
# Relative noise at the points of a model, beyond which depth is not of this model, or tells less
# than the images: phones have about .01, cheap cameras .03.
MOST_NOISE = 0.1
# Relative difference of neighbouring depths that is an edge, beside which depth is of nothing.
EDGE = 0.05


@dataclass(frozen=True)
class DepthMap(JsonRecord):
    """How the depth map of a frame is stored."""

    lens: Lens  # intrinsics of the map, of its size
    unit: float  # world units of a value of 1
    confidence: bool  # it has levels
    reliable: float | None = None  # world units; what is farther is a guess. None: no limit


def write_depth(
    stage: Path, name: str, depth: NDArray[np.float32], lens: Lens, *, unit: float | None = None,
    reliable: float | None = None, confidence: NDArray[np.uint8] | None = None,
) -> DepthMap:
    """Writes the z-depth [h, w] of a frame in world units, 0 where unknown, and returns its record.

    `unit` is kept if all values are multiples of it that fit; else the largest value takes all 16
    bits.
    """
    exact, most = depth.astype(np.float64), float(depth.max(initial=0))
    if unit is None or most > _MOST * unit or np.abs(
            exact / unit - np.rint(exact / unit)).max(initial=0) > _WHOLE:
        unit = most / _MOST if most > 0 else 1.0
    folder = stage / DEPTH
    folder.mkdir(parents=True, exist_ok=True)
    write_png(folder / name, np.rint(exact / unit).astype(np.uint16))
    if confidence is not None:
        write_png(_confidence(folder / name), confidence)
    return DepthMap(lens, unit, confidence is not None, reliable)


def write_depth_list(stage: Path, maps: Mapping[str, DepthMap]) -> None:
    """Writes which frames have depth, by name, into ingest's folder."""
    atomic.write_json(stage / LIST, {name: one.to_json() for name, one in maps.items()})


def read_depth_list(stage: Path) -> dict[str, DepthMap]:
    """Returns the depth maps of ingest's folder by frame; FormatError if the list is damaged."""
    path = stage / LIST
    if not path.exists():
        return {}
    try:
        maps = {name: DepthMap.from_json(value)
                for name, value in atomic.read_json(path, dict, hint=AGAIN).items()}
        for name, one in maps.items():
            make_lens(one.lens.model, one.lens.width, one.lens.height, one.lens.params, name)
            if not 0 < one.unit < np.inf or Path(name).name != name:
                raise ValueError(name)
    except (ManifestError, ValueError) as error:
        raise FormatError(f"{path} is not a list of depth maps.", hint=AGAIN) from error
    return maps


def read_depth(
    stage: Path, name: str, one: DepthMap
) -> tuple[NDArray[np.float32], NDArray[np.uint8] | None]:
    """Returns z-depth [h, w] in world units, 0 where unknown, and levels [h, w] of confidence.

    FormatError if a file is missing or damaged.
    """
    shape = (one.lens.height, one.lens.width)
    path = stage / DEPTH / name
    depth = _read(path, shape).astype(np.float64) * one.unit
    levels = _read(_confidence(path), shape) if one.confidence else None
    return depth.astype(np.float32), None if levels is None else np.asarray(levels, np.uint8)


def read_sure_depth(ingest: Path, name: str, one: DepthMap) -> NDArray[np.float32]:
    """Returns the depth [h, w] of a frame in world units, 0 where it is not sure or too far."""
    depth, levels = read_depth(ingest, name, one)
    if levels is not None:
        depth[levels < Confidence.HIGH] = 0
    if one.reliable is not None:
        depth[depth > one.reliable] = 0
    return depth


def lens_camera(lens: Lens) -> pycolmap.Camera:
    """Returns the camera of a lens, as of a depth map."""
    return pycolmap.Camera(
        model=lens.model, width=lens.width, height=lens.height, params=lens.params)


def find_visible(
    camera: pycolmap.Camera, local: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Returns the rows of points [P, 3] in a camera's axes that it shows, and columns and lines.

    As `Camera.find_visible`, for any lens; not those that it has no pixel for.
    """
    rows = np.flatnonzero(local[:, 2] > 0)
    pixels = np.asarray(camera.img_from_cam(local[rows])).reshape(-1, 2)
    inside = ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(axis=1)
    columns, lines = pixels[inside].astype(np.int64).T
    return rows[inside], columns, lines


def find_edges(depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Returns where depth differs much from that of a neighbour, or one is unknown, [H, W]."""
    kernel = np.ones((3, 3), np.uint8)
    high, low = cv2.dilate(depth, kernel), cv2.erode(depth, kernel)
    return np.asarray(high - low > EDGE * depth)


def _read(path: Path, shape: tuple[int, int]) -> NDArray[np.generic]:
    data = decode_file(path, cv2.IMREAD_UNCHANGED)
    if data is None or data.shape != shape:
        raise FormatError(f"{path} cannot be read as a depth map.", hint=AGAIN)
    return np.asarray(data)


def _confidence(path: Path) -> Path:
    return path.with_name(path.stem + _CONFIDENCE)
