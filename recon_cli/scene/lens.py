"""The inner side of a camera before undistortion: a COLMAP camera model and its numbers."""

from __future__ import annotations

from dataclasses import dataclass, replace

# Number of focal lengths that the parameters begin with, and of all parameters, by COLMAP's names
# (src/colmap/sensor/models.h). The principal point follows the focal lengths.
MODELS: dict[str, tuple[int, int]] = {
    "SIMPLE_PINHOLE": (1, 3),
    "PINHOLE": (2, 4),
    "SIMPLE_RADIAL": (1, 4),
    "RADIAL": (1, 5),
    "OPENCV": (2, 8),
    "OPENCV_FISHEYE": (2, 8),
    "FULL_OPENCV": (2, 12),
    "SIMPLE_RADIAL_FISHEYE": (1, 4),
    "RADIAL_FISHEYE": (1, 5),
    "THIN_PRISM_FISHEYE": (2, 12),
}


@dataclass(frozen=True)
class Lens:
    """Known intrinsics of an image that may be distorted.

    Attributes:
        model: one of `MODELS`.
        width: image width in pixels.
        height: image height in pixels.
        params: in COLMAP's order: focal lengths and principal point in pixels (the centre of the
            first pixel lies at 0.5), then distortion coefficients without a unit.
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise ValueError(f"the camera model {self.model} is unknown")
        if len(self.params) != MODELS[self.model][1]:
            raise ValueError(f"{self.model} takes {MODELS[self.model][1]} parameters, "
                             f"not {len(self.params)}")

    def resized(self, width: int, height: int) -> Lens:
        """Returns the intrinsics of the same image resampled to width x height pixels.

        A model with one focal length takes the mean of both scales; they differ by rounding alone.
        """
        sx, sy = width / self.width, height / self.height
        focals, _ = MODELS[self.model]
        scales = [(sx + sy) / 2, sx, sy] if focals == 1 else [sx, sy, sx, sy]
        inner = [value * scale for value, scale in zip(self.params, scales, strict=False)]
        return replace(
            self, width=width, height=height, params=(*inner, *self.params[len(scales):]))
