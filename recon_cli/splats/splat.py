"""The .splat of antimatter15's viewer: 32 bytes a Gaussian, no header, no harmonics.

A row is the position (3 float32), the standard deviations (3 float32), RGBA (4 bytes) and the
rotation (4 bytes, q * 128 + 128, wxyz). Axes and units are those of the .ply. Viewers show the
first Gaussians first, so they are sorted by importance.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from recon_cli.errors import FormatError
from recon_cli.scene.splat_arrays import SH_C0, SplatArrays
from recon_cli.splats.foreign import drop_not_finite
from recon_cli.splats.format import LoadedScene, SplatFormat
from recon_cli.splats.values import (
    decode_opacities,
    encode_opacities,
    refuse_above,
    round_to_bytes,
    splats_from_arrays,
    to_arrays,
)
from recon_cli.workspace.atomic import write_bytes

if TYPE_CHECKING:
    from recon_cli.scene.splats import Splats

_ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])
_LEAST = np.finfo(np.float32).tiny  # replaces a scale of 0, which has no logarithm
_LARGEST = 88.0  # of a log scale; the exponential of more is infinite in float32
# First bytes of .ply, SPZ, gzip and zip. As a position they would be 1e-32 and less, or 1e10.
_OTHER_FORMATS = (b"ply\n", b"ply\r", b"NGSP", b"\x1f\x8b\x08\0", b"PK\x03\x04")


def write_splat(path: Path, splats: Splats | SplatArrays) -> None:
    """Writes `splats` to `path`, whole or not at all, in descending order of opacity x volume.

    Harmonics of degrees 1 and up are dropped, and colours are clipped to 0 to 1. FormatError if
    there are no Gaussians, one is too large, or a parameter is not finite.
    """
    values = to_arrays(splats, path.name)
    log_scales, logits = values["log_scales"], values["logit_opacities"]
    refuse_above(path, log_scales, _LARGEST)
    rows = np.empty(len(splats), _ROW)
    rows["means"] = values["means"]
    rows["scales"] = np.maximum(np.exp(log_scales), _LEAST)
    rows["rgba"][:, :3] = round_to_bytes(255 * (SH_C0 * values["sh_dc"] + 0.5))
    rows["rgba"][:, 3] = encode_opacities(logits)
    rows["quats"] = round_to_bytes(values["quats"] * 128 + 128)
    # The logarithm of opacity x volume, whose products overflow.
    importance = log_scales.sum(axis=1, dtype=np.float64) - np.logaddexp(0, -logits)
    write_bytes(path, rows[np.argsort(-importance, kind="stable")].tobytes())


def read_splat(path: Path) -> SplatArrays:
    """Returns the Gaussians of a .splat, degree 0, in the file's order.

    Those that are not finite are dropped, with a warning. FormatError if the file is damaged.
    """
    try:
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            if not size or size % _ROW.itemsize:
                raise FormatError(
                    f"{path} holds {size} bytes, but Gaussians of a .splat have "
                    f"{_ROW.itemsize} each: it is truncated or of another format.")
            data = file.read(size)
    except OSError as error:
        raise FormatError(f"{path} cannot be read: {error}.") from error
    if len(data) != size or data.startswith(_OTHER_FORMATS):
        raise FormatError(f"{path} is not a .splat file.")
    rows = np.frombuffer(data, _ROW)
    rows = drop_not_finite(path, {"row": rows}, {
        "positions": rows["means"], "scales": rows["scales"]})["row"]
    scales = rows["scales"]
    if (scales < 0).any():
        raise FormatError(f"{path} holds negative scales: it is damaged or not a .splat file.")
    return splats_from_arrays(path, {
        "means": rows["means"],
        "quats": (rows["quats"].astype(np.float32) - 128) / 128,
        "log_scales": np.log(np.maximum(scales, _LEAST)),
        "logit_opacities": decode_opacities(rows["rgba"][:, 3]),
        "sh_dc": (rows["rgba"][:, :3] / 255 - 0.5) / SH_C0,
        "sh_rest": np.zeros((len(rows), 0, 3)),
    })


FORMAT = SplatFormat(
    load=lambda path: LoadedScene(read_splat(path)),
    write_with=lambda path, splats, _: write_splat(path, splats.with_sphere()))
