"""What a data set knows beyond its images: poses in poses.json, points in points.safetensors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from recon_cli.errors import FormatError
from recon_cli.scene.camera import Lens
from recon_cli.workspace import atomic


@dataclass(frozen=True, eq=False)
class PosedImage:
    """One image whose camera is known.

    Attributes:
        name: unique within the set, as the data set names it.
        path: its file.
        lens: index into the lenses of the set.
        viewmat: [4, 4] float64 world to camera, OpenCV axes.
        held_out: the data set itself keeps it for the score.
        depth: reads z-depth, [H, W] float32 in world units, 0 where there is none; None where the
            image has no depth.
        mask: file of a mask, None where there is none.
    """

    name: str
    path: Path
    lens: int
    viewmat: NDArray[np.float64]
    held_out: bool = False
    depth: Callable[[], NDArray[np.float32]] | None = None
    mask: Path | None = None


@dataclass(frozen=True, eq=False)
class PosedSet:
    """A data set with poses.

    Attributes:
        layout: what it was taken for: "colmap", "transforms", "replica" or "scannet".
        lenses: intrinsics at the full size of the images.
        images: in the order of the data set.
        missing: images that it lists, but whose files are gone.
        metric: its unit is the metre.
        sequence: its images are frames of one walk, in order.
        splits: it says itself which images are held out.
        points: [P, 3] float64 sparse points in its world, None where it has none.
        colors: [P, 3] uint8 their RGB colours, None with them.
        notices: what the user should know about how it was read.
    """

    layout: str
    lenses: tuple[Lens, ...]
    images: tuple[PosedImage, ...]
    missing: tuple[str, ...] = ()
    metric: bool = False
    sequence: bool = False
    splits: bool = False
    points: NDArray[np.float64] | None = None
    colors: NDArray[np.uint8] | None = None
    notices: tuple[str, ...] = ()


POSES, POINTS = "poses.json", "points.safetensors"
_AGAIN = "Run `recon ingest --again`."


@dataclass(frozen=True, eq=False)
class KnownPoses:
    """Poses that came with a data set.

    Attributes:
        viewmats: [4, 4] float64 world to camera by frame name; OpenCV axes.
        metric: the world's unit is the metre.
        points: [P, 3] float64 initial points in the same world, None where there are none.
        colors: [P, 3] uint8 their RGB colours, None with them.
    """

    viewmats: Mapping[str, NDArray[np.float64]]
    metric: bool
    points: NDArray[np.float64] | None = None
    colors: NDArray[np.uint8] | None = None

    def write(self, stage: Path) -> None:
        """Writes both files into ingest's folder."""
        atomic.write_json(stage / POSES, {
            "metric": self.metric, "points": self.points is not None,
            "viewmats": {name: matrix.tolist() for name, matrix in self.viewmats.items()}})
        if self.points is not None and self.colors is not None:
            with atomic.replacing(stage / POINTS) as temporary:
                save_file({"points": np.ascontiguousarray(self.points),
                           "colors": np.ascontiguousarray(self.colors)}, temporary)


def read_poses(path: Path) -> KnownPoses:
    """Returns what `KnownPoses.write` wrote; `path` is that of poses.json.

    Raises:
        FormatError: a file is missing or not what was written.
    """
    value = atomic.read_json(path)
    try:
        viewmats = {
            name: np.array(matrix, np.float64).reshape(4, 4)
            for name, matrix in value["viewmats"].items()}
        if not value["points"]:
            return KnownPoses(viewmats, bool(value["metric"]))
        tensors = load_file(path.with_name(POINTS))
        return KnownPoses(viewmats, bool(value["metric"]), tensors["points"], tensors["colors"])
    except (AttributeError, KeyError, TypeError, ValueError, OSError, SafetensorError) as error:
        raise FormatError(f"{path} holds no poses.", hint=_AGAIN) from error
