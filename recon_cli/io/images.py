"""Pixels in and out. One way to reduce an image, because the filter alone can move a score."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.atomic import write_bytes
from recon_cli.errors import FormatError
from recon_cli.scene import Camera


def fitted_size(width: int, height: int, max_size: int) -> tuple[int, int]:
    """Returns (width, height) reduced so that the longer side is at most `max_size`."""
    factor = min(1.0, max_size / max(width, height))
    return max(1, round(width * factor)), max(1, round(height * factor))


def fitted_camera(camera: Camera, max_size: int) -> Camera:
    """Returns the camera of the image that `read_image` gives for the same size."""
    return camera.resized(*fitted_size(camera.width, camera.height, max_size))


def read_image(path: Path, width: int, height: int) -> NDArray[np.uint8]:
    """Returns an image as [height, width, 3] RGB, reduced by area where it is larger.

    Raises:
        FormatError: the file is missing or no image.
    """
    data = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if data is None:
        raise FormatError(f"{path} cannot be read as an image.", hint="Run `recon sfm --again`.")
    if data.shape[:2] != (height, width):
        data = cv2.resize(data, (width, height), interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(data[:, :, ::-1], dtype=np.uint8)


def write_png(path: Path, image: NDArray[np.uint8]) -> None:
    """Writes [H, W, 3] RGB as PNG, whole or not at all."""
    encoded, data = cv2.imencode(".png", np.ascontiguousarray(image[:, :, ::-1]))
    if not encoded:
        raise ValueError(f"OpenCV cannot encode an image of shape {image.shape}")
    write_bytes(path, data.tobytes())
