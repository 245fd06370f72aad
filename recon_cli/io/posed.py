"""Data sets that come with poses: what any layout is read into."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.scene.lens import Lens


@dataclass(frozen=True, eq=False)
class PosedImage:
    """One image whose camera is known.

    Attributes:
        name: unique within the set, as the data set names it.
        path: its file.
        lens: index into the lenses of the set.
        viewmat: [4, 4] float64 world to camera, OpenCV axes.
        held_out: the data set itself keeps it for the score.
        depth: reads z-depth, [H, W] float32 in world units, 0 where there is none; None where the
            image has no depth.
        mask: file of a mask, None where there is none.
    """

    name: str
    path: Path
    lens: int
    viewmat: NDArray[np.float64]
    held_out: bool = False
    depth: Callable[[], NDArray[np.float32]] | None = None
    mask: Path | None = None


@dataclass(frozen=True, eq=False)
class PosedSet:
    """A data set with poses.

    Attributes:
        layout: what it was taken for: "colmap", "transforms", "replica" or "scannet".
        lenses: intrinsics at the full size of the images.
        images: in the order of the data set.
        missing: images that it lists, but whose files are gone.
        metric: its unit is the metre.
        sequence: its images are frames of one walk, in order.
        splits: it says itself which images are held out.
        points: [P, 3] float64 sparse points in its world, None where it has none.
        colors: [P, 3] uint8 their RGB colours, None with them.
        notices: what the user should know about how it was read.
    """

    layout: str
    lenses: tuple[Lens, ...]
    images: tuple[PosedImage, ...]
    missing: tuple[str, ...] = ()
    metric: bool = False
    sequence: bool = False
    splits: bool = False
    points: NDArray[np.float64] | None = None
    colors: NDArray[np.uint8] | None = None
    notices: tuple[str, ...] = ()
