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
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recon_cli.capture.known_files import read_head
from recon_cli.datasets.exported_files import find_points, radial_lens, shift_far
from recon_cli.datasets.file_finder import FileFinder
from recon_cli.datasets.frame_files import HEAD_LINES, column_names, numbers, read_csv
from recon_cli.datasets.frame_table import UNUSABLE, Z_UP, FrameTable, LeftOutError
from recon_cli.datasets.posed import PosedImage, PosedSet, image_size
from recon_cli.scene.camera import Lens

_NEEDED = ("name", "x", "y", "alt", "heading", "pitch", "roll", "f")
_HEAD = HEAD_LINES * 4096  # bytes


def find_reality_scan(path: Path) -> Path | None:
    """Returns the .csv of cameras in a folder, or that a file is."""
    files = [path] if path.is_file() else sorted(path.glob("*.csv"))
    return next((file for file in files if file.suffix.lower() == ".csv" and any(
        set(column_names(line.split(","))) >= set(_NEEDED) for line in read_head(
            file, _HEAD).decode("utf-8-sig", errors="replace").splitlines()[:HEAD_LINES])), None)


def read_reality_scan(path: Path) -> PosedSet:
    """Returns the photos that the .csv lists; InputError if none is there or has a pose."""
    file = find_reality_scan(path)
    assert file is not None
    folder = file.parent
    rows = [row for row in read_csv(file, _NEEDED) if row.get("name")]
    table = FrameTable(folder, opengl=True)
    finder = FileFinder(folder, [row["name"] for row in rows])
    for row in rows:
        with table.frame(PurePosixPath(row["name"]).name):
            path = finder.find_photo(row["name"])
            viewmat = table.pose(_pose, row)
            try:
                lens = _lens(row, image_size(path), f"{file}, {path.name}")
            except UNUSABLE as error:
                raise LeftOutError("whose intrinsics cannot be used") from error
            table.add(PosedImage(path.name, path, lens, viewmat))
    table.notices.append(
        "its unit is a metre only if the project was scaled, which its file does not say; "
        "--scale-between of recon sfm makes it one")
    return shift_far(find_points(replace(table.finish(), up=Z_UP), folder))


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
    focal = number("f") * scale / 36  # millimetres of film, the longer side
    inner = (focal, focal, number("px") * scale + width / 2, number("py") * scale + height / 2)
    return radial_lens(size, inner, [number(key) for key in ("k1", "k2", "k3", "k4")],
                       (number("t1"), number("t2")), where)
