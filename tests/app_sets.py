"""Small captures in the layouts of scanning apps and photogrammetry, of a room with exact poses.

The writers follow what the apps write, and share no code with the readers. `shots` takes frames of
the rendered office (z up, metres, OpenCV's axes); a writer puts them into the world and the axes of
its app, of which the table says where it lies.
"""

import dataclasses

import numpy as np
from app_shots import ARKIT
from phone_writers import (
    arkit_scenes,
    nerfcapture,
    polycam,
    quest,
    r3d,
    record3d,
    rtabmap,
    scanner_app,
    stray,
)
from solved_writers import bundler, llff, metashape, opensfm, reality_scan, rig


@dataclasses.dataclass(frozen=True)
class App:
    name: str  # of the layout
    write: object  # (folder, shots)
    world: object = None  # [4, 4] from the true world to that of the files; None: relative
    up: tuple | None = (0.0, 0.0, 1.0)
    metric: bool = True
    depth: bool = True
    accuracy: str = "tracked"
    own: bool = True  # each frame has its own intrinsics
    cameras: int = 1  # images of each shot


IDENTITY = np.eye(4)
Y = (0.0, 1.0, 0.0)
APPS = {
    "polycam": App("polycam", polycam, ARKIT, Y),
    "record3d": App("record3d", record3d, None, None),
    "r3d": App("record3d", r3d, None, None),
    "stray": App("stray", stray, ARKIT, Y),
    "nerfcapture": App("nerfcapture", nerfcapture, ARKIT, Y),
    "3dscannerapp": App("3dscannerapp", scanner_app, ARKIT, Y),
    "arkitscenes": App("arkitscenes", arkit_scenes, IDENTITY),
    "rtabmap": App("rtabmap", rtabmap, IDENTITY),
    "realityscan": App("realityscan", reality_scan, IDENTITY, metric=False, depth=False,
                        accuracy="solved"),
    "metashape": App("metashape", metashape, IDENTITY, depth=False, accuracy="solved"),
    "bundler": App("bundler", bundler, IDENTITY, None, metric=False, depth=False,
                    accuracy="solved", own=False),
    "opensfm": App("opensfm", opensfm, IDENTITY, metric=False, depth=False, accuracy="solved"),
    "llff": App("llff", llff, IDENTITY, None, metric=False, depth=False, accuracy="solved",
                 own=False),
    "colmap rig": App("colmap", rig, IDENTITY, None, metric=False, depth=False,
                       accuracy="solved", own=False, cameras=2),
    "quest": App("quest", quest, ARKIT, Y, depth=False, own=False, cameras=2),
}
