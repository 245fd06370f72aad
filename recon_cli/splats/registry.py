"""The formats of Gaussians by name, and the format of a file."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from recon_cli.errors import FormatError
from recon_cli.scene.splats import Splats
from recon_cli.splats.axes import signs, turn_from, up_of
from recon_cli.splats.compressed_ply import (
    load_compressed_ply,
    read_compressed_ply,
    write_compressed_ply,
)
from recon_cli.splats.glb import Y_UP, load_glb, read_glb, write_glb
from recon_cli.splats.html import read_html, write_html
from recon_cli.splats.loaded import LoadedScene
from recon_cli.splats.lod import LOD_META, make_levels, read_lod, write_lod
from recon_cli.splats.ply import load_ply, read_ply, write_ply
from recon_cli.splats.sog import load_sog, read_sog, write_sog
from recon_cli.splats.splat import read_splat, write_splat
from recon_cli.splats.spz import load_spz, read_spz, write_spz

logger = logging.getLogger("recon")


@dataclass(frozen=True)
class SplatFormat:
    """One format."""

    name: str  # also the suffix of its files, after a dot; but `lod` for lod-meta.json
    read: Callable[[Path], Splats]  # returns the Gaussians of a file; raises FormatError
    # writes a file, whole or not at all; raises InputError if a value does not fit
    write: Callable[[Path, Splats], None]
    # reads the file of any program with what it says of itself; None where it cannot say anything
    load: Callable[[Path], LoadedScene] | None = None


FORMATS: dict[str, SplatFormat] = {row.name: row for row in (
    SplatFormat(  # before "ply"
        "compressed.ply", read_compressed_ply, write_compressed_ply, load_compressed_ply),
    SplatFormat("ply", read_ply, write_ply, load_ply),
    SplatFormat("splat", read_splat, write_splat),
    SplatFormat("spz", read_spz, write_spz, load_spz),
    SplatFormat("sog", read_sog, write_sog, load_sog),
    SplatFormat("glb", read_glb, write_glb, load_glb),
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
    """Returns the Gaussians of a file in any of FORMATS where the file has them.

    FormatError if it is damaged.
    """
    scene = load_scene(path)
    if scene.origin is None:
        return scene.splats
    logger.warning("%s: %s, and added again here, rounded; `recon import` leaves it out",
                   path.name, scene.origin.describe())
    return replace(scene.splats, means=scene.splats.means + torch.tensor(scene.origin.point))


def load_scene(path: Path, *, axes: str | None = None) -> LoadedScene:
    """Returns the scene of a file in any of FORMATS, and what it says of itself.

    `axes` is the name in `axes.AXES` of those that it has, whatever it says. FormatError if it is
    damaged.
    """
    row = format_of(path)
    if path.exists() and not (path.is_file() or path.is_dir()):  # a pipe would be waited for
        raise FormatError(f"{path} is not a file.", hint="Give a file on the disk.")
    try:
        if axes is not None and row.name == "spz":
            return load_spz(path, axes=axes)
        if axes is not None and row.name == "glb":
            return _turn(load_glb(path, axes=Y_UP), axes)
        scene = row.load(path) if row.load else LoadedScene(row.read(path))
        return scene if axes is None else _turn(scene, axes)
    except FormatError as error:
        error.hint = error.hint or (
            f"Copy or export it again; if it is no .{row.name}, rename it to its real format.")
        raise


def _turn(scene: LoadedScene, axes: str) -> LoadedScene:
    """Returns a scene of these axes in those of recon."""
    origin = scene.origin
    if origin is not None:
        x, y, z = (sign * at for sign, at in zip(signs(axes), origin.point, strict=True))
        origin = replace(origin, point=(x, y, z))
    return replace(scene, splats=turn_from(axes, scene.splats), up=up_of(axes), origin=origin)
