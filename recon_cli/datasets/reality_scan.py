"""RealityScan, RealityCapture, Postshot: photos with "internal/external camera parameters" (CSV).

The header names the columns, in the order of the user's template: name x y alt heading pitch roll
f, and often px py k1 k2 k3 k4 t1 t2. Camera to world is Rz(-heading) Rx(pitch) Ry(roll) in degrees,
with OpenGL's camera axes, in a world whose z is up. f, px and py are for a picture 36 wide along
its longer side, from its middle. (nerfstudio's realitycapture_utils.py; a published pair of a
matrix and angles of one camera.) The unit is a metre only if the project was scaled, which the file
does not say.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recon_cli.datasets.app_frames import (
    HEAD_LINES,
    Z_UP,
    LeftOut,
    column_names,
    numbers,
    quoted,
    read_csv,
)
from recon_cli.datasets.exported_files import (
    PhotoFiles,
    find_points,
    radial_lens,
    shift_far,
    solved_set,
)
from recon_cli.datasets.posed import PosedImage, PosedSet, image_size
from recon_cli.errors import FormatError
from recon_cli.scene.camera import Lens

_NEEDED = ("name", "x", "y", "alt", "heading", "pitch", "roll", "f")
_FILM = 36.0  # millimetres, of the longer side


def is_reality_scan(path: Path) -> bool:
    """Returns whether a folder has such a .csv, or a file is one."""
    return _find(path) is not None


def _find(path: Path) -> Path | None:
    files = [path] if path.is_file() else sorted(path.glob("*.csv"))
    for file in files:
        if file.suffix.lower() == ".csv" and file.is_file():
            with file.open("rb") as stream:
                head = [stream.readline(4096).decode("utf-8-sig", errors="replace")
                        for _ in range(HEAD_LINES)]
            if any(set(column_names(line.split(","))) >= set(_NEEDED) for line in head):
                return file
    return None


def read_reality_scan(path: Path) -> PosedSet:
    """Returns the photos that the .csv lists; InputError if none is there or has a pose."""
    file = _find(path)
    assert file is not None
    folder = file.parent
    rows = [row for row in read_csv(file, _NEEDED) if row.get("name")]
    left_out, listed = LeftOut(), []
    files = PhotoFiles(folder, [row["name"] for row in rows], left_out)
    for row in rows:
        image = files.find(row["name"])
        if image is None:
            continue
        viewmat = left_out.pose(image.name, _pose, row, opengl=True)
        if viewmat is None:
            continue
        try:
            lens = _lens(row, image_size(image), f"{file}, {image.name}")
        except (FormatError, KeyError, ValueError):
            left_out.add(image.name, "whose intrinsics cannot be used")
            continue
        listed.append(PosedImage(image.name, image, lens, viewmat))
    posed = solved_set("realityscan", listed, folder, left_out, missing=files.missing,
                       photos=quoted(folder))
    posed = replace(posed, up=Z_UP, notices=(*posed.notices, (
        "its unit is a metre only if the project was scaled, which its file does not say; "
        "--scale-between of recon sfm makes it one")))
    return shift_far(find_points(posed, folder))


def _pose(row: Mapping[str, str]) -> NDArray[np.float64]:
    """Returns camera to world, OpenGL's camera axes."""
    heading, pitch, roll = numbers(row, ("heading", "pitch", "roll"))
    pose = np.eye(4)
    # Capitals: each turn is about an axis that the one before has turned.
    pose[:3, :3] = Rotation.from_euler("ZXY", [-heading, pitch, roll], degrees=True).as_matrix()
    pose[:3, 3] = numbers(row, ("x", "y", "alt"))
    return pose


def _lens(row: Mapping[str, str], size: tuple[int, int], where: str) -> Lens:
    def number(key: str) -> float:
        return float(row.get(key) or 0)

    width, height = size
    scale = max(size)
    focal = number("f") * scale / _FILM
    inner = (focal, focal, number("px") * scale + width / 2, number("py") * scale + height / 2)
    return radial_lens(size, inner, [number(key) for key in ("k1", "k2", "k3", "k4")],
                       (number("t1"), number("t2")), where)
