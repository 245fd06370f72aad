"""The table of export formats: a row says all about a format but how its bytes are laid out.

It lies this low because options, freshness and the stage all read it. A new format of Gaussians
needs a row, and the module that the row names: its `FORMAT` writes and reads the files
(`splats.registry`). One that is only read has its row in a table of its own. Points, cameras,
meshes and plans are written by `export.format_writer`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Literal

MAX_LOSS_DB = 0.3  # on the validation views, where a row and --max-loss say nothing else
PLAN = "plan.svg"
_STEM = "splats"
_MESH_OPTIONS = ("max_triangles", "voxel")
_SURFACE_OPTIONS = (*_MESH_OPTIONS, "inferred")
_TEXTURE_OPTIONS = (*_SURFACE_OPTIONS, "texture", "texture_format")
# Gaussians per entry of the palette of colours, on the mean: the smallest file first
_SHARING = (16, 8, 4, 2, 1)


def _starts(pattern: bytes) -> re.Pattern[bytes]:
    return re.compile(pattern, re.DOTALL)


@dataclass(frozen=True)
class ExportFormat:
    """One row."""

    name: str  # as in --format
    kind: Literal["gaussians", "points", "cameras", "mesh", "plan"]
    file: str  # its file, or the folder of its files; relative to the folder of the export
    module: str = ""  # that has the `FORMAT` of Gaussians
    more_files: tuple[str, ...] = ()  # patterns of its other files
    index: str = ""  # the file that is always there, if `file` is a folder
    options: tuple[str, ...] = ()  # of ExportConfig, which change the files of this format alone
    max_loss_db: float = MAX_LOSS_DB
    sh_degree: int = 3  # the highest that it holds; a scene of a higher one is fitted to it
    # values of `WriteSettings.sharing`, one after the other, until the loss is small enough
    sharing: tuple[int, ...] = (1,)
    # pattern of the first bytes of its files, by which they are known whatever their name; None
    # where a file has nothing to know it by
    signature: re.Pattern[bytes] | None = None
    bounded: bool = True  # it holds the scene with `export.bounds`; False: as it was trained

    @property
    def patterns(self) -> tuple[str, ...]:
        """Patterns of all its files, relative to the folder of the export."""
        return (self.file, *self.more_files)

    @property
    def needs_views(self) -> bool:
        """Whether it is made from the views of a capture."""
        return self.kind in ("cameras", "mesh", "plan")

    @property
    def ending(self) -> str:
        """How the names of its files end; the whole name if it has no dot in front."""
        return PurePosixPath(self.file).name.removeprefix(_STEM)

    def fits_name(self, file_name: str) -> bool:
        """Returns whether a file has the name of this format, in small or large letters."""
        name = file_name.lower()
        return name.endswith(self.ending) if self.ending.startswith(".") else name == self.ending


EXPORT_FORMATS: dict[str, ExportFormat] = {row.name: row for row in (
    ExportFormat("ply", "gaussians", "splats.ply", "recon_cli.splats.ply", more_files=(
        "transform.json",), signature=_starts(rb"ply\r?\n(?!.*\bpacked_position\b)")),
    ExportFormat("compressed.ply", "gaussians", "splats.compressed.ply",
                 "recon_cli.splats.compressed_ply",
                 signature=_starts(rb"ply\r?\n.*\bpacked_position\b")),
    ExportFormat("splat", "gaussians", "splats.splat", "recon_cli.splats.splat", max_loss_db=3.0,
                 sh_degree=0),
    ExportFormat("spz", "gaussians", "splats.spz", "recon_cli.splats.spz", options=(
        "spz_version",), signature=_starts(rb"\x1f\x8b|NGSP")),
    ExportFormat("sog", "gaussians", "splats.sog", "recon_cli.splats.sog", options=("max_loss",),
                 sharing=_SHARING, signature=_starts(rb'PK\x03\x04|\s*\{.*"means"')),
    ExportFormat("glb", "gaussians", "splats.glb", "recon_cli.splats.glb",
                 signature=_starts(b"glTF")),
    ExportFormat("html", "gaussians", "splats.html", "recon_cli.splats.html", more_files=(
        "splats.jpg",), options=("title", "credits"), bounded=False,
                 signature=_starts(rb"\s*(?i:<!doctype html|<html)")),
    ExportFormat("lod", "gaussians", "lod/lod-meta.json", "recon_cli.splats.lod", more_files=(
        "lod/*",), options=("max_loss",), sharing=_SHARING,
                 signature=_starts(rb'\s*\{.*"lodLevels"')),
    ExportFormat("rad", "gaussians", "splats.rad", "recon_cli.splats.rad",
                 signature=_starts(b"RAD0")),
    ExportFormat("points.ply", "points", "points.ply"),
    ExportFormat("colmap", "cameras", "sparse/0", index="images.bin", more_files=(
        "sparse/*", "images/*", "database.db", "colmap/*")),  # colmap/: before version 5
    ExportFormat("transforms.json", "cameras", "transforms.json", more_files=(
        "sparse_pc.ply", "images/*", "depth/*")),
    ExportFormat("mesh.ply", "mesh", "mesh.ply", options=_SURFACE_OPTIONS),
    ExportFormat("mesh.glb", "mesh", "mesh.glb", options=_TEXTURE_OPTIONS),
    ExportFormat("mesh.obj", "mesh", "mesh.obj", more_files=(
        "mesh.mtl", "mesh.png", "mesh.jpg"), options=_TEXTURE_OPTIONS),
    ExportFormat(PLAN, "plan", PLAN, more_files=("measures.json",), options=_MESH_OPTIONS),
)}

# Other names in --format, by the program that reads the files.
OTHER_NAMES = {"nerfstudio": "transforms.json"}

# Formats that are read, but not written.
READ_ONLY: dict[str, ExportFormat] = {row.name: row for row in (
    ExportFormat("ksplat", "gaussians", "splats.ksplat", "recon_cli.splats.ksplat"),
)}

READABLE: tuple[ExportFormat, ...] = (  # all that Gaussians are read from
    *(row for row in EXPORT_FORMATS.values() if row.kind == "gaussians"), *READ_ONLY.values())


def describe_max_loss() -> str:
    """Returns how many dB a format may lose unless --max-loss is given, for the help."""
    others = [f"{row.max_loss_db:g} for .{row.name}"
              + (", which has no harmonics" if row.sh_degree == 0 else "")
              for row in EXPORT_FORMATS.values() if row.max_loss_db != MAX_LOSS_DB]
    return "; ".join([f"{MAX_LOSS_DB:g}", *others])
