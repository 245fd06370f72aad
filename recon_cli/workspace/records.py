"""Records that stages leave for others, besides their summaries.

Ingest writes frames.json, and poses.json with points.safetensors of a data set with poses; import
writes import.json beside the scene. A masked frame has a mask of its name in masks/: 8-bit gray,
255 where a pixel counts, 0 where features, training and scores ignore it.
"""

from __future__ import annotations

import dataclasses
import itertools
import re
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from recon_cli.errors import FormatError, Hint, ManifestError, list_names, name_command
from recon_cli.scene.camera import Lens, make_lens, panorama_lens
from recon_cli.workspace import atomic
from recon_cli.workspace.json_record import JsonRecord

# A frame in a sentence, but not in a path
_FRAME_NAME = re.compile(r"(?<![\w./\\-])[\w.-]+\.png\b")
FOLDER, MASKS, LIST = "frames", "masks", "frames.json"
AGAIN = Hint("ingest", again=True)
POSES, POINTS = "poses.json", "points.safetensors"
_IMPORT = "import.json"
MIN_FRAMES = 3  # of a scene: two cameras have no third one to contradict them


def need_views() -> str:
    """Returns the commands that give an imported scene views."""
    return (f"Run {name_command('ingest CAPTURE')} and {name_command('sfm')} in this workspace, "
            f"then {name_command('import')} again.")


class Confidence(IntEnum):
    """Levels of confidence of a sensor's depth."""

    LOW = 0
    MEDIUM = 1
    HIGH = 2


@dataclass(frozen=True)
class Frame(JsonRecord):
    """One stored frame."""

    name: str  # file name in the folder of frames
    time_seconds: float | None  # presentation time in the video, None for photos and if unknown
    source: str  # name of the file that it came from
    sharpness: float | None  # variance of its Laplacian, None for photos
    held_out: bool  # used for the score, never for training
    group: int = 0  # index of the group of frames that share its intrinsics
    masked: bool = False  # it has a mask of its name in the folder of masks
    # log2 of exposure time, ISO and aperture by EXIF; None if unknown, or developed from RAW
    exposure_ev: float | None = None


@dataclass(frozen=True)
class Group(JsonRecord):
    """Frames that share intrinsics: of one camera with one setting of its lens."""

    name: str  # of their source, for messages
    width: int  # of the stored frames in pixels, as all below
    height: int
    focal_px: float | None = None  # focal length from EXIF, None if unknown
    lens: Lens | None = None  # known intrinsics, None if they are to be estimated


@dataclass(frozen=True)
class FrameList(JsonRecord):
    """The content of frames.json."""

    # kind of the capture: "video", "photos", "mixed", or the layout of a data set with poses
    source: str
    groups: tuple[Group, ...]  # at least one
    frames: tuple[Frame, ...]  # sorted by name

    def write(self, stage: Path) -> None:
        """Writes the list into ingest's folder."""
        value = dataclasses.asdict(self)
        for frame in value["frames"]:
            if frame["exposure_ev"] is None:  # as lists were before there was any
                del frame["exposure_ev"]
        atomic.write_json(stage / LIST, value)

    @property
    def held_out(self) -> frozenset[str]:
        """The names of the frames that are held out for the score."""
        return frozenset(frame.name for frame in self.frames if frame.held_out)

    def find(self, words: Sequence[str]) -> tuple[str, ...]:
        """Returns words in which a photo, alone or before ":u,v", is called as its frame."""
        frames = {photo: name for name, photo in list_photos(self.frames).items()}

        def find(word: str) -> str:
            front, colon, pixel = word.partition(":")
            return frames.get(word) or f"{frames.get(front, front)}{colon}{pixel}"

        return tuple(map(find, words))


