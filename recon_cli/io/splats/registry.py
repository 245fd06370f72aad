"""The formats of Gaussians by name, and the format of a file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from recon_cli.errors import FormatError
from recon_cli.io.ply import read_ply, write_ply
from recon_cli.io.splats.compressed_ply import read_compressed_ply, write_compressed_ply
from recon_cli.io.splats.glb import read_glb, write_glb
from recon_cli.io.splats.html import read_html, write_html
from recon_cli.io.splats.lod import LOD_META, make_levels, read_lod, write_lod
from recon_cli.io.splats.sog import read_sog, write_sog
from recon_cli.io.splats.splat import read_splat, write_splat
from recon_cli.io.splats.spz import read_spz, write_spz
from recon_cli.scene.splats import Splats


@dataclass(frozen=True)
class SplatFormat:
    """One format."""

    name: str  # also the suffix of its files, after a dot; but `lod` for lod-meta.json
    read: Callable[[Path], Splats]  # returns the Gaussians of a file; raises FormatError
    # writes a file, whole or not at all; raises InputError if a value does not fit
    write: Callable[[Path, Splats], None]


FORMATS: dict[str, SplatFormat] = {row.name: row for row in (
    SplatFormat("compressed.ply", read_compressed_ply, write_compressed_ply),  # before "ply"
    SplatFormat("ply", read_ply, write_ply),
    SplatFormat("splat", read_splat, write_splat),
    SplatFormat("spz", read_spz, write_spz),
    SplatFormat("sog", read_sog, write_sog),
    SplatFormat("glb", read_glb, write_glb),
    SplatFormat("html", read_html, write_html),
    SplatFormat("lod", read_lod, lambda path, splats: write_lod(path, make_levels(splats))),
)}


def scene_file(folder: Path, name: str) -> Path:
    """Returns the file of a scene in a folder and a format; that of lod has a folder of its own."""
    return folder / name / LOD_META if name == "lod" else folder / f"splats.{name}"


def format_of(path: Path) -> SplatFormat:
    """Returns the format of a file by the end of its name; FormatError if that is none."""
    if path.name.lower() == LOD_META:
        return FORMATS["lod"]
    for name, row in FORMATS.items():
        if path.name.lower().endswith(f".{name}"):
            return row
    raise FormatError(
        f"{path} is of no known format of Gaussians.",
        hint="Known are " + ", ".join(f".{name}" for name in FORMATS if name != "lod")
        + f" and {LOD_META}.")


def read_splats(path: Path) -> Splats:
    """Returns the Gaussians of a file in any of FORMATS; FormatError if it is damaged."""
    row = format_of(path)
    try:
        return row.read(path)
    except FormatError as error:
        error.hint = error.hint or (
            f"Copy or export it again; if it is no .{row.name}, rename it to its real format.")
        raise
