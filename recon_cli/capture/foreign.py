"""One table of the files of other programs that lie beside pictures.

A row holds a description, how the file is recognised, its content and the command to type instead.
What is read as a data set, by `datasets.layouts`, has the name of its layout: it is named where
files of it are missing, or where only its pictures were given.
"""

from __future__ import annotations

import shlex
from collections.abc import Collection, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

_READ = 1 << 23  # bytes of a file that are searched for its marks
_TRIED = 50  # files of a pattern; a capture has thousands of one kind
_LISTED = 0.5  # a text that names this share of the pictures belongs to them
_TEXTS = frozenset({".csv", ".json", ".jsonl", ".tsv", ".txt", ".xml", ".yaml", ".yml"})
_ARRAYS = frozenset({".bin", ".geojson", ".npy", ".npz", ".traj", ".tum"})


@dataclass(frozen=True)
class ForeignLayout:
    """The files of one program or app."""

    words: str  # a description in a sentence
    carries: str  # what would be lost: "poses", "poses and depth"
    patterns: tuple[str, ...]  # of its files below the folder, the first that exists counts
    marks: tuple[bytes, ...] = ()  # all of them are in such a file; none: its name is enough
    # the command that converts it, with {folder} and {file}; empty where there is none
    convert: str = ""
    advice: str = ""  # what else helps, as an end of a sentence
    photos: tuple[str, ...] = ()  # folders with its photos, the best first
    not_photos: tuple[str, ...] = ()  # patterns of pictures that are none of the scene
    video: str = ""  # name of its video
    layout: str = ""  # of `datasets.layouts`, which reads it if it is complete