def read_frame_list(stage: Path) -> FrameList:
    """Returns the list of frames in ingest's folder; FormatError if it is missing or damaged."""
    value = atomic.read_json(stage / LIST, dict, hint=AGAIN)
    try:
        found = FrameList.from_json(value)
    except ManifestError as error:
        raise FormatError(f"{stage / LIST} is not a list of frames.", hint=AGAIN) from error
    for lens in (group.lens for group in found.groups if group.lens is not None):
        if lens != panorama_lens(lens.width, lens.height):
            make_lens(
                lens.model, lens.width, lens.height, lens.params, "the list of frames")
    if not found.groups or not all(
            0 <= frame.group < len(found.groups) and Path(frame.name).name == frame.name
            for frame in found.frames):
        raise FormatError(
            f"{stage / LIST} is damaged: it names files elsewhere, or groups that are missing.",
            hint=AGAIN)
    return found


def list_photos(frames: Sequence[Frame]) -> dict[str, str]:
    """Returns the name of each photo's own file by that of its frame.

    Frames of a video have none, nor do photos whose name another one has.
    """
    shared = Counter(frame.source for frame in frames)
    return {frame.name: frame.source for frame in frames
            if frame.time_seconds is None and shared[frame.source] == 1}


def name_photos(ingest: Path, *, shown: Callable[[str], str] = str) -> Callable[[str], str]:
    """Returns a function that calls photos in a text by their own names; `ingest` is the folder.

    `shown` returns a name as the text needs it, such as escaped. Apply the function once, and last:
    a photo may be called as the frame of another one is. Without a list of frames the text stays.
    """
    try:
        photos = {name: shown(photo) for name, photo in list_photos(
            read_frame_list(ingest).frames).items()}
    except FormatError:
        return str
    return lambda text: _FRAME_NAME.sub(lambda found: photos.get(found[0], found[0]), text)


def refuse_missing_frames(folder: Path, names: Collection[str], verb: str) -> None:
    """Raises FormatError where a folder of frames, which `verb` wrote, lacks some of them."""
    missing = [name for name in names if not (folder / name).is_file()]
    if missing:
        raise FormatError(
            f"{folder} lacks {len(missing)} of {len(names)} frames: {list_names(missing)}.",
            hint=Hint(verb, again=True))


def describe_stretches(frames: Sequence[Frame], names: Collection[str]) -> list[str]:
    """Returns the runs of frames in a row that have one of these names, with their seconds.

    A run ends with its video; where there are several videos, each is named.
    """
    videos = {frame.source for frame in frames if frame.time_seconds is not None}
    runs = itertools.groupby(frames, key=lambda frame: (
        frame.name in names, frame.source if frame.source in videos else ""))
    stretches = []
    for (named, video), run in runs:
        if not named:
            continue
        stretch = list(run)
        first, last = stretch[0], stretch[-1]
        text = first.name if first is last else f"{first.name} to {last.name}"
        if first.time_seconds is not None and last.time_seconds is not None:
            seconds = (f"{first.time_seconds:.1f}" if first is last
                       else f"{first.time_seconds:.1f} to {last.time_seconds:.1f}")
            text += f" ({seconds} s{f' of {video}' if len(videos) > 1 else ''})"
        stretches.append(text)
    return stretches


# How poses came about: "tracked" by a phone or headset as it moved, which drifts by centimetres and
# a degree over a room; "solved" by bundle adjustment over all images; "exact", rendered.
PoseAccuracy = Literal["tracked", "solved", "exact"]


@dataclass(frozen=True, eq=False)
class KnownPoses:
    """Poses that came with a data set."""

    # [4, 4] float64 world to camera by frame name; OpenCV axes
    viewmats: Mapping[str, NDArray[np.float64]]
    metric: bool  # the world's unit is the metre
    # [P, 3] float64 initial points in the same world, None without points
    points: NDArray[np.float64] | None = None
    colors: NDArray[np.uint8] | None = None  # [P, 3] uint8 RGB of the points
    up: tuple[float, float, float] | None = None  # [3] unit vector in that world, None: not known
    find_up: bool = False  # the axes of that world are arbitrary; else they stay where up is None
    accuracy: PoseAccuracy = "solved"

    def write(self, stage: Path) -> None:
        """Writes both files into ingest's folder."""
        atomic.write_json(stage / POSES, {
            "metric": self.metric, "points": self.points is not None, "up": self.up,
            "find_up": self.find_up, "accuracy": self.accuracy,
            "viewmats": {name: matrix.tolist() for name, matrix in self.viewmats.items()}})
        if self.points is not None and self.colors is not None:
            with atomic.replacing(stage / POINTS) as temporary:
                save_file({"points": np.ascontiguousarray(self.points),
                           "colors": np.ascontiguousarray(self.colors)}, temporary)


