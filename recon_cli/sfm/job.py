"""What the mapping process and its parent share: the job, its steps, the events.

The parent writes a job; the process records each finished step, and reports one JSON object a line
on its standard output: a phase begins, so many of its units are done, or an error.
"""

from __future__ import annotations

import dataclasses
import json
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, ClassVar

from recon_cli.errors import (
    ConfigError,
    FormatError,
    ManifestError,
    ReconError,
    SfmError,
    WorkspaceError,
)
from recon_cli.scene.camera import Lens
from recon_cli.workspace import atomic, durable, layout
from recon_cli.workspace.json_record import JsonRecord
from recon_cli.workspace.steps import StepFolder

VERDICT = "verdict.json"  # in the stage's folder: whether the model can be trusted
DATABASE = "database.db"  # in the stage's folder: COLMAP's, of features and matches
LOCK = "worker.lock"  # in the stage's folder: one mapping process at a time
CLIP_SECONDS = 1e6  # from the start of a clip to that of the next, in the times of a job
STEPS = ("features", "matches", "model")
SPLIT = "split"  # a step after the matches where a view graph is cut into segments
ORDER = (*STEPS[:2], SPLIT, *STEPS[2:])  # each builds on those before it


@dataclass(frozen=True)
class CameraGroup(JsonRecord):
    """Frames that share one camera."""

    names: tuple[str, ...]  # sorted
    width: int
    height: int
    focal_px: float | None = None  # a guess
    lens: Lens | None = None  # known intrinsics
    model: str = "auto"  # of COLMAP, to be estimated where they are not known


@dataclass(frozen=True)
class MappingJob(JsonRecord):
    """One run of the mapping process; see `SfmConfig` for the options."""

    frames: Path  # folder of the original frames; features are found in these
    out: Path  # the stage's folder
    groups: tuple[CameraGroup, ...]
    masks: Path | None  # folder of masks under the names of the frames; 0 is ignored
    poses: Path | None  # file of known poses, see `KnownPoses`
    pose_use: str
    given_points: bool  # the file of poses has points
    pairs: str
    max_features: int
    min_registered: float
    accept_weak: bool
    partial: bool
    max_minutes: float
    seed: int
    threads: int
    sharpness: Mapping[str, float]  # by name, where known
    times: Mapping[str, float]  # presentation times in seconds by name, where known
    tracks: Path | None = None  # file of tracks through a video, see `io.tracks`
    matches_db: Path | None = None  # database to map from, where it is not that of the features
    # names of the frames of each segment that was mapped apart, in folders of `segments`
    segments: tuple[tuple[str, ...], ...] = ()
    split: int = 0  # segments to cut the view graph into; none where 0
    is_segment: bool = False  # of a longer capture
    last: str = STEPS[-1]  # the last step to take
    # after which a model that can be trusted is not sought to be improved; None: --max-minutes
    spare_minutes: float | None = None

    def after(self, minutes: float) -> MappingJob:
        """Returns the job with the time that is left after so many minutes."""
        spare = self.spare_minutes
        return dataclasses.replace(
            self, max_minutes=self.max_minutes - minutes,
            spare_minutes=None if spare is None else max(0.0, spare - minutes))

    @property
    def names(self) -> tuple[str, ...]:
        """File names of all frames, sorted."""
        return tuple(sorted(name for group in self.groups for name in group.names))

    @property
    def panoramas(self) -> frozenset[str]:
        """File names of the frames that show all directions."""
        return frozenset(name for group in self.groups
                         if group.lens is not None and group.lens.is_panorama
                         for name in group.names)

    @property
    def unknown_lenses(self) -> tuple[int, ...]:
        """The cameras, by number in the database, whose intrinsics are estimated alone here.

        None in a segment: segments are joined by the intrinsics that all have.
        """
        return () if self.is_segment else tuple(
            number for number, group in enumerate(self.groups, 1) if group.lens is None)

    @property
    def database(self) -> Path:
        """COLMAP's database of features and matches."""
        return self.matches_db or self.out / DATABASE

    @property
    def parts(self) -> Path:
        """The models of the parts of the capture by number, in the mapper's own frame."""
        return self.out / "parts"

    @property
    def model(self) -> Path:
        """The model of the part that shows most."""
        return self.parts / "1"

    @property
    def attempts(self) -> Path:
        """Models of the mappers that were tried, until one of them is the result."""
        return self.out / "rungs"

    @property
    def tried(self) -> StepFolder:
        """The attempts that were made with the features and matches that are there."""
        return StepFolder(self.attempts, key=StepFolder(self.out).digest("features", "matches"))

    def segment(self, index: int) -> Path:
        """The folder of a segment, laid out as that of the stage."""
        return self.out / "segments" / str(index)

    @property
    def known_poses(self) -> bool:
        """Whether the cameras are given."""
        return self.poses is not None and self.pose_use != "ignore"

    @property
    def steps(self) -> tuple[str, ...]:
        """Those of `STEPS` that this job takes; known cameras and points need no features."""
        keep = self.known_poses and self.pose_use == "keep"
        if keep and self.given_points and all(group.lens for group in self.groups):
            return STEPS[-1:]
        steps = [step for step in ORDER if step != SPLIT or self.split]
        return tuple(steps[:steps.index(self.last) + 1])

    def write(self, path: Path) -> None:
        """Writes the job for the mapping process."""
        atomic.write_json(path, self.to_json())

    @classmethod
    def read(cls, path: Path) -> MappingJob:
        """Returns the job that `write` wrote; raises FormatError for any other file."""
        try:
            return cls.from_json(atomic.read_json(path, dict))
        except ManifestError as error:
            raise FormatError(
                f"{path} is not a mapping job: {error.message}.",
                hint="Give one of those that sfm writes for segments.") from error