# In this order; a file that one row has recognised is not looked at for another.
FOREIGN: tuple[ForeignLayout, ...] = (
    ForeignLayout(
        "the raw data of Polycam", "poses and depth",
        tuple(f"{place}{kind}cameras/*.json" for place in ("keyframes/", "")
              for kind in ("corrected_", "")), (b'"t_00"',), layout="polycam",
        photos=tuple(f"{place}{kind}images" for place in ("keyframes/", "")
                     for kind in ("corrected_", "")),
        not_photos=("thumbnail.*", "*/thumbnail.*"), video="polycam.mp4"),
    ForeignLayout(
        "an export of Record3D", "poses and depth",
        ("metadata.json", "metadata", "EXR_RGBD/metadata.json"), (b'"poses"', b'"K"'),
        layout="record3d", photos=("rgb", "rgbd", "EXR_RGBD/rgb"), not_photos=("icon",)),
    ForeignLayout(
        "a recording of Stray Scanner", "poses and depth", ("odometry.csv",), (b"qx",),
        video="rgb.mp4", layout="stray"),
    ForeignLayout(
        "a scan of 3D Scanner App", "poses and depth", ("frame_*.json",),
        (b'"cameraPoseARFrame"',), layout="3dscannerapp",
        not_photos=("depth_*", "conf_*", "thumb_*", "texture*")),
    ForeignLayout(
        "a recording of ARKitScenes", "poses and depth",
        ("lowres_wide.traj", "*_frames/lowres_wide.traj", "*.traj"), layout="arkitscenes",
        photos=tuple(f"{place}{kind}" for kind in ("wide", "vga_wide", "lowres_wide")
                     for place in ("", "*_frames/"))),
    ForeignLayout(
        "an export of RTAB-Map", "poses and depth", ("*camera_poses*.txt", "*_poses.txt"),
        (b"#timestamp",), layout="rtabmap", photos=("*_rgb", "*_left")),
    ForeignLayout(
        "a database of RTAB-Map", "poses and pictures", ("*.db",),
        (b"SQLite format 3", b"CREATE TABLE Node", b"CREATE TABLE Link"),
        "rtabmap-export --images {file}"),
    ForeignLayout(
        "a recording of a Quest headset", "poses, depth and raw pictures",
        ("*_camera_mruk_intrinsics.json", "*_camera_characteristics.json", "hmd_poses.csv"),
        advice="convert it to a COLMAP model with e2e_quest_to_colmap.py of "
        "metaquest-3d-reconstruction", layout="quest"),
    ForeignLayout(
        "the cameras of Agisoft Metashape", "poses", ("*.xml",),
        (b"<document", b"<chunk", b"<camera"), layout="metashape"),
    ForeignLayout(
        "the cameras of RealityScan or RealityCapture", "poses", ("*.csv",),
        (b"name", b"alt", b"heading", b"pitch", b"roll"), layout="realityscan"),
    ForeignLayout(
        "sidecars of RealityScan or RealityCapture", "poses", ("*.xmp", "*/*.xmp"),
        (b"xcr:Rotation",), advice="export the registration in COLMAP's format"),
    ForeignLayout(
        "the cameras of ContextCapture or iTwin Capture", "poses", ("*.xml",),
        (b"<BlocksExchange",)),
    ForeignLayout("cameras in Bundler's format", "poses", ("bundle.out", "*.out", "*/bundle.out"),
                  (b"# Bundle file",), layout="bundler"),
    ForeignLayout("the cameras of an LLFF scene", "poses", ("poses_bounds.npy",), layout="llff"),
    ForeignLayout("the cameras of OpenDroneMap", "poses", ("odm_report/shots.geojson",),
                  layout="opensfm"),
    ForeignLayout(
        "the cameras of OpenSfM or OpenDroneMap", "poses",
        ("reconstruction.json", "opensfm/reconstruction.json", "shots.geojson"), (b"shot",),
        layout="opensfm"),
    ForeignLayout(
        "the cameras of Meshroom", "poses", ("*.sfm", "*/*.sfm"), (b'"views"', b'"poses"'),
        "aliceVision_exportColmap -i {file} -o SCENE"),
    ForeignLayout(
        "the cameras of OpenMVG", "poses", ("sfm_data*.json",), (b'"views"', b'"extrinsics"'),
        "openMVG_main_openMVG2Colmap -i {file} -o SCENE"),
    ForeignLayout("cameras in VisualSFM's format", "poses", ("*.nvm", "*/*.nvm"), (b"NVM_V3",)),
    ForeignLayout(
        "the cameras of Pix4D", "poses", tuple(
            f"{place}*_{kind}.txt" for place in ("", "params/", "*/params/")
            for kind in ("calibrated_external_camera_parameters", "pmatrix"))),
    ForeignLayout("cameras in MVSNet's format", "poses", ("cams/*_cam.txt", "*_cam.txt"),
                  (b"extrinsic",)),
    ForeignLayout(
        "poses as in a transforms.json", "poses", ("*.json", "*/transforms*.json"),
        (b'"transform_matrix"',), advice="recon ingest {file}, once it is called transforms.json"),
    ForeignLayout(
        "a COLMAP model", "poses", tuple(
            f"{'*/' * depth}cameras{suffix}" for depth in (1, 2, 3)
            for suffix in (".bin", ".txt")), advice="recon ingest {parent}"),
    ForeignLayout(
        "camera poses, by its name", "poses", (
            "*pose*.txt", "*pose*.npy", "*pose*.json", "*pose*.csv", "*traj*.txt",
            "*Trajectory*.txt", "groundtruth*.txt", "*.tum", "*odometry*.csv", "*odometry*.txt",
            "cameras.json",
            "cameras*.npz")),
)


