"""NeRFCapture: a transforms.json in ARKit's world, with depth under depth_path.

It differs from others in its world (metres, y up), in the order of its frames, and in its depth:
instant-ngp's nerfcapture2nerf.py writes 16 bits and integer_depth_scale, the metres of a value of
1. The app itself writes depth_integer_scale and 8 bits, of which no depth can be made.
(jc211/NeRFCapture; NVlabs/instant-ngp.)
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from recon_cli.datasets.app_frames import Y_UP, LeftOut, quoted, refuse_one_pose
from recon_cli.datasets.posed import PosedImage, PosedSet
from recon_cli.datasets.transforms import read_transforms
from recon_cli.errors import InputError

_FILE = "transforms.json"
_MARKS = (b'"depth_path"', b'"integer_depth_scale"', b'"depth_integer_scale"')


def is_nerfcapture(path: Path) -> bool:
    """Returns whether a folder, or a transforms.json, was written by NeRFCapture."""
    file = path if path.is_file() else path / _FILE
    if not (file.is_file() and file.name.startswith("transforms") and file.suffix == ".json"):
        return False
    data = file.read_bytes()
    return b'"depth_file_path"' not in data and any(mark in data for mark in _MARKS)


def read_nerfcapture(path: Path) -> PosedSet:
    """Returns the frames in order of time; errors are those of a transforms.json."""
    posed = read_transforms(path)
    folder = path if path.is_dir() else path.parent
    hint = ("Give the pictures alone, so that the cameras are found from them: recon ingest "
            f"{quoted(posed.images[0].path.parent)}")
    refuse_one_pose(posed.images, folder, hint)
    left_out = LeftOut()
    images = [fitted for image in posed.images if (fitted := _fit(image, left_out)) is not None]
    if not images:
        raise InputError(
            f"{folder} has no frame that can be used: {'; '.join(left_out.notices())}.", hint=hint)
    return replace(
        posed, layout="nerfcapture", images=tuple(sorted(images, key=_order)), metric=True,
        metric_by_depth=False, sequence=True, up=Y_UP, accuracy="tracked",
        notices=(*left_out.notices(), *posed.notices))


def _fit(image: PosedImage, left_out: LeftOut) -> PosedImage | None:
    """Returns a frame with intrinsics for its size; None where they are of another shape."""
    if image.lens.model != "PINHOLE":
        return image
    lens = left_out.lens(
        image.name, (image.lens.width, image.lens.height), tuple, image.lens.params)
    if lens is None:
        return None
    return replace(image, lens=lens, depth=image.depth and image.depth.with_lens(lens))


def _order(image: PosedImage) -> tuple[float, list[tuple[int, str]]]:
    """Returns the key of a frame: its time, else its name as a person counts."""
    parts = re.split(r"(\d+)", image.name)
    return (image.time if image.time is not None else 0.0, [
        (int(part) if part.isdecimal() else -1, part) for part in parts])
