"""What the mapping process is told to do, as a file that both sides read the same way."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from recon_cli import atomic
from recon_cli.scene.lens import Lens

LOCK = "worker.lock"  # in the stage's folder: one mapping process at a time

# Exhaustive matching grows with the square: 4950 pairs of 100 images are about a minute on two
# cores at 600x340 and still the whole graph, so that a walk around a room closes.
EXHAUSTIVE_MAX = 100
# COLMAP's default. With the quadratic overlap an image also meets those 16, 32, ... 512 further.
SEQUENTIAL_OVERLAP = 10


@dataclass(frozen=True)
class CameraGroup:
    """Frames that share one camera.

    Attributes:
        names: file names of its frames, sorted.
        width: of its frames in pixels.
        height: of its frames in pixels.
        focal_px: focal length in pixels where a guess is known.
        lens: intrinsics where they are known.
    """

    names: tuple[str, ...]
    width: int
    height: int
    focal_px: float | None = None
    lens: Lens | None = None


@dataclass(frozen=True)
class Job:
    """One run of the mapping process.

    Attributes:
        frames: folder of the original frames; features are found in these.
        denoised: folder of their denoised twins, under the same names.
        out: the stage's folder; database, model and undistorted images go there.
        groups: the frames by camera.
        masks: folder of masks under the names of the frames (0 where a pixel is ignored), None
            where no frame has one.
        poses: file of known poses (see `io.poses`), None where there are none.
        pose_use: "keep", "refine" or "ignore" them.
        pairs: "auto", "exhaustive" or "sequential".
        max_features: SIFT keypoints an image to aim for.
        min_registered: share of the frames that must get a camera.
        seed: of every random sampling.
        threads: for features, matching and undistortion.
    """

    frames: Path
    denoised: Path
    out: Path
    groups: tuple[CameraGroup, ...]
    masks: Path | None
    poses: Path | None
    pose_use: str
    pairs: str
    max_features: int
    min_registered: float
    seed: int
    threads: int

    @property
    def names(self) -> tuple[str, ...]:
        """File names of all frames, sorted."""
        return tuple(sorted(name for group in self.groups for name in group.names))

    @property
    def database(self) -> Path:
        """COLMAP's database of features and matches."""
        return self.out / "database.db"

    @property
    def undistorting(self) -> Path:
        """Where undistorted images are gathered until all of them are there."""
        return self.out / "undistorted.partial"

    @property
    def exhaustive(self) -> bool:
        """Whether each image is matched with every other one."""
        if self.pairs == "auto":
            return len(self.names) <= EXHAUSTIVE_MAX
        return self.pairs == "exhaustive"

    @property
    def pair_count(self) -> int:
        """How many image pairs are matched."""
        count = len(self.names)
        if self.exhaustive:
            return count * (count - 1) // 2
        near = range(1, SEQUENTIAL_OVERLAP + 1)
        far = (2**power for power in range(SEQUENTIAL_OVERLAP))
        return sum(max(0, count - step) for step in {*near, *far})

    def write(self, path: Path) -> None:
        """Writes the job for the mapping process."""
        atomic.write_json(path, {
            name: str(value) if isinstance(value, Path) else value
            for name, value in dataclasses.asdict(self).items()
        })

    @classmethod
    def read(cls, path: Path) -> Job:
        """Returns the job that `write` wrote."""
        value: dict[str, Any] = atomic.read_json(path)
        for name in ("frames", "denoised", "out", "masks", "poses"):
            value[name] = None if value[name] is None else Path(value[name])
        return cls(**{**value, "groups": tuple(map(_group, value["groups"]))})


def _group(value: dict[str, Any]) -> CameraGroup:
    lens = value["lens"]
    return CameraGroup(**{
        **value, "names": tuple(value["names"]),
        "lens": None if lens is None else Lens(**{**lens, "params": tuple(lens["params"])})})
