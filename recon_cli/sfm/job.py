"""What the mapping process and its parent share: the job, the log of finished steps, the events.

The parent writes a job; the process records each finished step, and reports one JSON object a line
on its standard output: a phase begins, so many of its units are done, or an error.
"""

from __future__ import annotations

import dataclasses
import json
import os
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

from recon_cli.errors import (
    ConfigError,
    FormatError,
    ManifestError,
    ReconError,
    SfmError,
    WorkspaceError,
)
from recon_cli.scene.camera import Lens
from recon_cli.workspace import atomic, layout
from recon_cli.workspace.digests import sha256_json
from recon_cli.workspace.journal import crc32
from recon_cli.workspace.json_record import JsonRecord

VERDICT = "verdict.json"  # in the stage's folder: whether the model can be trusted
DATABASE = "database.db"  # in the stage's folder: COLMAP's, of features and matches
LOCK = "worker.lock"  # in the stage's folder: one mapping process at a time
POLL_SECONDS = 0.25  # between looks at what native code has done
CLIP_SECONDS = 1e6  # from the start of a clip to that of the next, in the times of a job
LOG_FILE = "steps.json"  # in the stage's folder: the finished steps
STEPS = ("features", "matches", "model", "sparse", "undistorted")
SPLIT = "split"  # a step after the matches where a view graph is cut into segments
_SELF = "self"  # in the log, beside the steps: its own checksum
_ORDER = (*STEPS[:2], SPLIT, *STEPS[2:])


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
    denoised: Path  # folder of their denoised twins, under the same names
    out: Path  # the stage's folder
    groups: tuple[CameraGroup, ...]
    masks: Path | None  # folder of masks under the names of the frames; 0 is ignored
    poses: Path | None  # file of known poses, see `io.posed`
    pose_use: str
    given_points: bool  # the file of poses has points
    pairs: str
    max_features: int
    min_registered: float
    accept_weak: bool
    partial: bool
    gravity: bool
    scale_between: tuple[str, str, float] | None
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
    part: int = 1  # of the capture, which is placed; 1 shows most
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
        return () if self.last == "model" else tuple(
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
            return ("model", "sparse", "undistorted")
        steps = [step for step in _ORDER if step != SPLIT or self.split]
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


Record = TypeVar("Record", bound=JsonRecord)


class StepLog:
    """The finished steps in the stage's folder, or in one in it; written after every change."""

    def __init__(self, out: Path) -> None:
        self._out = out
        self._steps: dict[str, dict[str, Any]] = {}
        try:
            steps = atomic.read_json(out / LOG_FILE, dict)
        except FormatError:
            return  # the first run, or a lost file: every step is done again
        if steps.pop(_SELF, None) == sha256_json(steps):
            self._steps = steps

    def is_finished(self, step: str) -> bool:
        """Returns whether a step was finished and its files are all there."""
        entry = self._steps.get(step)
        return entry is not None and all(
            (self._out / name).is_file() and (self._out / name).stat().st_size == size
            for name, (size, _) in entry["files"].items())

    def result(self, step: str, kind: type[Record]) -> Record | None:
        """Returns the recorded result of a finished step, else None, as for another version's."""
        if not self.is_finished(step):
            return None
        try:
            return kind.from_json(self._steps[step]["result"])
        except ManifestError:
            return None

    def finish(
        self, step: str, result: JsonRecord, folder: Path | None = None, also: Sequence[str] = ()
    ) -> None:
        """Records a step as finished, with its result and the files in the `folder` it wrote.

        `also` are names of files that it wrote besides, where they are there.
        """
        besides = [path for path in (self._out / name for name in also) if path.is_file()]
        files = digest_files(self._out, [*(() if folder is None else _files(folder)), *besides])
        self._steps[step] = {"result": result.to_json(), "files": files}
        self._write()

    def find_damage(self) -> str | None:
        """Returns the first finished step with a file that was damaged since; None without one."""
        for step, entry in self._steps.items():
            names = [self._out / name for name in entry["files"]]
            if not self.is_finished(step) or digest_files(self._out, names) != entry["files"]:
                return step
        return None

    def forget_from(self, step: str) -> None:
        """Removes a step and all that build on it."""
        for name in _ORDER[_ORDER.index(step):]:
            self._steps.pop(name, None)
        self._write()

    def files(self, step: str) -> list[str]:
        """Returns the names of the files of a finished step; none if it is not finished."""
        return list(self._steps.get(step, {}).get("files", ()))

    def copy_to(self, out: Path, last: str, result: JsonRecord) -> None:
        """Writes the steps up to `last`, with another result of it, to a folder with their files.
        """
        names = [name for name in _ORDER[:_ORDER.index(last) + 1] if name in self._steps]
        other = StepLog(out)
        other._steps = {name: self._steps[name] for name in names}
        other._steps[last] = {**self._steps[last], "result": result.to_json()}
        other._write()

    def _write(self) -> None:
        atomic.write_json(
            self._out / LOG_FILE, {**self._steps, _SELF: sha256_json(self._steps)})


def digest_files(out: Path, paths: Iterable[Path]) -> dict[str, list[int]]:
    """Returns the size and CRC-32 of files by their names relative to `out`."""
    return {path.relative_to(out).as_posix(): [path.stat().st_size, crc32(path)] for path in paths}


def vouch(folder: Path) -> None:
    """Writes the digests of the files of a finished folder beside it."""
    atomic.write_json(_vouchers(folder), digest_files(folder, _files(folder)))


def is_vouched(folder: Path) -> bool:
    """Returns whether a folder is as it was finished."""
    try:
        digests = atomic.read_json(_vouchers(folder), dict)
    except FormatError:
        return False
    return folder.is_dir() and digests == digest_files(folder, _files(folder))


def _vouchers(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}.digests.json")


def publish(folder: Path, target: Path) -> None:
    """Moves a finished folder to its place, replacing what an interrupted run left there."""
    for path in _files(folder):
        with path.open("rb+") as file:
            os.fsync(file.fileno())
    layout.remove(target)
    folder.rename(target)
    atomic.sync_folder(target.parent)


def fresh_folder(folder: Path) -> Path:
    """Returns `folder`, made anew and empty."""
    layout.remove(folder)
    folder.mkdir(parents=True)
    return folder


def _files(folder: Path) -> Iterator[Path]:
    """Yields the files below a folder in a fixed order."""
    return (path for path in sorted(folder.rglob("*")) if path.is_file())


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
