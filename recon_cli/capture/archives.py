"""Files that are neither video nor photo, told by their first bytes: archives, texts, scenes.

FFmpeg would find a video in many of them: the first picture of an uncompressed .zip, or the letters
of a text.
"""

from __future__ import annotations

import shlex
from contextlib import suppress
from pathlib import Path

from recon_cli.capture.foreign import recognise_file
from recon_cli.capture.images import PHOTO_SUFFIXES
from recon_cli.errors import InputError

# First bytes, their offset, and the command that unpacks such a file into a folder.
_UNPACK = "mkdir -p {folder} && {command} && recon ingest {folder}"
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
_SCENES = frozenset({".ply", ".spz", ".splat", ".ksplat", ".sog"})
_MESHES = frozenset({".glb", ".gltf", ".obj", ".fbx", ".usdz", ".stl", ".las", ".laz", ".e57"})
_DATA = frozenset({
    ".bin", ".cfg", ".csv", ".db", ".exr", ".geojson", ".html", ".ini", ".json", ".jsonl", ".log",
    ".md", ".npy", ".npz", ".nvm", ".out", ".pdf", ".pkl", ".pt", ".pth", ".py", ".safetensors",
    ".sfm", ".toml", ".traj", ".tsv", ".txt", ".xml", ".xmp", ".yaml", ".yml"})


def is_archive(path: Path) -> bool:
    """Returns whether a file is an archive, by its first bytes."""
    return _unpacking(path) is not None


def refuse_other_file(path: Path) -> None:
    """Raises InputError for a file that is an archive, a scene, a text or data."""
    suffix = path.suffix.lower()
    if suffix in _SCENES:
        raise InputError(f"{path} is a scene or a mesh, not a capture.",
                         hint=f"recon import {shlex.quote(str(path))} reads a finished scene.")
    command = _unpacking(path)
    if command is not None:
        folder = shlex.quote(str(path.with_name(path.name.split(".")[0] or "unpacked")))
        if (path.parent / path.name.split(".")[0]).is_file():
            folder = shlex.quote(f"{path}.d")
        unpack = command.format(file=shlex.quote(str(path)), folder=folder)
        raise InputError(
            f"{path} is an archive, not a video.", hint="Unpack it, and give the folder: "
            + _UNPACK.format(folder=folder, command=unpack))
    if suffix in _MESHES:
        raise InputError(f"{path} is a mesh or a point cloud, not a capture.",
                         hint="Give the video or the photos that it was made from.")
    found = recognise_file(path)
    if found is not None and found.row.layout:
        raise InputError(
            f"{path} belongs to {found.row.words}; needed is the folder with all its files.",
            hint=f"Give the folder: recon ingest {shlex.quote(str(path.parent))}.")
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
            return f"recon ingest {shlex.quote(str(path.parent))}"
    return "recon ingest PHOTOS"


def _unpacking(path: Path) -> str | None:
    """Returns the command that unpacks an archive, None for other files."""
    with suppress(OSError):
        if path.is_file():
            with path.open("rb") as file:
                head = file.read(512)
            return next((command for mark, at, command in _SIGNATURES
                         if head[at:at + len(mark)] == mark), None)
    return None
