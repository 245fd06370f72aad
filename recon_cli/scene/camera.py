"""A pinhole camera in the conventions of docs/conventions: OpenCV axes, pixel centres at +0.5."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import FormatError

# Number of focal lengths that the parameters begin with, and of all parameters, by COLMAP's names
# (src/colmap/sensor/models.h). The principal point follows the focal lengths; a panorama has none,
# only its width and height.
PANORAMA = "EQUIRECTANGULAR"
MODELS: dict[str, tuple[int, int]] = {
    PANORAMA: (0, 2),
    "SIMPLE_PINHOLE": (1, 3), "PINHOLE": (2, 4), "SIMPLE_RADIAL": (1, 4), "RADIAL": (1, 5),
    "OPENCV": (2, 8), "OPENCV_FISHEYE": (2, 8), "FULL_OPENCV": (2, 12),
    "SIMPLE_RADIAL_FISHEYE": (1, 4), "RADIAL_FISHEYE": (1, 5), "THIN_PRISM_FISHEYE": (2, 12),
    "FOV": (2, 5), "RAD_TAN_THIN_PRISM_FISHEYE": (2, 16), "SIMPLE_DIVISION": (1, 4),
    "DIVISION": (2, 5), "SIMPLE_FISHEYE": (1, 3), "FISHEYE": (2, 4), "EUCM": (2, 6)}
MAX_SIDE = 1 << 16  # pixels; no image format in use holds a longer side


@dataclass(frozen=True)
class Lens:
    """Known intrinsics of an image that may be distorted."""

    model: str  # one of `MODELS`
    width: int  # pixels
    height: int
    # in COLMAP's order: focal lengths and principal point in pixels (the centre of the first pixel
    # lies at 0.5), then distortion coefficients without a unit
    params: tuple[float, ...]

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise ValueError(f"the camera model {self.model} is unknown")
        if len(self.params) != MODELS[self.model][1]:
            raise ValueError(f"{self.model} takes {MODELS[self.model][1]} parameters, "
                             f"not {len(self.params)}")

    @property
    def is_panorama(self) -> bool:
        """Whether the image shows all directions (equirectangular)."""
        return self.model == PANORAMA

    def pinhole(self, viewmat: NDArray[np.float64]) -> Camera:
        """Returns a camera of the same focal lengths and principal point, without distortion."""
        focals, _ = MODELS[self.model]
        cx, cy = self.params[focals:focals + 2]
        return Camera(
            self.width, self.height, self.params[0], self.params[focals - 1], cx, cy, viewmat)

    def resized(self, width: int, height: int) -> Lens:
        """Returns the intrinsics of the same image resampled to width x height pixels."""
        if self.is_panorama:
            return panorama_lens(width, height)
        sx, sy = width / self.width, height / self.height
        focals, _ = MODELS[self.model]  # a single one takes the mean of both scales
        scales = [(sx + sy) / 2, sx, sy] if focals == 1 else [sx, sy, sx, sy]
        inner = [value * scale for value, scale in zip(self.params, scales, strict=False)]
        return replace(
            self, width=width, height=height, params=(*inner, *self.params[len(scales):]))


def panorama_lens(width: int, height: int) -> Lens:
    """Returns the lens of an equirectangular panorama, as COLMAP writes it."""
    return Lens(PANORAMA, width, height, (float(width), float(height)))


def make_lens(model: str, width: float, height: float, params: Sequence[float], where: str) -> Lens:
    """Returns the intrinsics of a file; FormatError if they are unknown or implausible."""
    if model not in MODELS:
        raise FormatError(
            f"{where} has the camera model {model}, known are {', '.join(MODELS)}.",
            hint="Undistort the images first, for example with COLMAP's image_undistorter.")
    if model == PANORAMA:
        raise FormatError(
            f"{where} is a panorama ({model}); poses are read of ordinary lenses.",
            hint="Give the folder of the panoramas as photos: recon finds their cameras itself.")
    focals, count = MODELS[model]
    if len(params) != count:
        raise FormatError(
            f"{where}: {model} takes {count} parameters, but there are {len(params)}.")
    if not all(map(math.isfinite, [width, height, *params])):
        raise FormatError(f"{where} has intrinsics that are not finite.")
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE) or min(params[:focals]) <= 0:
        raise FormatError(
            f"{where} has a camera of {width:g}x{height:g} pixels with the focal length "
            f"{min(params[:focals]):g}: no camera.")
    return Lens(model, round(width), round(height), tuple(float(value) for value in params))


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera at a place."""

    width: int  # pixels
    height: int
    fx: float  # focal lengths in pixels
    fy: float
    cx: float  # principal point in pixels; the centre of the first pixel lies at 0.5
    cy: float
    viewmat: NDArray[np.float64]  # [4, 4] float64, world to camera; x right, y down, z forward

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise ValueError(f"a camera of {self.width}x{self.height} pixels")
        if self.viewmat.shape != (4, 4):
            raise ValueError(f"viewmat has shape {self.viewmat.shape}, needed (4, 4)")

    @property
    def K(self) -> NDArray[np.float64]:  # noqa: N802  # the field's name
        """The intrinsics as a matrix, [3, 3] in pixels."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])

    @property
    def center(self) -> NDArray[np.float64]:
        """The optical centre in world coordinates, [3]."""
        return np.asarray(-self.viewmat[:3, :3].T @ self.viewmat[:3, 3])

    def project(
        self, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns the pixels [..., 2] of points [..., 3] in the world, and their depths [...].

        Pixels are NaN where the depth is not above 0: behind the camera, or beside it.
        """
        local = points @ self.viewmat[:3, :3].T + self.viewmat[:3, 3]
        depths = local[..., 2]
        ahead = np.where(depths > 0, depths, np.nan)[..., None]
        with np.errstate(over="ignore"):
            pixels = (self.fx, self.fy) * local[..., :2] / ahead + (self.cx, self.cy)
        return np.asarray(pixels), depths

    def contains(self, pixels: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Returns which pixels [..., 2] are in the image, [...]; none that is NaN."""
        return np.asarray(((pixels >= 0) & (pixels < (self.width, self.height))).all(axis=-1))

    def find_visible(self, points: NDArray[np.float64]) -> tuple[
            NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
        """Returns the rows of the points [P, 3] in the image, their columns, lines and depths."""
        pixels, depths = self.project(points)
        rows = np.flatnonzero(self.contains(pixels))
        columns, lines = pixels[rows].astype(np.int64).T
        return rows, columns, lines, depths[rows]

    def unproject(
        self, pixels: NDArray[np.float64], depths: NDArray[np.floating]
    ) -> NDArray[np.float64]:
        """Returns the points [P, 3] in the world that lie at depths [P] in pixels [P, 2]."""
        rays = np.column_stack([(pixels - (self.cx, self.cy)) / (self.fx, self.fy),
                                np.ones(len(pixels))])
        return np.asarray((rays * depths[:, None] - self.viewmat[:3, 3]) @ self.viewmat[:3, :3])

    def resized(self, width: int, height: int) -> Camera:
        """Returns the camera of the same view resampled to width x height pixels."""
        sx, sy = width / self.width, height / self.height
        return replace(self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy,
                       cx=self.cx * sx, cy=self.cy * sy)


def looking_at(
    eye: NDArray[np.float64], target: NDArray[np.float64], up: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns [4, 4] world to camera, level, from `eye` towards `target` (not along `up`)."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    return viewmat