@dataclass(frozen=True)
class PlaceJob(JsonRecord):
    """One part of a capture, to be moved into the world frame and undistorted."""

    steps: ClassVar = ("undistorted",)  # which leaves a `PlacedPart`

    frames: Path  # folder of the original frames
    denoised: Path  # folder of their denoised twins, under the same names
    masks: Path | None  # folder of masks under the names of the frames
    models: Path  # folder of the models of the parts by number, in the mapper's own frame
    out: Path  # the stage's folder
    parts: tuple[tuple[str, ...], ...]  # names of the frames of each part; 1 shows most
    poses: Path | None  # file of known poses, where they were used
    pose_use: str  # how they were, see `PosesSummary`
    part: int
    gravity: bool
    scale_between: tuple[str, str, float] | None
    held_out: tuple[str, ...]  # names of the frames of which no point may come
    accept_weak: bool
    threads: int

    @property
    def names(self) -> tuple[str, ...]:
        """File names of the frames that are placed, sorted."""
        return self.parts[self.part - 1]


def publish(folder: Path, target: Path) -> None:
    """Moves a finished folder to its place, replacing what an interrupted run left there."""
    for path in folder.rglob("*"):
        if path.is_file():
            durable.flush(path)
    layout.remove(target)
    folder.rename(target)
    atomic.sync_folder(target.parent)


def fresh_folder(folder: Path) -> Path:
    """Returns `folder`, made anew and empty."""
    layout.remove(folder)
    folder.mkdir(parents=True)
    return folder


_ERRORS: dict[str, type[ReconError]] = {
    kind.__name__: kind for kind in (SfmError, ConfigError, FormatError, WorkspaceError)}


@dataclass(frozen=True)
class Phase:
    """A phase of the work begins."""

    name: str  # "features", "skeleton", "matches", "mapping" or "undistorted"
    total: int  # units of work
    done: int  # those that an interrupted run had done


# A number is that of the finished units of the current phase, a text a notice for the user; an
# error ends the process.
Event = Phase | int | str | ReconError | OSError


class Reporter:
    """Writes events on a binary stream that the parent reads."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._sending = threading.Lock()

    def phase(self, name: str, total: int, *, done: int = 0) -> None:
        """Reports that a phase begins; see `Phase`."""
        self._send({"phase": name, "total": total, "done": done})

    def done(self, count: int) -> None:
        """Reports how many units of the phase are done."""
        self._send({"count": count})

    def tell(self, text: str) -> None:
        """Passes a notice for the user."""
        self._send({"notice": text})

    def fail(self, error: ReconError | OSError) -> None:
        """Passes an error to the parent."""
        if isinstance(error, OSError):
            self._send({"errno": error.errno, "text": error.strerror, "file": error.filename})
        else:
            self._send(
                {"error": type(error).__name__, "message": error.message, "hint": error.hint})

    def _send(self, value: dict[str, object]) -> None:
        with self._sending:
            self._stream.write(json.dumps(value).encode() + b"\n")
            self._stream.flush()


def parse(line: bytes) -> Event:
    """Returns the event that `Reporter` wrote as one line."""
    value = atomic.parse_json(line)
    if "phase" in value:
        return Phase(value["phase"], value["total"], value["done"])
    if "count" in value:
        return int(value["count"])
    if "notice" in value:
        return str(value["notice"])
    if "errno" in value:
        return OSError(value["errno"], value["text"], value["file"])
    return _ERRORS[value["error"]](value["message"], hint=value["hint"])