def read_poses(path: Path) -> KnownPoses:
    """Returns the poses that `KnownPoses.write` wrote; FormatError if a file is damaged."""
    value = atomic.read_json(path, dict, hint=AGAIN)
    try:
        viewmats = {
            name: np.array(matrix, np.float64).reshape(4, 4)
            for name, matrix in value["viewmats"].items()}
        if not all(np.isfinite(matrix).all() for matrix in viewmats.values()):
            raise ValueError("a pose that is not finite")
        poses = KnownPoses(
            viewmats, bool(value["metric"]), up=_read_up(value.get("up")),
            find_up=bool(value.get("find_up", False)), accuracy=value.get("accuracy", "solved"))
        if poses.accuracy not in get_args(PoseAccuracy):
            raise ValueError("poses of an unknown kind")
        if not value["points"]:
            return poses
        tensors = load_file(path.with_name(POINTS))
        return dataclasses.replace(poses, points=tensors["points"], colors=tensors["colors"])
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError, OSError,
            SafetensorError) as error:
        raise FormatError(f"{path} does not hold poses.", hint=AGAIN) from error


def _read_up(value: Sequence[float] | None) -> tuple[float, float, float] | None:
    if value is None:
        return None
    x, y, z = map(float, value)
    if not abs(x * x + y * y + z * z - 1) < 1e-6:
        raise ValueError("an up that is not a unit vector")
    return x, y, z


def choose_held_out(names: Sequence[str], holdout: tuple[str, float, float]) -> frozenset[str]:
    """Returns which of all frames are held out for the score.

    `holdout` is (kind, a, b) of `config.stages.parse_holdout`: each a-th by name from the first on,
    the share a to b of the names in order, or none.
    """
    ordered = sorted(names)
    kind, a, b = holdout
    if kind == "every":
        return frozenset(ordered[::int(a)])
    if kind == "segment":
        return frozenset(ordered[round(a * len(ordered)):round(b * len(ordered))])
    return frozenset()


def prepare_frames_folder(stage: Path) -> Path:
    """Creates the folder of frames in a stage's folder and clears the rest of a killed run."""
    folder = stage / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    atomic.clear_leftovers(stage)
    return folder


@dataclass(frozen=True)
class ImportRecord(JsonRecord):
    """The record of an imported scene."""

    file: str  # name of the file that it was read from
    format: str  # of the file, by its name in `export_formats`
    sha256: str  # of the file
    gaussians: int  # count
    sh_degree: int  # of the colours
    z_up: bool  # up is z in the file; else it is -y. Given or assumed, never measured
    views: bool  # it was compared with views of this workspace
    doubt: str = ""  # why it may not be in their frame, as a sentence; empty if it fits
    y_up: bool = False  # up is y in the file
    antialiased: bool = False  # the file says that it was trained with antialiasing
    origin: tuple[float, ...] | None = None  # [3] that was subtracted from its positions

    def up(self) -> NDArray[np.float64]:
        """Returns the unit vector [3] that is taken for up where there are no views."""
        return np.array([0.0, 0, 1] if self.z_up else [0.0, 1 if self.y_up else -1, 0])

    def write(self, folder: Path) -> None:
        """Writes it into the folder of the scene."""
        atomic.write_json(folder / _IMPORT, self.to_json())

    def warnings(self) -> list[str]:
        """Returns the caveats of every score of this scene."""
        return [*([self.doubt] if self.doubt else []),
                f"the scene was imported from {self.file}: whoever trained it may have trained on "
                "the held-out views too"]

    @staticmethod
    def read(folder: Path) -> ImportRecord | None:
        """Returns the record of the scene in a folder; None if it was trained here.

        FormatError if the file is damaged, ManifestError if it is of another version.
        """
        path = folder / _IMPORT
        return ImportRecord.from_json(atomic.read_json(path, dict)) if path.exists() else None

