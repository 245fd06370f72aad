"""Record3D: the export "EXR + RGB", and .r3d, unpacked.

rgb/<i>.jpg with depth/<i>.exr and metadata.json (often in a folder EXR_RGBD), or rgbd/<i>.jpg with
<i>.depth and <i>.conf, packed by LZFSE, and a file `metadata`. The number in a name is the place in
the lists of the metadata, and files may be missing. Poses are camera to world, ARKit's axes of the
image as it is stored, as qx qy qz qw tx ty tz in metres. The world is often that of the first
camera, so up is not known. K counts column by column and is that of the first frame; each frame may
have its own. (marek-simonik/record3d, issues 27, 33, 53, 59, 86, 95.)
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.datasets.depth_file import LIDAR_RANGE, ConfidenceFile, DepthFile
from recon_cli.datasets.frame_files import list_numbered, pose_from_quat
from recon_cli.datasets.frame_table import FrameTable, LeftOutError, read_size
from recon_cli.datasets.posed import PosedImage, PosedSet
from recon_cli.errors import FormatError
from recon_cli.scene.camera import Lens
from recon_cli.workspace.atomic import read_json


def find_record3d(folder: Path) -> tuple[Path, Path, str] | None:
    """Returns the folder, its metadata and the name of the folder of its images."""
    for place in (folder, folder / "EXR_RGBD"):
        for name, images in (("metadata", "rgbd"), ("metadata.json", "rgb")):
            if (place / name).is_file() and (place / images).is_dir():
                return place, place / name, images
    return None


def read_record3d(folder: Path) -> PosedSet:
    """Returns the frames whose image is there.

    InputError if none has a pose; FormatError if the metadata are damaged or lack poses or K.
    """
    files = find_record3d(folder)
    assert files is not None
    place, metadata, name = files
    value = read_json(metadata, dict, finite=False)
    size, depth_size = (_size(value, *keys, metadata) for keys in (("w", "h"), ("dw", "dh")))
    poses = _list(value, "poses", metadata)
    own = value.get("perFrameIntrinsicCoeffs") or []
    times = value.get("frameTimestamps") or []
    images = list_numbered(place / name)
    table = FrameTable(folder, pictures=place / name, opengl=True)
    for number, path in images.items():
        with table.frame(path.name):
            if number >= len(poses):
                raise LeftOutError("beyond the list of poses")
            viewmat = table.pose(_pose, poses[number])
            lens = table.lens(size or read_size(path), _intrinsics, value, own, number, metadata)
            table.add(PosedImage(
                path.name, path, lens, viewmat, depth=_depth(place, path, lens, depth_size),
                time=_time(times, number)))
    return table.finish_tracked(
        up=None, without_picture=len(set(range(len(poses))) - set(images)))


def _pose(row: Sequence[Any]) -> NDArray[np.float64]:
    """Returns camera to world of qx qy qz qw tx ty tz."""
    return pose_from_quat(row[:4], row[4:7])


def _intrinsics(
    value: dict[str, Any], own: Sequence[Any], number: int, metadata: Path
) -> Sequence[float]:
    """Returns fx, fy, cx, cy of a frame, for w x h."""
    if number < len(own):
        fx, fy, cx, cy = own[number][:4]
        return fx, fy, cx, cy
    k = _list(value, "K", metadata)  # old files have this alone
    if len(k) != 9:
        raise FormatError(f"{metadata} has {len(k)} numbers as K, needed 9.")
    if k[2] and k[5] and not k[6] and not k[7]:
        raise FormatError(f"{metadata} has K row by row, needed column by column.")
    return k[0], k[4], k[6], k[7]


def _depth(
    place: Path, path: Path, lens: Lens, size: tuple[int, int] | None
) -> DepthFile | None:
    """Returns the depth of an image, None where its file is missing."""
    exr, packed = place / "depth" / f"{path.stem}.exr", path.with_suffix(".depth")
    if exr.is_file():
        return DepthFile(exr, 1.0, lens, reliable=LIDAR_RANGE)
    if not packed.is_file():
        return None
    levels = path.with_suffix(".conf")
    return DepthFile(
        packed, 1.0, lens, reliable=LIDAR_RANGE, shape=size and size[::-1],
        confidence=ConfidenceFile(levels) if levels.is_file() else None)


def _size(
    value: dict[str, Any], width: str, height: str, where: Path
) -> tuple[int, int] | None:
    """Returns a size in pixels, None where old files lack it."""
    if width not in value or height not in value:
        return None
    for key in (width, height):
        number = value[key]
        if not isinstance(number, (int, float)) or not 1 <= number <= 1 << 16:
            raise FormatError(f"{where} has {key} = {number!r:.40}; needed are pixels.")
    return int(value[width]), int(value[height])


def _list(value: dict[str, Any], key: str, where: Path) -> list[Any]:
    items = value.get(key)
    if not isinstance(items, list) or not items:
        raise FormatError(f"{where} has no list of {key}.")
    return items


def _time(times: Sequence[Any], number: int) -> float | None:
    time = times[number] if number < len(times) else None
    return float(time) if isinstance(time, (int, float)) else None
