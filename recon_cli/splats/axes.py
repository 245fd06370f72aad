"""Axes of splat files by the directions of x, y and z, and the way into the axes of recon.

A name such as "rdf" is read as x right, y down, z front. Those that have up or down on y are turned
into "rdf", the axes of a .ply, whose up is -y; those that have it on z into "rfu", whose up is z.
Only signs change. The numbers are those of the extension 0xADBE0003 of SPZ
(https://github.com/nianticlabs/spz, `CoordinateSystem`).
"""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from recon_cli.scene.splat_arrays import SplatArrays

# By number, from 1 on, as of its release 3; drafts had the last eight in another order.
AXES = ("ldb", "rdb", "lub", "rub", "ldf", "rdf", "luf", "ruf",
        "lfd", "rfd", "lfu", "rfu", "lbd", "rbd", "lbu", "rbu")
PLY, Z_UP = "rdf", "rfu"
# The axes in which the terms of degrees 1 to 3 are odd: as many factors of a mirrored one as -1.
_ODD = ("y", "z", "x", "xy", "yz", "", "xz", "", "y", "xyz", "y", "z", "x", "z", "x")
# Unit vectors of the axes that can be up in a file, by name.
UP = {"z": (0.0, 0.0, 1.0), "-y": (0.0, -1.0, 0.0), "y": (0.0, 1.0, 0.0)}


def nearest_up(up: NDArray[np.float64]) -> str:
    """Returns z, -y or y, whichever is nearest to a unit vector [3]."""
    return max(UP, key=lambda name: float(np.dot(UP[name], up)))


def up_comment(up: str | None) -> str:
    """Returns the text by which files whose format has no field for it say which axis is up."""
    return "recon" if up is None else f"recon up={up}"


def read_up_comment(text: str) -> str | None:
    """Returns the axis in a text of `up_comment`; None if there is none, or it is another text."""
    found = re.fullmatch(r"recon up=(z|-y|y)", text)
    return found[1] if found else None


def up_of(axes: str) -> str:
    """Returns the axis that is up once a scene of these axes is in those of recon: -y or z."""
    return "-y" if axes[1] in "du" else "z"


def turn_from(axes: str, splats: SplatArrays) -> SplatArrays:
    """Returns Gaussians of a file with these axes in "rdf", or "rfu" if their up is along z."""
    return flip(splats, signs(axes))


def signs(axes: str) -> list[int]:
    """Returns the factor of each axis, 1 or -1, that leads to "rdf" or "rfu"."""
    ours = PLY if up_of(axes) == "-y" else Z_UP
    return [1 if theirs == own else -1 for theirs, own in zip(axes, ours, strict=True)]


def flip(splats: SplatArrays, signs: list[int]) -> SplatArrays:
    """Returns the Gaussians with each axis times a sign [3], without rounding."""
    if signs == [1, 1, 1]:
        return splats
    x, y, z = signs
    of_axis = dict(zip("xyz", signs, strict=True))
    parity = [math.prod(of_axis[name] for name in odd) for odd in _ODD]
    return replace(
        splats, means=splats.means * np.array(signs, np.float32),
        sh_rest=splats.sh_rest * np.array(
            parity[:splats.sh_rest.shape[1]], np.float32)[:, None],
        # an axial vector: mirroring one axis turns the other way about the other two
        quats=splats.quats * np.array([1, y * z, x * z, x * y], np.float32))
