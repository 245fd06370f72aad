"""What a data set knows beyond its images: poses in poses.json, points in points.safetensors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from recon_cli import atomic
from recon_cli.errors import FormatError

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
