"""Reading, writing and resizing of images and masks; a file that is none is a FormatError.

There is one way to reduce an image, because the choice of filter alone can move a score.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import FormatError, Hint
from recon_cli.scene.camera import Camera
from recon_cli.scene.train_view import TrainView
from recon_cli.workspace.atomic import read_bytes, write_bytes
from recon_cli.workspace.records import AGAIN

_PNG = b"\x89PNG\r\n\x1a\n"  # what every PNG begins with
HALF = 128  # of a mask of 8 bits: from this value on a pixel counts, is white, or opaque
_SMALLEST = 16  # pixels a side; a smaller image tells nothing, and SSIM's window is 11


def fit_size(width: int, height: int, max_size: int) -> tuple[int, int]:
    """Returns (width, height) reduced so that the longer side is at most `max_size`."""
    factor = min(1.0, max_size / max(width, height))
    return max(1, round(width * factor)), max(1, round(height * factor))


def fit_camera(camera: Camera, max_size: int) -> Camera:
    """Returns the camera of an image that was reduced to the same size."""
    return camera.resized(*fit_size(camera.width, camera.height, max_size))


def read_image(path: Path, width: int, height: int) -> NDArray[np.uint8]:
    """Returns an image as [height, width, 3] RGB, reduced by area where it is larger."""
    data = _read(path, cv2.IMREAD_COLOR, "an image")
    if data.shape[:2] != (height, width):
        data = cv2.resize(data, (width, height), interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(data[:, :, ::-1], dtype=np.uint8)


def read_mask(path: Path, width: int, height: int) -> NDArray[np.bool_]:
    """Returns a mask as [height, width], True where a pixel counts.

    A pixel of the reduced mask counts only if all pixels that it covers do.
    """
    data = _read(path, cv2.IMREAD_GRAYSCALE, "a mask")
    ignored = (data < 255).astype(np.float32)  # half-covered edges included
    if data.shape != (height, width):
        # zeros alone average to exactly 0; the mean of bytes would round a sliver away
        ignored = cv2.resize(ignored, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(ignored == 0)


def _read(path: Path, flags: int, kind: str) -> NDArray[np.uint8]:
    data = decode_file(path, flags)
    if data is None:
        raise FormatError(f"{path} cannot be read as {kind}.", hint=Hint("sfm", again=True))
    return data


def decode_file(path: Path, flags: int) -> NDArray[np.uint8] | None:
    """Returns an image file as OpenCV decodes it, None where it cannot or there is none.

    cv2.imread itself crashes on a path that is not UTF-8, and finds none with letters beyond ASCII
    on Windows.
    """
    try:
        data = np.frombuffer(read_bytes(path), np.uint8)
        return cv2.imdecode(data, flags) if len(data) else None
    except (OSError, ValueError, cv2.error):  # of more pixels than it allows
        return None


def fill_masked(image: NDArray[np.uint8], mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Returns an image [H, W, 3] whose ignored pixels have the mean colour of those that count.

    SSIM compares windows: pixels under the mask must not matter, and black would add an edge.
    """
    result = image.copy()
    result[~mask] = np.rint(image[mask].mean(axis=0)) if mask.any() else 0
    return result


def read_masked_image(
    path: Path, mask: Path | None, width: int, height: int
) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None]:
    """Returns an image [height, width, 3] filled under its mask, and the mask (None: no mask)."""
    image = read_image(path, width, height)
    if mask is None:
        return image, None
    counts = read_mask(mask, width, height)
    return (image, None) if counts.all() else (fill_masked(image, counts), counts)


def to_uint8(image: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Returns values rounded to steps of 1/255, clipped to [0, 1]."""
    return np.asarray(np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)


def encode_image(
    image: NDArray[np.uint8] | NDArray[np.uint16], kind: str, *parameters: int
) -> bytes:
    """Returns [H, W, 3] RGB or [H, W] gray as a file of a kind: png, webp, or jpg of quality 95.

    `parameters` are those of OpenCV's imencode.
    """
    ordered = image[:, :, ::-1] if image.ndim == 3 else image
    encoded, data = cv2.imencode(f".{kind}", np.ascontiguousarray(ordered), parameters)
    if not encoded:
        raise ValueError(f"OpenCV cannot encode an image of shape {image.shape} as {kind}")
    return data.tobytes()


def write_png(path: Path, image: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    """Writes [H, W, 3] RGB or [H, W] gray of 8 or 16 bits as PNG, atomically."""
    write_bytes(path, encode_image(image, "png"))


def is_whole_png(path: Path) -> bool:
    """Returns whether a file is a PNG as it was written: every chunk with its CRC, and no more."""
    try:
        data = read_bytes(path)
        at, kind = len(_PNG), b""
        while data.startswith(_PNG) and kind != b"IEND" and at < len(data):
            length, = struct.unpack_from(">I", data, at)
            kind, end = data[at + 4:at + 8], at + 8 + length
            if struct.unpack_from(">I", data, end) != (zlib.crc32(data[at + 4:end]),):
                return False
            at = end + 4
    except (OSError, ValueError, struct.error):
        return False
    return kind == b"IEND" and at == len(data)


def read_png(path: Path) -> NDArray[np.uint8]:
    """Returns the pixels of a frame, RGB, [H, W, 3]."""
    bgr = decode_file(path, cv2.IMREAD_COLOR)
    if bgr is None:
        raise FormatError(f"{path} cannot be read as an image.", hint=AGAIN)
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)


def fit_image(rgb: NDArray[np.uint8], longest: int) -> NDArray[np.uint8]:
    """Returns an image reduced by area to at most `longest` pixels on its longer side."""
    height, width = rgb.shape[:2]
    size = fit_size(width, height, longest)
    if size == (width, height):
        return rgb
    return np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)


def reduce_to(view: TrainView, side: int) -> TrainView:
    """Returns a view whose longer side has at most so many pixels, as `reduce_view`."""
    return reduce_view(view, max(1.0, max(view.camera.width, view.camera.height) / side))


def reduce_view(view: TrainView, factor: float) -> TrainView:
    """Returns a view and its camera reduced by area; unchanged where it would be too small."""
    camera = view.camera
    width, height = round(camera.width / factor), round(camera.height / factor)
    if factor == 1 or min(width, height) < _SMALLEST:
        return view
    image = cv2.resize(view.image, (width, height), interpolation=cv2.INTER_AREA)
    mask = None
    if view.mask is not None:
        hidden = (~view.mask).astype(np.float32)
        # a reduced pixel counts only where all that it covers counts
        mask = np.asarray(cv2.resize(hidden, (width, height), interpolation=cv2.INTER_AREA) == 0)
    return TrainView(
        camera.resized(width, height), np.ascontiguousarray(image), mask, depth=view.depth)
