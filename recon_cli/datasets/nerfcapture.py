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

from recon_cli.datasets.frame_table import FrameTable
from recon_cli.datasets.posed import PosedImage, PosedSet
from recon_cli.datasets.transforms import read_transforms

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
    table = FrameTable(path if path.is_dir() else path.parent,
                       pictures=posed.images[0].path.parent)
    for image in sorted(posed.images, key=_order):
        with table.frame(image.name):
            lens = image.lens
            if lens.model == "PINHOLE":
                lens = table.lens((lens.width, lens.height), tuple, lens.params)
            table.add(replace(image, lens=lens))
    table.notices += posed.notices
    return replace(table.finish_tracked(), splits=posed.splits, missing=posed.missing,
                   points=posed.points, colors=posed.colors)


def _order(image: PosedImage) -> tuple[float, list[tuple[int, str]]]:
    """Returns the key of a frame: its time, else its name as a person counts."""
    parts = re.split(r"(\d+)", image.name)
    return (image.time if image.time is not None else 0.0, [
        (int(part) if part.isdecimal() else -1, part) for part in parts])