@dataclass(frozen=True)
class Found:
    """A row of the table that a folder, or a file, has."""

    row: ForeignLayout
    folder: Path  # that was looked in
    path: Path  # the file that identified it

    @property
    def place(self) -> str:
        """The file, or its folder where it is below the one that was looked in."""
        inner = self.path.relative_to(self.folder)
        return inner.name if len(inner.parts) == 1 else f"{inner.parent.as_posix()}/"

    def advice(self) -> str:
        """Returns a sentence with the command that uses it; empty without one."""
        names = {name: shlex.quote(str(path)) for name, path in (
            ("folder", self.folder), ("file", self.path), ("parent", self.path.parent))}
        steps = []
        if self.row.convert:
            then = ", then `recon ingest SCENE`" * ("SCENE" in self.row.convert)
            steps.append(f"`{self.row.convert.format(**names)}`{then}")
        if self.row.advice:
            steps.append(self.row.advice.format(**names))
        return f"To use them: {', or '.join(steps)}." if steps else ""

    def notice(self, where: Path) -> str:
        """Returns a notice for the user; `where` is the input that they gave."""
        place = self.place if self.folder == where else self.path
        if self.row.layout and self.folder != where:
            whole = shlex.quote(str(self.folder))
            return (f"{place} is {self.row.words}: its {self.row.carries} are not used with "
                    f"these pictures alone; recon ingest {whole} uses them.")
        if self.row.layout:
            return (f"{place} is {self.row.words}, but files that belong to it are missing or in "
                    f"another place: its {self.row.carries} are not read, and the cameras are "
                    "found from the pictures. docs/captures.md lists what belongs to it.")
        return (f"{place} is {self.row.words}: its {self.row.carries} are not read, and "
                f"the cameras are found from the pictures. {self.advice()}").rstrip()


def find_foreign(folder: Path, *, known: Collection[Path] = ()) -> list[Found]:
    """Returns which rows a folder has, each by one file; `known` files are those of a reader."""
    found: list[Found] = []
    seen = set(known)
    for row in FOREIGN:
        for path in _matching(folder, row.patterns):
            if path not in seen and has_marks(path, row.marks):
                found.append(Found(row, folder, path))
                seen.update(_matching(folder, row.patterns))
                break
    return found


def recognise_file(path: Path) -> Found | None:
    """Returns the row that a file by itself has, None for none."""
    named = path.suffix.lower() in _TEXTS | _ARRAYS  # a video may be called odometry.mp4
    rows = (row for row in FOREIGN if row.marks or named)
    return next((Found(row, path.parent, path) for row in rows
                 if any(Path(path.name).match(Path(pattern).name) for pattern in row.patterns)
                 and has_marks(path, row.marks)), None)


def find_lists(folder: Path, names: Sequence[str], *, known: Collection[Path]) -> list[Path]:
    """Returns texts in a folder that no row has and that name at least half of the pictures.

    Whatever they say about the pictures (places, angles, times), nothing here reads it.
    """
    wanted = [name.encode() for name in names if name]
    texts = (path for path in _sorted_files(folder)
             if path.suffix.lower() in _TEXTS and path not in known)
    lists = []
    for path in texts if wanted else ():
        data = _head(path)
        if sum(name in data for name in wanted) >= _LISTED * len(wanted):
            lists.append(path)
    return lists


def has_marks(path: Path, marks: Sequence[bytes]) -> bool:
    """Returns whether a path is a file that holds all of some bytes near its beginning."""
    if not marks:
        return path.is_file()
    data = _head(path)
    return all(mark in data for mark in marks)


def _head(path: Path) -> bytes:
    """Returns the first bytes of a regular file; none where it cannot be read."""
    with suppress(OSError):
        if path.is_file():
            with path.open("rb") as file:
                return file.read(_READ)
    return b""


def _matching(folder: Path, patterns: Iterable[str]) -> list[Path]:
    """Returns the paths below a folder that match a pattern, hidden ones apart."""
    paths: list[Path] = []
    for pattern in patterns:
        with suppress(OSError):
            paths += [path for path in islice(sorted(folder.glob(pattern)), _TRIED)
                      if not any(part[0] == "." for part in path.relative_to(folder).parts)]
    return list(dict.fromkeys(paths))


def _sorted_files(folder: Path) -> list[Path]:
    with suppress(OSError):
        return sorted(path for path in folder.iterdir()
                      if path.name[0] != "." and path.is_file())
    return []
