"""The formats of Gaussians by name, and the format of a file."""

from __future__ import annotations

import logging
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from recon_cli.errors import FormatError, InputError, name_command
from recon_cli.splats.axes import signs, turn_from, up_of
from recon_cli.splats.format import LoadedScene, SplatFormat
from recon_cli.splats.values import MOST_HEAD_BYTES, read_start
from recon_cli.workspace.export_formats import EXPORT_FORMATS, READABLE, ExportFormat

if TYPE_CHECKING:
    from recon_cli.scene.splats import Splats

logger = logging.getLogger("recon")

FORMATS: dict[str, SplatFormat] = {
    row.name: import_module(row.module).FORMAT for row in EXPORT_FORMATS.values() if row.module}
_READERS: dict[str, SplatFormat] = {
    row.name: import_module(row.module).FORMAT for row in READABLE}


def format_of(path: Path) -> ExportFormat:
    """Returns the row of a file by its first bytes, or else by its name; FormatError if unknown."""
    start = read_start(path, MOST_HEAD_BYTES) if path.is_file() else b""
    found = [row for row in READABLE if row.signature and row.signature.match(start)]
    return found[0] if found else _format_by_name(path)


def _format_by_name(path: Path) -> ExportFormat:
    found = [row for row in READABLE if row.fits_name(path.name)]
    if not found:
        raise FormatError(
            f"{path} is not of a known format of Gaussians.",
            hint=f"Known are {', '.join(row.ending for row in READABLE)}; "
            f"{name_command('run')} reads videos and photos.")
    return max(found, key=lambda row: len(row.ending))  # .compressed.ply before .ply


def check_writable(path: Path) -> ExportFormat:
    """Returns the row of a file to write by its name; FormatError or InputError if it cannot be."""
    row = _format_by_name(path)
    if row.name not in FORMATS:
        raise FormatError(
            f"{path} cannot be written: .{row.name} is only read.",
            hint=f"Write one of {', '.join(FORMATS)}.")
    if not path.parent.is_dir():
        raise InputError(f"The folder of {path} does not exist.",
                         hint=f"Make it: `mkdir -p {path.parent}`.")
    if path.is_dir():
        raise InputError(f"{path} is a folder.", hint="Give the name of a file.")
    return row


def read_splats(path: Path) -> Splats:
    """Returns the Gaussians of a file in any format where the file has them.

    FormatError if it is damaged.
    """
    return put_in_place(load_splats(path), path.name)


def put_in_place(scene: LoadedScene, name: str) -> Splats:
    """Returns the Gaussians where the file `name` has them, with a warning if that rounds."""
    if scene.origin is None:
        return scene.splats
    logger.warning("%s: %s, and added again here, rounded; %s leaves it out",
                   name, scene.origin.describe(), name_command("import"))
    means = scene.arrays.means + np.array(scene.origin.point, np.float32)
    return replace(scene.arrays, means=means).as_tensors()


def load_splats(path: Path, *, axes: str | None = None) -> LoadedScene:
    """Returns the scene of a file in any format, and the statements of the file about it.

    `axes` is a name in `axes.AXES` and wins over the axes that the file states. FormatError if it
    is damaged.
    """
    row = format_of(path)
    if path.exists() and not (path.is_file() or path.is_dir()):  # a pipe would be waited for
        raise FormatError(f"{path} is not a file.", hint="Give a file on the disk.")
    form = _READERS[row.name]
    try:
        if axes is None:
            return form.load(path)
        return _turn((form.load_unturned or form.load)(path), axes)
    except FormatError as error:
        error.hint = error.hint or (
            f"Copy or export it again, if it is a .{row.name}.")
        raise


def _turn(scene: LoadedScene, axes: str) -> LoadedScene:
    """Returns a scene of these axes in those of recon."""
    origin = scene.origin
    if origin is not None:
        x, y, z = (sign * at for sign, at in zip(signs(axes), origin.point, strict=True))
        origin = replace(origin, point=(x, y, z))
    return replace(scene, arrays=turn_from(axes, scene.arrays), up=up_of(axes), origin=origin)
