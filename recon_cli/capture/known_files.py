"""What files and folders hold that are no pictures of the scene, by names and first bytes.

One table has a row for what other programs leave beside pictures: a description, how it is
recognised, what it carries, and the command to type instead. What is read as a data set, by
`datasets.layouts`, has the name of its layout: it is named where files of it are missing, or where
only its pictures were given. Whatever lacks the file of its poses is refused, rather than read as
mere photos.

Archives, texts and scenes are known because FFmpeg would find a video in many of them: the first
picture of an uncompressed .zip, or the letters of a text.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Collection, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from recon_cli.capture.images import PHOTO_SUFFIXES
from recon_cli.errors import FormatError, InputError, command_line, name_command
from recon_cli.workspace.export_formats import READABLE

_READ = 1 << 23  # bytes of a file that are searched for its marks
_TRIED = 50  # files of a pattern; a capture has thousands of one kind
_TEXTS = frozenset({".csv", ".json", ".jsonl", ".tsv", ".txt", ".xml", ".yaml", ".yml"})
_ARRAYS = frozenset({".bin", ".geojson", ".npy", ".npz", ".traj", ".tum"})
# First bytes, their offset, and the command that unpacks such a file into a folder.
_UNPACK = "mkdir -p {folder} && {command} && {ingest}"
_SIGNATURES: tuple[tuple[bytes, int, str], ...] = (
    (b"PK\x03\x04", 0, "unzip {file} -d {folder}"),
    (b"PK\x05\x06", 0, "unzip {file} -d {folder}"),
    (b"7z\xbc\xaf\x27\x1c", 0, "7z x {file} -o{folder}"),
    (b"Rar!\x1a\x07", 0, "unrar x {file} {folder}/"),
    (b"ustar", 257, "tar -xf {file} -C {folder}"),
    (b"\x1f\x8b", 0, "tar -xf {file} -C {folder}"),
    (b"BZh", 0, "tar -xf {file} -C {folder}"),
    (b"\xfd7zXZ\0", 0, "tar -xf {file} -C {folder}"),
    (b"\x28\xb5\x2f\xfd", 0, "tar -xf {file} -C {folder}"),
)
_MESHES = frozenset({".glb", ".gltf", ".obj", ".fbx", ".usdz", ".stl", ".las", ".laz", ".e57"})
_DATA = frozenset({
    ".bin", ".cfg", ".csv", ".db", ".exr", ".geojson", ".html", ".ini", ".json", ".jsonl", ".log",
    ".md", ".npy", ".npz", ".nvm", ".out", ".pdf", ".pkl", ".pt", ".pth", ".py", ".safetensors",
    ".sfm", ".toml", ".traj", ".tsv", ".txt", ".xml", ".xmp", ".yaml", ".yml"})
_SCENES = frozenset(Path(row.file).suffix for row in READABLE) - _MESHES - _DATA
_KINDS = {
    "masks": "masks?",
    "depth maps": "depths?|depthmaps?|disparity|disparities|disp",
    "confidence maps": "confidences?|conf",
    "normal maps": "normals?",
    "labels": "semantics?|segmentations?|segs?|labels?|instances?",
    "small copies": "thumbs?|thumbnails?|previews?",
}
_NAMES = {kind: re.compile(rf"(?:^|[^a-z])(?:{words})(?:$|[^a-z])", re.IGNORECASE)
          for kind, words in _KINDS.items()}


@dataclass(frozen=True)
class LostFiles:
    """A capture without the file of its poses, as patterns below its folder."""

    marks: tuple[str, ...]  # all of them show the program
    lacks: tuple[str, ...]  # one of which it needs
    pictures: str = ""  # what to give to find the cameras from the pictures


@dataclass(frozen=True)
class KnownFiles:
    """The files of one program or app."""

    words: str  # a description in a sentence
    carries: str = "poses"  # what would be lost
    patterns: tuple[str, ...] = ()  # of its files below the folder, the first that exists counts
    marks: tuple[bytes, ...] = ()  # all of them are in such a file; none: its name is enough
    # the command that converts it, with {folder} and {file}; empty where there is none
    convert: str = ""
    advice: str = ""  # what else helps, as an end of a sentence
    photos: tuple[str, ...] = ()  # folders with its photos, the best first
    not_photos: tuple[str, ...] = ()  # patterns of pictures that are none of the scene
    video: str = ""  # name of its video
    layout: str = ""  # of `datasets.layouts`, which reads it if it is complete
    lost: tuple[LostFiles, ...] = ()  # what shows that it is not complete


_POLYCAM_CAMERAS = ("keyframes/cameras", "keyframes/corrected_cameras")
_MODELS = ("undistorted/sparse", *(f"{place}{inner}" for place in (
    "sparse", "sparse_text", "colmap/sparse") for inner in ("/0", "")), ".")
# In this order; a file that one row has recognised is not looked at for another.
KNOWN_FILES: tuple[KnownFiles, ...] = (
    KnownFiles(
        "the raw data of Polycam", "poses and depth",
        tuple(f"{place}{kind}cameras/*.json" for place in ("keyframes/", "")
              for kind in ("corrected_", "")), (b'"t_00"',), layout="polycam",
        photos=tuple(f"{place}{kind}images" for place in ("keyframes/", "")
                     for kind in ("corrected_", "")),
        not_photos=("thumbnail.*", "*/thumbnail.*"), video="polycam.mp4",
        lost=(LostFiles(("keyframes/images", "keyframes/depth"), _POLYCAM_CAMERAS,
                        "keyframes/images"),
              LostFiles(("keyframes/corrected_images",), _POLYCAM_CAMERAS,
                        "keyframes/corrected_images"))),
    KnownFiles(
        "an export of Record3D", "poses and depth",
        ("metadata.json", "metadata", "EXR_RGBD/metadata.json"), (b'"poses"', b'"K"'),
        layout="record3d", photos=("rgb", "rgbd", "EXR_RGBD/rgb"), not_photos=("icon",),
        lost=(LostFiles(("rgbd/*.depth",), ("metadata",), "rgbd"),
              *(LostFiles((f"{place}rgb", f"{place}depth/*.exr"), (f"{place}metadata.json",),
                          f"{place}rgb") for place in ("", "EXR_RGBD/")))),
    KnownFiles(
        "a recording of Stray Scanner", "poses and depth", ("odometry.csv",), (b"qx",),
        video="rgb.mp4", layout="stray",
        lost=(LostFiles(("rgb.mp4", "confidence/*.png"), ("odometry.csv",), "rgb.mp4"),
              LostFiles(("rgb.mp4", "camera_matrix.csv"), ("odometry.csv",), "rgb.mp4"),
              LostFiles(("odometry.csv", "camera_matrix.csv"), ("rgb.mp4",)))),
    KnownFiles("a capture of NeRFCapture", lost=(
        LostFiles(("images/*.depth.png",), ("transforms.json",), "images"),)),
    KnownFiles(
        "a scan of 3D Scanner App", "poses and depth", ("frame_*.json",),
        (b'"cameraPoseARFrame"',), layout="3dscannerapp",
        not_photos=("depth_*", "conf_*", "thumb_*", "texture*"),
        lost=(LostFiles(("frame_*.jpg", "depth_*.png", "conf_*.png"), ("frame_*.json",),
                        "frame_*.jpg"),)),
    KnownFiles(
        "a recording of ARKitScenes", "poses and depth",
        ("lowres_wide.traj", "*_frames/lowres_wide.traj", "*.traj"), layout="arkitscenes",
        photos=tuple(f"{place}{kind}" for kind in ("wide", "vga_wide", "lowres_wide")
                     for place in ("", "*_frames/")),
        lost=tuple(LostFiles(
            (f"{place}lowres_wide", f"{place}lowres_depth"), (f"{place}lowres_wide.traj",),
            f"{place}lowres_wide") for place in ("", "*_frames/"))),
    KnownFiles(
        "an export of RTAB-Map", "poses and depth", ("*camera_poses*.txt", "*_poses.txt"),
        (b"#timestamp",), layout="rtabmap", photos=("*_rgb", "*_left"),
        lost=(LostFiles(("*_rgb", "*_calib/*.yaml"), ("*_poses*.txt",), "*_rgb"),)),
    KnownFiles(
        "a database of RTAB-Map", "poses and pictures", ("*.db",),
        (b"SQLite format 3", b"CREATE TABLE Node", b"CREATE TABLE Link"),
        "rtabmap-export --images {file}"),
    KnownFiles(
        "a recording of a Quest headset", "poses, depth and raw pictures",
        ("*_camera_mruk_intrinsics.json", "*_camera_characteristics.json", "hmd_poses.csv"),
        advice="convert it to a COLMAP model with e2e_quest_to_colmap.py of "
        "metaquest-3d-reconstruction", layout="quest",
        lost=(LostFiles(("*_camera_mruk_rgba",), ("*_camera_mruk_frame_metadata.csv",)),)),
    KnownFiles(
        "the cameras of Agisoft Metashape", "poses", ("*.xml",),
        (b"<document", b"<chunk", b"<camera"), layout="metashape"),
    KnownFiles(
        "the cameras of RealityScan or RealityCapture", "poses", ("*.csv",),
        (b"name", b"alt", b"heading", b"pitch", b"roll"), layout="realityscan"),
    KnownFiles(
        "sidecars of RealityScan or RealityCapture", "poses", ("*.xmp", "*/*.xmp"),
        (b"xcr:Rotation",), advice="export the registration in COLMAP's format"),
    KnownFiles(
        "the cameras of ContextCapture or iTwin Capture", "poses", ("*.xml",),
        (b"<BlocksExchange",)),
    KnownFiles("cameras in Bundler's format", "poses", ("bundle.out", "*.out", "*/bundle.out"),
                  (b"# Bundle file",), layout="bundler"),
    KnownFiles("the cameras of an LLFF scene", "poses", ("poses_bounds.npy",), layout="llff"),
    KnownFiles("the cameras of OpenDroneMap", "poses", ("odm_report/shots.geojson",),
                  layout="opensfm"),
    KnownFiles(
        "the cameras of OpenSfM or OpenDroneMap", "poses",
        ("reconstruction.json", "opensfm/reconstruction.json", "shots.geojson"), (b"shot",),
        layout="opensfm"),
    KnownFiles(
        "the cameras of Meshroom", "poses", ("*.sfm", "*/*.sfm"), (b'"views"', b'"poses"'),
        "aliceVision_exportColmap -i {file} -o SCENE"),
    KnownFiles(
        "the cameras of OpenMVG", "poses", ("sfm_data*.json",), (b'"views"', b'"extrinsics"'),
        "openMVG_main_openMVG2Colmap -i {file} -o SCENE"),
    KnownFiles("cameras in VisualSFM's format", "poses", ("*.nvm", "*/*.nvm"), (b"NVM_V3",)),
    KnownFiles(
        "the cameras of Pix4D", "poses", tuple(
            f"{place}*_{kind}.txt" for place in ("", "params/", "*/params/")
            for kind in ("calibrated_external_camera_parameters", "pmatrix"))),
    KnownFiles("cameras in MVSNet's format", "poses", ("cams/*_cam.txt", "*_cam.txt"),
                  (b"extrinsic",)),
    KnownFiles(
        "poses as in a transforms.json", "poses", ("*.json", "*/transforms*.json"),
        (b'"transform_matrix"',), advice="{ingest_file}, once it is called transforms.json"),
    KnownFiles(
        "a COLMAP model", "poses", tuple(
            f"{'*/' * depth}cameras{suffix}" for depth in (1, 2, 3)
            for suffix in (".bin", ".txt")), advice="{ingest_parent}",
        lost=tuple(LostFiles(
            (f"{place}/{part}.{kind}",), (f"{place}/cameras.{kind}",), "images")
            for place in _MODELS for part in ("images", "frames") for kind in ("bin", "txt"))),
    KnownFiles("a Replica sequence", lost=(
        LostFiles(("results/frame[0-9]*", "results/depth[0-9]*"), ("traj.txt",),
                  "results/frame*"),)),
    KnownFiles("a 7-Scenes sequence", lost=(
        LostFiles(("frame-*.color.*", "frame-*.depth.*"), ("frame-*.pose.txt",),
                  "frame-*.color.*"),)),
    KnownFiles("a TUM RGB-D sequence", lost=(
        LostFiles(("rgb", "depth", "rgb.txt"), ("groundtruth.txt",), "rgb"),)),
    KnownFiles(
        "camera poses, by its name", "poses", (
            "*pose*.txt", "*pose*.npy", "*pose*.json", "*pose*.csv", "*traj*.txt",
            "*Trajectory*.txt", "groundtruth*.txt", "*.tum", "*odometry*.csv", "*odometry*.txt",
            "cameras.json",
            "cameras*.npz")),
)


@dataclass(frozen=True)
class Found:
    """A row of the table that a folder, or a file, has."""

    row: KnownFiles
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
        names |= {f"ingest_{name}": command_line(f"ingest {path}") for name, path in names.items()}
        steps = []
        if self.row.convert:
            then = f", then {name_command('ingest SCENE')}" * ("SCENE" in self.row.convert)
            steps.append(f"`{self.row.convert.format(**names)}`{then}")
        if self.row.advice:
            steps.append(self.row.advice.format(**names))
        return f"To use them: {', or '.join(steps)}." if steps else ""

    def notice(self, where: Path) -> str:
        """Returns a notice for the user; `where` is the input that they gave."""
        place = self.place if self.folder == where else self.path
        if self.row.layout and self.folder != where:
            whole = command_line(f"ingest {shlex.quote(str(self.folder))}")
            return (f"{place} is {self.row.words}: its {self.row.carries} are not used with "
                    f"these pictures alone; {whole} uses them.")
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
    for row in KNOWN_FILES:
        for path in _matching(folder, row.patterns):
            if path not in seen and has_marks(path, row.marks):
                found.append(Found(row, folder, path))
                seen.update(_matching(folder, row.patterns))
                break
    return found


def refuse_lost_poses(folder: Path) -> None:
    """Raises FormatError for a folder with the capture of a program, but without its poses."""
    for row in KNOWN_FILES if folder.is_dir() else ():
        for lost in row.lost:
            if all(_matching(folder, [mark]) for mark in lost.marks) and not any(
                    _matching(folder, [name]) for name in lost.lacks):
                hint = "Copy the capture again, all of it."
                if lost.pictures:
                    pictures = sorted(folder.glob(lost.pictures))
                    # of several files as a shell takes them
                    path = pictures[0] if len(pictures) == 1 else folder / lost.pictures
                    hint = f"Copy that file too, or give {path} to estimate the cameras."
                raise FormatError(
                    f"{folder} holds {row.words} without {' or '.join(lost.lacks)}.", hint=hint)


def recognise_file(path: Path) -> Found | None:
    """Returns the row that a file by itself has, None for none."""
    named = path.suffix.lower() in _TEXTS | _ARRAYS  # a video may be called odometry.mp4
    rows = (row for row in KNOWN_FILES if row.marks or named)
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
        data = read_head(path)
        if 2 * sum(name in data for name in wanted) >= len(wanted):
            lists.append(path)
    return lists


def has_marks(path: Path, marks: Sequence[bytes]) -> bool:
    """Returns whether a path is a file that holds all of some bytes near its beginning."""
    if not marks:
        return path.is_file()
    data = read_head(path)
    return all(mark in data for mark in marks)


def read_head(path: Path, size: int = _READ) -> bytes:
    """Returns the first bytes of a regular file; none where it cannot be read."""
    with suppress(OSError):
        if path.is_file():
            with path.open("rb") as file:
                return file.read(size)
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


def is_archive(path: Path) -> bool:
    """Returns whether a file is an archive, by its first bytes."""
    return _unpacking(path) is not None


def refuse_other_file(path: Path) -> None:
    """Raises InputError for a file that is an archive, a scene, a text or data."""
    suffix = path.suffix.lower()
    if suffix in _SCENES:
        command = command_line(f"import {shlex.quote(str(path))}")
        raise InputError(f"{path} is a scene or a mesh, not a capture.",
                         hint=f"{command} reads a finished scene.")
    unpacking = _unpacking(path)
    if unpacking is not None:
        folder = shlex.quote(str(path.with_name(path.name.split(".")[0] or "unpacked")))
        if (path.parent / path.name.split(".")[0]).is_file():
            folder = shlex.quote(f"{path}.d")
        unpack = unpacking.format(file=shlex.quote(str(path)), folder=folder)
        raise InputError(
            f"{path} is an archive, not a video.", hint="Unpack it, and give the folder: "
            + _UNPACK.format(
                folder=folder, command=unpack, ingest=command_line(f"ingest {folder}")))
    if suffix in _MESHES:
        raise InputError(f"{path} is a mesh or a point cloud, not a capture.",
                         hint="Give the video or the photos that it was made from.")
    found = recognise_file(path)
    if found is not None and found.row.layout:
        raise InputError(
            f"{path} belongs to {found.row.words}; needed is the folder with all its files.",
            hint=f"Give the folder: {command_line(f'ingest {shlex.quote(str(path.parent))}')}.")
    if found is not None:
        raise InputError(
            f"{path} is {found.row.words}, which are not read; needed are the pictures.",
            hint=("Give the folder of the photos: "
                  f"{_ingest_beside(path)}. {found.advice()}").rstrip())
    if suffix in _DATA:
        raise InputError(
            f"{path} is neither a video nor a photo, by its name.",
            hint=f"Give a video, or the folder of the photos: {_ingest_beside(path)}.")


def _ingest_beside(path: Path) -> str:
    """Returns the command that reads the photos beside a file, if there are any."""
    with suppress(OSError):
        if any(file.suffix.lower() in PHOTO_SUFFIXES for file in path.parent.iterdir()):
            return command_line(f"ingest {shlex.quote(str(path.parent))}")
    return command_line("ingest PHOTOS")


def _unpacking(path: Path) -> str | None:
    """Returns the command that unpacks an archive, None for other files."""
    head = read_head(path, 512)
    return next((command for mark, at, command in _SIGNATURES
                 if head[at:at + len(mark)] == mark), None)


def picture_kind(name: str) -> str:
    """Returns the content of pictures of such a name (a mask, depth), "" for the scene itself."""
    return next((kind for kind, pattern in _NAMES.items() if pattern.search(name)), "")
