"""Whether the depth of posed images fits their poses: in another unit, or upside down, it does not.

Points of one image's depth are seen from another one, and compared with the depth there. Units and
the order of rows are tried; what fits clearly better than the depth as it is read shows the fault.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from recon_cli.datasets.posed import PosedImage
from recon_cli.errors import FormatError
from recon_cli.io.calibration import undistort_pixels
from recon_cli.scene.camera import Lens

# Pairs whose cameras are apart by this share of the depth, and look alike: a smaller motion shows
# no scale, and of others little is seen by both.
_LEAST_MOVED, _MOST_TURNED_DEG = 0.2, 40.0
_PAIRS, _TRIES = 12, 30  # pairs that are compared; images after each that are tried, ever farther
_GRID = 40  # samples a side of a depth map
_FEWEST = 100  # samples of a pair that both see
_SCALES = np.geomspace(1e-3, 1e3, 61)  # steps of 26%, half of which the least motion shows by 2.6%
# Relative errors, as a median. In two rendered rooms with 1% of noise and the drift of a phone,
# depth as it is has 1.3%, in another unit or order 8 to 43%; in a phone's recording of a door 2.3%.
# A fault is told if it exceeds the first, and something else stays below the second and a third.
_POOR, _GOOD, _CLEARLY = 0.05, 0.03, 3.0
# A scale that is right is better than one this many times as large, by this factor.
_NEXT, _CLEARER = 3.0, 1.5

Turn = Callable[[NDArray[np.float32]], NDArray[np.float32]]
_ORDERS: dict[str, Turn] = {
    "": lambda depth: depth, "upside down": lambda depth: depth[::-1],
    "with left and right swapped": lambda depth: depth[:, ::-1]}


Item = TypeVar("Item")


@dataclass(frozen=True, eq=False)
class View:
    """Depth, not all of it 0, and the camera that it is of."""

    depth: NDArray[np.float32]  # [h, w] as it is read
    lens: Lens  # of the depth
    viewmat: NDArray[np.float64]


def find_fault(images: Sequence[PosedImage]) -> str:
    """Returns what would make depth fit the poses, in words; empty if it fits, or nothing does."""
    pairs = _choose_pairs(images)
    if not pairs:
        return ""
    as_read = _error(pairs, 1.0, _ORDERS[""])
    if not as_read > _POOR:
        return ""
    errors = {(scale, words): _error(pairs, scale, turn)
              for words, turn in _ORDERS.items() for scale in (_SCALES if not words else (1.0,))}
    (scale, words), best = min(errors.items(), key=lambda item: item[1])
    if not best < min(_GOOD, as_read / _CLEARLY):
        return ""
    # Of what is far enough, no motion shows: such a scale fits anything as well as a larger one.
    if not words and _error(pairs, scale * _NEXT, _ORDERS[""]) < _CLEARER * best:
        return ""
    return words or f"with values about {scale:.2g} times as large"


def compare_views(views: Sequence[View]) -> float:
    """Returns how far depth from different places is apart, relatively, as a median."""
    pairs = _pair_up(list(views), [view.viewmat for view in views], lambda view: view)
    return _error(pairs, 1.0, _ORDERS[""]) if pairs else np.inf


def _choose_pairs(images: Sequence[PosedImage]) -> list[tuple[View, View]]:
    """Returns pairs of images with depth that see the same from different places."""
    with_depth = [image for image in images if image.depth is not None]
    return _pair_up(with_depth, [image.viewmat for image in with_depth], _read)


def _pair_up(
    items: Sequence[Item], viewmats: Sequence[NDArray[np.float64]],
    read: Callable[[Item], View | None],
) -> list[tuple[View, View]]:
    last = len(items) - 1
    starts = sorted({int(at) for at in np.linspace(0, last, 2 * _PAIRS)}) if last > 0 else []
    pairs: list[tuple[View, View]] = []
    for start in starts:
        one = read(items[start])
        if one is None or len(pairs) == _PAIRS:
            continue
        typical = float(np.median(one.depth[one.depth > 0]))
        for step in sorted({int(at) for at in np.geomspace(1, max(last - start, 1), _TRIES)}):
            at = min(start + step, last)
            if _sees_alike(one.viewmat, viewmats[at], typical):
                view = read(items[at])
                if view is not None:
                    pairs.append((one, view))
                break
    return pairs


def _sees_alike(one: NDArray[np.float64], other: NDArray[np.float64], depth: float) -> bool:
    """Returns whether cameras differ in place by enough of a depth, and hardly in direction.

    The depth may be in another unit, so that a motion counts that is large by any unit or little.
    """
    motion = other @ np.linalg.inv(one)
    turned = np.degrees(np.arccos(np.clip(motion[2, 2], -1, 1)))
    moved = float(np.linalg.norm(motion[:3, 3]))
    return bool(turned <= _MOST_TURNED_DEG and moved >= _LEAST_MOVED * min(depth, 2.0))


def _read(image: PosedImage) -> View | None:
    """Returns the depth of an image where it is certain; None where it is damaged or empty."""
    assert image.depth is not None
    try:
        depth, levels = image.depth.read(), image.depth.read_confidence()
    except FormatError:  # told where it is written
        return None
    if levels is not None:
        depth[levels == 0] = 0
    if not depth.any():
        return None
    return View(depth, image.depth.own_lens(*depth.shape[::-1]), image.viewmat)


def _error(pairs: Sequence[tuple[View, View]], scale: float, turn: Turn) -> float:
    """Returns the median error over pairs; infinite where too little is seen by both."""
    found = [_compare(one, other, scale, turn) for one, other in pairs]
    known = [error for error in found if np.isfinite(error)]
    return float(np.median(known)) if len(known) >= max(1, len(pairs) // 2) else np.inf


def _compare(one: View, other: View, scale: float, turn: Turn) -> float:
    """Returns the median relative error of depth that one image predicts for another."""
    depth, there = turn(one.depth), turn(other.depth)
    height, width = depth.shape
    rows, columns = (axis.ravel() for axis in np.meshgrid(
        np.linspace(0, height - 1, min(_GRID, height)).astype(int),
        np.linspace(0, width - 1, min(_GRID, width)).astype(int), indexing="ij"))
    rays = undistort_pixels(one.lens, np.column_stack([columns, rows]) + 0.5)
    z = depth[rows, columns].astype(np.float64) * scale
    good = (z > 0) & np.isfinite(rays).all(axis=1)
    points = np.column_stack([rays[good] * z[good, None], z[good]])
    motion = other.viewmat @ np.linalg.inv(one.viewmat)
    seen = points @ motion[:3, :3].T + motion[:3, 3]
    seen = seen[seen[:, 2] > 0]
    fx, fy, cx, cy = _pinhole(other.lens)
    u = np.floor(seen[:, 0] / seen[:, 2] * fx + cx).astype(int)
    v = np.floor(seen[:, 1] / seen[:, 2] * fy + cy).astype(int)
    inside = (u >= 0) & (v >= 0) & (u < there.shape[1]) & (v < there.shape[0])
    expected, found = seen[inside, 2], there[v[inside], u[inside]].astype(np.float64) * scale
    known = found > 0
    if known.sum() < min(_FEWEST, len(rows) // 4):
        return np.inf
    return float(np.median(np.abs(expected[known] / found[known] - 1)))


def _pinhole(lens: Lens) -> tuple[float, float, float, float]:
    """Returns fx, fy, cx, cy without distortion, which moves few pixels to another surface."""
    params = lens.params if len(lens.params) > 3 else (lens.params[0], *lens.params)
    return params[0], params[1], params[2], params[3]
