"""What the mapping process says to its parent: one JSON object a line.

A line is one of three: a phase begins, so many of its units are done, or an error that the parent
shall raise in its own name.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from recon_cli.errors import ConfigError, FormatError, ReconError, SfmError, WorkspaceError
from recon_cli.scene.camera import Lens
from recon_cli.sfm.step_log import STEPS
from recon_cli.workspace import atomic

VERDICT = "verdict.json"  # in the stage's folder: whether the model can be trusted
RUNGS = "rungs"  # in the stage's folder: what is needed only until there is a model
LOCK = "worker.lock"  # in the stage's folder: one mapping process at a time

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
        given_points: the file of poses comes with points.
        pairs: "auto", "exhaustive", "retrieval" or "sequential".
        max_features: SIFT keypoints that an image keeps at most.
        min_registered: share of the frames that must get a camera.
        accept_weak: a model with a weak link is taken too.
        gravity: the world is turned upright where there is evidence for up.
        scale_between: two places and their distance in metres (see `mapping.measure`), None where
            the scale is not known.
        max_minutes: after which the parent ends the process; further rungs of the ladder are begun
            only where they are expected to fit in.
        seed: of every random sampling.
        threads: for features, matching and undistortion.
        sharpness: of frames by name, where it is known (see `capture.frames`).
        times: of showing in seconds by name, where they are known.
    """

    frames: Path
    denoised: Path
    out: Path
    groups: tuple[CameraGroup, ...]
    masks: Path | None
    poses: Path | None
    pose_use: str
    given_points: bool
    pairs: str
    max_features: int
    min_registered: float
    accept_weak: bool
    gravity: bool
    scale_between: tuple[str, str, float] | None
    max_minutes: float
    seed: int
    threads: int
    sharpness: Mapping[str, float]
    times: Mapping[str, float]

    @property
    def names(self) -> tuple[str, ...]:
        """File names of all frames, sorted."""
        return tuple(sorted(name for group in self.groups for name in group.names))

    @property
    def database(self) -> Path:
        """COLMAP's database of features and matches."""
        return self.out / "database.db"

    @property
    def model(self) -> Path:
        """The model in the mapper's own frame."""
        return self.out / "model"

    @property
    def rungs(self) -> Path:
        """Where models are gathered until one of them is kept."""
        return self.out / RUNGS

    @property
    def undistorting(self) -> Path:
        """Where undistorted images are gathered until all of them are there."""
        return self.out / "undistorted.partial"

    @property
    def known_poses(self) -> bool:
        """Whether the cameras are given and not to be found."""
        return self.poses is not None and self.pose_use != "ignore"

    @property
    def steps(self) -> tuple[str, ...]:
        """The steps of `ledger.STEPS` that this job takes."""
        kept = self.known_poses and self.pose_use == "keep"
        if kept and self.given_points and all(group.lens for group in self.groups):
            return ("model", "sparse", "undistorted")  # nothing is left to be found in the pixels
        return STEPS

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
        measured = value["scale_between"]
        return cls(**{
            **value, "groups": tuple(map(_group, value["groups"])),
            "scale_between": None if measured is None else tuple(measured)})


def _group(value: dict[str, Any]) -> CameraGroup:
    lens = value["lens"]
    return CameraGroup(**{
        **value, "names": tuple(value["names"]), "lens": None if lens is None else _lens(lens)})


def _lens(value: dict[str, Any]) -> Lens:
    return Lens(**{**value, "params": tuple(value["params"])})


_ERRORS: dict[str, type[ReconError]] = {
    kind.__name__: kind for kind in (SfmError, ConfigError, FormatError, WorkspaceError)
}


@dataclass(frozen=True)
class Phase:
    """A phase of the work begins.

    Attributes:
        name: "features", "matches", "mapping" or "undistorted".
        total: how many units it has.
        done: how many of them an interrupted run had done.
    """

    name: str
    total: int
    done: int


@dataclass(frozen=True)
class Done:
    """So many units of the current phase are done.

    Attributes:
        count: units, counted from the beginning of the phase.
    """

    count: int


@dataclass(frozen=True)
class Failed:
    """The process gives up.

    Attributes:
        error: what the parent shall raise.
    """

    error: ReconError | OSError


Event = Phase | Done | Failed


class Reporter:
    """The mapping process' end of the line.

    Args:
        stream: binary, read by the parent.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream

    def phase(self, name: str, total: int, *, done: int = 0) -> None:
        """Says that a phase begins; see `Phase`."""
        self._send({"phase": name, "total": total, "done": done})

    def done(self, count: int) -> None:
        """Says how many units of the phase are done."""
        self._send({"count": count})

    def failed(self, error: ReconError | OSError) -> None:
        """Hands an error over."""
        if isinstance(error, OSError):
            self._send({"errno": error.errno, "text": error.strerror, "file": error.filename})
        else:
            self._send(
                {"error": type(error).__name__, "message": error.message, "hint": error.hint})

    def _send(self, value: dict[str, object]) -> None:
        self._stream.write(json.dumps(value).encode() + b"\n")
        self._stream.flush()


def parse(line: bytes) -> Event:
    """Returns the event that `Reporter` wrote as one line."""
    value = json.loads(line)
    if "phase" in value:
        return Phase(value["phase"], value["total"], value["done"])
    if "count" in value:
        return Done(value["count"])
    if "errno" in value:
        return Failed(OSError(value["errno"], value["text"], value["file"]))
    return Failed(_ERRORS[value["error"]](value["message"], hint=value["hint"]))
