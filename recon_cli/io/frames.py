"""The frames that ingest hands on: their files, their list frames.json, and the held-out views.

A masked frame has a twin of its name in masks/: 8-bit gray, 255 where a pixel counts, 0 where it is
ignored by features, training and scores.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import FormatError
from recon_cli.scene.camera import Lens
from recon_cli.workspace import atomic

FOLDER, MASKS, LIST = "frames", "masks", "frames.json"
AGAIN = "Delete the folder of ingest in the workspace and run recon ingest again."


@dataclass(frozen=True)
class Frame:
    """One stored frame.

    Attributes:
        name: file name in the folder of frames.
        time_seconds: time of showing in the video, None for photos and where it is not known.
        source: name of the file that it came from.
        sharpness: variance of its Laplacian, None for photos.
        held_out: kept for the score, never trained on.
        group: index of the group of frames that share its intrinsics.
        masked: it has a mask of its name in the folder of masks.
    """

    name: str
    time_seconds: float | None
    source: str
    sharpness: float | None
    held_out: bool
    group: int = 0
    masked: bool = False


@dataclass(frozen=True)
class Group:
    """Frames that one camera took with one setting of its lens: they share intrinsics.

    Attributes:
        name: what they came from, for messages.
        width: of its frames in pixels, as stored.
        height: of its frames in pixels, as stored.
        focal_px: focal length in pixels of the stored frames by EXIF, None where unknown.
        lens: known intrinsics of the stored frames, None where they are to be estimated.
    """

    name: str
    width: int
    height: int
    focal_px: float | None = None
    lens: Lens | None = None


@dataclass(frozen=True)
class FrameList:
    """What frames.json holds.

    Attributes:
        source: what the capture was taken for: "video", "photos", "mixed", or the layout of a data
            set with poses.
        groups: at least one.
        frames: sorted by name.
    """

    source: str
    groups: tuple[Group, ...]
    frames: tuple[Frame, ...]

    def write(self, stage: Path) -> None:
        """Writes the list into ingest's folder."""
        atomic.write_json(stage / LIST, dataclasses.asdict(self))


def read_frame_list(stage: Path) -> FrameList:
    """Returns the list of frames in ingest's folder.

    Raises:
        FormatError: it is missing or not what `FrameList.write` wrote.
    """
    value = atomic.read_json(stage / LIST)
    try:
        frames = tuple(Frame(**frame) for frame in value.pop("frames"))
        groups = tuple(_group(group) for group in value.pop("groups"))
        return FrameList(**value, groups=groups, frames=frames)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise FormatError(
            f"{stage / LIST} is no list of frames.", hint=AGAIN) from error


def _group(value: dict[str, Any]) -> Group:
    lens = value.pop("lens")
    if lens is not None:
        lens = Lens(**{**lens, "params": tuple(lens["params"])})
    return Group(**value, lens=lens)


def held_out(names: Sequence[str], holdout: tuple[str, float, float]) -> frozenset[str]:
    """Returns which frames are kept for the score.

    Args:
        names: of all frames.
        holdout: (kind, a, b) as `holdout_option.parse_holdout` gives it: each a-th by name from the
            first on, the share a to b of the names in order, or none.
    """
    ordered = sorted(names)
    kind, a, b = holdout
    if kind == "every":
        return frozenset(ordered[::int(a)])
    if kind == "segment":
        return frozenset(ordered[round(a * len(ordered)):round(b * len(ordered))])
    return frozenset()


def prepare(stage: Path) -> Path:
    """Returns the folder of frames in a stage's folder, made and cleared of half-written files."""
    folder = stage / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    for leftover in stage.rglob(".*.tmp*"):  # what kill -9 leaves of atomic.replacing
        leftover.unlink()
    return folder


def write_png(path: Path, rgb: NDArray[np.uint8]) -> None:
    """Writes RGB pixels [H, W, 3] without loss, whole or not at all."""
    _, data = cv2.imencode(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
    atomic.write_bytes(path, data.tobytes())


def read_png(path: Path) -> NDArray[np.uint8]:
    """Returns the pixels of a frame, RGB, [H, W, 3].

    Raises:
        FormatError: the file holds no picture.
    """
    # Not cv2.imread, which cannot open every path on Windows.
    data = np.frombuffer(path.read_bytes(), np.uint8)
    bgr = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
    if bgr is None:
        raise FormatError(f"{path} is no readable picture.", hint=AGAIN)
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)


def fitted_size(width: int, height: int, longest: int) -> tuple[int, int]:
    """Returns (width, height) of an image whose longer side is reduced to `longest` at most."""
    if max(height, width) <= longest:
        return width, height
    scale = longest / max(height, width)
    return max(1, round(width * scale)), max(1, round(height * scale))


def fitted(rgb: NDArray[np.uint8], longest: int) -> NDArray[np.uint8]:
    """Returns an image reduced by area to at most `longest` pixels on its longer side."""
    height, width = rgb.shape[:2]
    size = fitted_size(width, height, longest)
    if size == (width, height):
        return rgb
    return np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)
