"""Data sets with known cameras: the records that readers return, and the files that they list."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from recon_cli.datasets.depth_file import DepthFile
from recon_cli.errors import FormatError
from recon_cli.scene.camera import Lens
from recon_cli.workspace.records import PoseAccuracy

SUFFIXES = (".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG", ".webp", ".tif", ".tiff", ".bmp")
_FORMATS = ("JPEG", "PNG", "TIFF", "WEBP", "BMP", "PPM")


@dataclass(frozen=True, eq=False)
class PosedImage:
    """An image whose camera is known; its file need not exist before `FrameTable.finish`.

    The file is an image; or a video, of which it is one frame; or one that `read` reads.
    """

    name: str  # unique within the set
    path: Path
    lens: Lens  # intrinsics; after `FrameTable.finish` at the size of the file
    viewmat: NDArray[np.float64]  # [4, 4] float64 world to camera, OpenCV axes
    held_out: bool = False  # the data set itself holds it out for the score
    depth: DepthFile | None = None  # reads its depth, None without depth
    mask: Path | None = None  # file of a mask, None without mask
    frame: int | None = None  # number of the frame in the video `path`, from 0
    time: float | None = None  # seconds, on the clock of the capture
    clock_ms: float | None = None  # milliseconds on the clock of the device, where depth has it
    read: Callable[[], NDArray[np.uint8]] | None = None  # returns RGB [H, W, 3] of other files
    rim: int = 0  # pixels along the border that may be black and are masked

    @property
    def is_picture(self) -> bool:
        """Whether the file is an image."""
        return self.frame is None and self.read is None


@dataclass(frozen=True, eq=False)
class PosedSet:
    """A data set with poses."""

    layout: str  # the name of one of `layouts.LAYOUTS`, which `layouts.read_posed` gives it
    images: tuple[PosedImage, ...]  # in the order of the data set
    missing: tuple[str, ...] = ()  # names of images that it lists, but whose files do not exist
    metric: bool = False  # its unit is the metre
    # Nothing but its depth, which is in metres, says so: it holds only if that fits the poses.
    metric_by_depth: bool = False
    # Up [3], a unit vector in its world, where the program that wrote it knows.
    up: tuple[float, float, float] | None = None
    # Where up is None: its axes are arbitrary, so that up is to be found from the scene. Else the
    # axes stay as they are.
    find_up: bool = False
    accuracy: PoseAccuracy = "solved"
    sequence: bool = False  # its images are frames of one walk, in order
    splits: bool = False  # it says itself which images are held out
    points: NDArray[np.float64] | None = None  # [P, 3] sparse points in its world, if it has any
    colors: NDArray[np.uint8] | None = None  # [P, 3] RGB of the points
    notices: tuple[str, ...] = ()  # for the user, about how it was read

    @property
    def lenses(self) -> tuple[Lens, ...]:
        """The different intrinsics of the images."""
        return tuple(dict.fromkeys(image.lens for image in self.images))

    @property
    def centers(self) -> NDArray[np.float64]:
        """Where the cameras are, [N, 3]."""
        return np.stack([-image.viewmat[:3, :3].T @ image.viewmat[:3, 3] for image in self.images])


def image_size(path: Path) -> tuple[int, int]:
    """Returns (width, height) of an image from its header; FormatError if it is none."""
    try:
        with warnings.catch_warnings():
            # Pillow warns from 89 megapixels and refuses from twice that.
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path, formats=_FORMATS) as image:
                return image.size
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise FormatError(
            f"{path} cannot be read as an image.", hint="Copy the image again.") from error


def is_file(path: Path) -> bool:
    """Returns whether a path from a file's text is a file; a name that is too long is none."""
    try:
        return path.is_file()
    except OSError:
        return False


def resolve_inside(folder: Path, name: object, where: str) -> Path:
    """Returns folder/name for a relative name that stays in the folder.

    A data set may come from anywhere, so it may not name files elsewhere on the disk; links below
    the folder are followed. `name` has either kind of slash; `where` is its entry, for messages.
    FormatError if `name` is not a string, is absolute, or leads out of the folder.
    """
    if not isinstance(name, str) or not name.strip() or "\0" in name:
        raise FormatError(f"{where} has no file name.")
    path = PurePosixPath(name if is_file(folder / name) else name.replace("\\", "/"))
    depth = 0
    for part in path.parts:
        depth += -1 if part == ".." else 1
        if depth < 0:
            break
    drive = len(path.parts[0]) == 2 and path.parts[0][1] == ":" if path.parts else False
    if path.is_absolute() or drive or depth < 0:
        raise FormatError(
            f"{where} names {name}, which lies outside {folder}.",
            hint="Put the files below that folder and name them relative to it.")
    return folder / path
