"""The table of export formats: a row says all about a format but how its bytes are laid out.

It lies this low because options, freshness and the stage all read it. A new format of Gaussians
needs a row, and the module that the row names: its `FORMAT` writes and reads the files
(`splats.registry`). Another package adds a row by the entry point `recon.formats`. One that is only
read has its row in a table of its own. Points, cameras, meshes and plans are written by
`export.format_writer`.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Literal

from recon_cli.plugins import load_rows

MAX_LOSS_DB = 0.3  # on the validation views, where a row and --max-loss say nothing else
# A default limit is about a loss that can be seen. At 45 dB the error is 1.4 of 255 levels (root
# mean square); rounding an image to 8 bits alone leaves 58.9 dB, 0.29 levels. Only pictures without
# noise, such as renders, get there; the scenes of photos stay below 40 dB.
CLEAN_DB = 45.0
PLAN, MEASURES = "plan.svg", "measures.json"
TRANSFORM = "transform.json"  # beside the .ply: the frame of all files
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
    def main_file(self) -> str:
        """The file that is always there."""
        return f"{self.file}/{self.index}" if self.index else self.file

    @property
    def key_options(self) -> tuple[str, ...]:
        """Options of ExportConfig that decide on its files besides those that the .ply shows."""
        if self.kind != "gaussians":
            return self.options
        return (*self.options, "max_loss", "max_mb", "format")

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
        TRANSFORM,), signature=_starts(rb"ply\r?\n(?!.*\bpacked_position\b)")),
    ExportFormat("compressed.ply", "gaussians", "splats.compressed.ply",
                 "recon_cli.splats.compressed_ply",
                 signature=_starts(rb"ply\r?\n.*\bpacked_position\b")),
    ExportFormat("splat", "gaussians", "splats.splat", "recon_cli.splats.splat", max_loss_db=3.0,
                 sh_degree=0),
    ExportFormat("spz", "gaussians", "splats.spz", "recon_cli.splats.spz", options=(
        "spz_version",), signature=_starts(rb"\x1f\x8b|NGSP")),
    ExportFormat("sog", "gaussians", "splats.sog", "recon_cli.splats.sog", sharing=_SHARING,
                 signature=_starts(rb'PK\x03\x04|\s*\{.*"means"')),
    ExportFormat("glb", "gaussians", "splats.glb", "recon_cli.splats.glb",
                 signature=_starts(b"glTF")),
    ExportFormat("html", "gaussians", "splats.html", "recon_cli.splats.html", more_files=(
        "splats.jpg",), options=("title", "credits"), bounded=False,
                 signature=_starts(rb"\s*(?i:<!doctype html|<html)")),
    ExportFormat("lod", "gaussians", "lod/lod-meta.json", "recon_cli.splats.lod", more_files=(
        "lod/*",), sharing=_SHARING, signature=_starts(rb'\s*\{.*"lodLevels"')),
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
    ExportFormat(PLAN, "plan", PLAN, more_files=(MEASURES,), options=_MESH_OPTIONS),
)}

EXPORT_FORMATS.update(
    (row.name, row) for row in load_rows("recon.formats", ExportFormat, EXPORT_FORMATS)
    if row.kind == "gaussians")

# Other names in --format, by the program that reads the files.
OTHER_NAMES = {"nerfstudio": "transforms.json"}

# Formats that are read, but not written.
READ_ONLY: dict[str, ExportFormat] = {row.name: row for row in (
    ExportFormat("ksplat", "gaussians", "splats.ksplat", "recon_cli.splats.ksplat"),
)}

READABLE: tuple[ExportFormat, ...] = (  # all that Gaussians are read from
    *(row for row in EXPORT_FORMATS.values() if row.kind == "gaussians"), *READ_ONLY.values())


# Options that decide on files of some formats alone.
FORMAT_OPTIONS = frozenset({"max_loss"}.union(*(row.options for row in EXPORT_FORMATS.values())))


@dataclass(frozen=True)
class LossLimit:
    """How many dB a file may lose on the views that it is checked on."""

    most_db: float
    clean_db: float = math.inf  # PSNR of a file against the views from which on any loss is allowed

    @staticmethod
    def from_option(row: ExportFormat, max_loss: float | None) -> LossLimit:
        """Returns the limit of --max-loss, or that of the format where it is not given."""
        return LossLimit(row.max_loss_db, CLEAN_DB) if max_loss is None else LossLimit(max_loss)

    def allows(self, change_db: float, psnr_db: float) -> bool:
        """Returns whether a file passes that changes the PSNR to `psnr_db`; a NaN does not."""
        return change_db >= -self.most_db or psnr_db >= self.clean_db


def describe_max_loss() -> str:
    """Returns how many dB a format may lose unless --max-loss is given, for the help."""
    others = [f"{row.max_loss_db:g} for .{row.name}"
              + (", which has no harmonics" if row.sh_degree == 0 else "")
              for row in EXPORT_FORMATS.values() if row.max_loss_db != MAX_LOSS_DB]
    return "; ".join([f"{MAX_LOSS_DB:g}", *others])
