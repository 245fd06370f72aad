"""The scale by which the depth of posed images fits their poses, and what it is then in.

Points of one image's depth are seen from another one and compared with the depth there, at all
scales; where a set has points, depth is compared with these first. Every view or pair gives an
estimate of its own, and their scatter says how sure all of them are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.datasets.posed import PosedImage
from recon_cli.errors import FormatError
from recon_cli.io.calibration import undistort_pixels
from recon_cli.io.depth_maps import LEAST_POINTS, MEDIAN, MOST_NOISE
from recon_cli.scene.camera import Lens
from recon_cli.scene.statistics import LEAST_SAMPLE, MIN_OBSERVATIONS, robust_sigma

# Units of a stored value, in metres: what cameras and data sets write.
_UNITS = {
    1.0: "metres", 1e-3: "millimetres", 1e-4: "1/10000 m", 1 / 4000: "1/4000 m",
    1 / 5000: "1/5000 m", 1 / 6553.5: "1/6553.5 m"}
# Neighbouring units are 25% apart, so that a scale this near to one is near to no other.
_FITS = 0.1
_SURE = _FITS / 2  # standard error of the logarithm of a scale: two of them stay within _FITS
_STARTS, _RANKS = 12, 7  # images that are compared, with the 1st, 2nd, 4th to 64th nearest others
# Pairs whose cameras are apart by these shares of the depth, and look alike: of less a phone's
# error of a centimetre is too large a part, and beyond it little is seen by both.
_MOVED, _MOST_TURNED_DEG = (0.2, 1.0), 40.0
_GRID = 40  # samples a side of a depth map
_STEPS, _FINE = 9, np.geomspace(0.8, 1.25, 21)  # of the scales that are tried: 22%, then 2%
# A scale shows, or is better than another one, if the other's error is this many times its own.
CLEARLY_WORSE = 1.5
# Relative errors, as a median. Depth as it is has 1% in two rendered rooms with 1% of noise, and 3%
# in a phone's recording of a door; in another order of rows or columns it has 5 to 26%.
_GOOD, _CLEARLY = 0.03, 1 / 3

Turn = Callable[[NDArray[np.float32]], NDArray[np.float32]]
_AS_READ: Turn = lambda depth: depth  # noqa: E731
_ORDERS: dict[str, Turn] = {
    "upside down": lambda depth: depth[::-1],
    "with left and right swapped": lambda depth: depth[:, ::-1]}


@dataclass(frozen=True, eq=False)
class DepthView:
    """Depth, not all of it 0, and the camera that it is of."""

    depth: NDArray[np.float32]  # [h, w] as it is read
    lens: Lens  # of the depth
    viewmat: NDArray[np.float64]


@dataclass(frozen=True)
class DepthFit:
    """How depth fits the poses."""

    factor: float = 1.0  # by which it is to be multiplied
    shown: bool = False  # whether the poses, or points, show that it fits so
    fault: str = ""  # why it is not to be used, as part of a sentence
    words: str = ""  # what a factor other than 1 means
    contradicts: bool = False  # the fault may be that of the poses


class _Estimate(NamedTuple):
    scale: float  # by which depth fits
    errors: Callable[[NDArray[np.float64]], NDArray[np.float64]]  # relative, at scales


def fit_depth(
    images: Sequence[PosedImage], points: NDArray[np.float64] | None = None
) -> DepthFit:
    """Returns how the depth of images fits their poses, or the points [P, 3] of their world.

    Depth as it is read is right if nothing shows its scale, as where cameras do not move.
    """
    images = [image for image in images if image.depth is not None]
    viewmats = [image.viewmat for image in images]

    @cache
    def read(at: int) -> DepthView | None:
        return _read(images[at])

    sources = [_ask_pairs(viewmats, read, _AS_READ),
               [] if points is None else _ask_points(points, map(read, _spread(len(images))))]
    sources = [estimates for estimates in sources if len(estimates) >= MIN_OBSERVATIONS]
    for estimates in sources:
        scale = _combine(estimates)
        if scale is not None and not _find_order(viewmats, read, _error(estimates, scale)):
            assert images[0].depth is not None
            return _name(estimates, scale, images[0].depth.unit)
    as_read = min((_error(estimates, 1.0) for estimates in sources), default=np.inf)
    if words := _find_order(viewmats, read, as_read):
        return DepthFit(fault=words)
    if sources and as_read > MOST_NOISE:
        return DepthFit(fault="it fits the poses in no unit", contradicts=True)
    return DepthFit()


def _name(estimates: Sequence[_Estimate], scale: float, unit: float) -> DepthFit:
    """Returns what a scale means for depth that is read with a unit."""
    own = min(_UNITS, key=lambda one: abs(np.log(scale * unit / one)))
    as_read = _error(estimates, 1.0)
    if _is_near(scale, own / unit) and not _is_near(own / unit, 1.0) and (
            as_read >= CLEARLY_WORSE * _error(estimates, own / unit)):
        return DepthFit(own / unit, True, words=f"in {_UNITS[own]}, not in {_describe(unit)}")
    if _is_near(scale, 1.0) or as_read < CLEARLY_WORSE * _error(estimates, scale):
        return DepthFit(shown=_is_near(scale, 1.0))
    return DepthFit(fault=f"it would fit the poses with values about {scale:.2g} times as large, "
                    "which is no usual unit")


def _describe(unit: float) -> str:
    return next((words for own, words in _UNITS.items() if abs(unit / own - 1) < 1e-3),
                f"units of {unit:.4g}")


def _is_near(scale: float, other: float) -> bool:
    return abs(scale / other - 1) <= _FITS


def _combine(estimates: Sequence[_Estimate]) -> float | None:
    """Returns the median scale, None where the estimates are too far apart to be sure of it."""
    logs = np.log([estimate.scale for estimate in estimates])
    middle = float(np.median(logs))
    # of the median of a normal distribution
    spread = 1.2533 * robust_sigma(logs - middle) / np.sqrt(len(logs))
    scale = float(np.exp(middle))
    return scale if spread <= _SURE and _error(estimates, scale) <= MOST_NOISE else None


def _error(estimates: Sequence[_Estimate], scale: float) -> float:
    """Returns the relative error at a scale, as a median."""
    return float(np.median([estimate.errors(np.array([scale]))[0] for estimate in estimates]))


def _find_order(
    viewmats: Sequence[NDArray[np.float64]], read: Callable[[int], DepthView | None], error: float
) -> str:
    """Returns the fault of depth whose rows or columns are in another order, empty if none is."""
    if error <= _GOOD:
        return ""
    for words, turn in _ORDERS.items():
        turned = _ask_pairs(viewmats, read, turn)
        if len(turned) >= MIN_OBSERVATIONS and (scale := _combine(turned)) and _error(
                turned, scale) <= min(_GOOD, _CLEARLY * error):
            return f"it would fit the poses {words}"
    return ""


def compare_views(views: Sequence[DepthView]) -> float:
    """Returns how far depth from different places is apart, relatively, as a median."""
    viewmats = [view.viewmat for view in views]
    errors = []
    for at in _spread(len(views)):
        least = _MOVED[0] * float(np.median(views[at].depth[views[at].depth > 0]))
        other = next(_list_partners(viewmats, at, least), None)
        if other is not None:
            errors += list(_compare(views[at], views[other], _AS_READ, np.ones(1)))
    known = [error for error in errors if np.isfinite(error)]
    return float(np.median(known)) if len(known) >= max(1, len(errors) // 2) else np.inf


def _spread(count: int) -> list[int]:
    """Returns the places of some items, evenly spread."""
    return sorted({int(at) for at in np.linspace(0, count - 1, _STARTS)}) if count else []


def _ask_points(
    points: NDArray[np.float64], views: Iterator[DepthView | None]
) -> list[_Estimate]:
    """Returns the scale of the depth of each view by points that it sees, most of them."""
    estimates = []
    for view in views:
        if view is None:
            continue
        local = points @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
        there = _look_up(view, local)
        ratios = there[there > 0] / local[there > 0, 2]
        if len(ratios) >= LEAST_POINTS:
            estimates.append(_Estimate(
                1 / float(np.median(ratios)), partial(_compare_ratios, ratios)))
    return estimates


def _compare_ratios(
    ratios: NDArray[np.float64], scales: NDArray[np.float64]
) -> NDArray[np.float64]:
    return np.asarray(np.median(np.abs(np.outer(scales, ratios) - 1), axis=1))


def _ask_pairs(
    viewmats: Sequence[NDArray[np.float64]], read: Callable[[int], DepthView | None], turn: Turn
) -> list[_Estimate]:
    """Returns the scale by which the depth of an image fits that of another, where it shows.

    Of each image the farthest other one is asked that shows it.
    """
    estimates = []
    for at in _spread(len(viewmats)):
        one = read(at)
        if one is None:
            continue
        for partner in reversed([*_list_partners(viewmats, at)]):
            other = read(partner)
            estimate = None if other is None else _fit_pair(one, other, turn)
            if estimate is not None:
                estimates.append(estimate)
                break
    return estimates


def _list_partners(
    viewmats: Sequence[NDArray[np.float64]], at: int, least: float = 0.0
) -> Iterator[int]:
    """Yields other cameras that look alike and moved by so much, ever farther away."""
    motions = np.stack(viewmats) @ np.linalg.inv(viewmats[at])
    moved = np.linalg.norm(motions[:, :3, 3], axis=1)
    alike = motions[:, 2, 2] >= np.cos(np.radians(_MOST_TURNED_DEG))
    order = [int(other) for other in np.argsort(moved, kind="stable")
             if alike[other] and moved[other] > 0 and moved[other] >= least]
    for rank in range(_RANKS):
        if 1 << rank <= len(order):
            yield order[(1 << rank) - 1]


def _read(image: PosedImage) -> DepthView | None:
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
    lens = image.depth.own_lens(*depth.shape[::-1])
    return DepthView(cv2.medianBlur(depth, MEDIAN), lens, image.viewmat)


def _fit_pair(one: DepthView, other: DepthView, turn: Turn) -> _Estimate | None:
    """Returns the scale that fits a pair best, None if others fit it about as well."""
    moved = float(np.linalg.norm((other.viewmat @ np.linalg.inv(one.viewmat))[:3, 3]))
    scales = moved / float(np.median(one.depth[one.depth > 0])) * np.geomspace(
        1 / _MOVED[1], 1 / _MOVED[0], _STEPS)
    compare = partial(_compare, one, other, turn)
    best = scales[np.argmin(compare(scales))] * _FINE
    errors = compare(best)
    at = int(np.argmin(errors))
    scale = float(best[at])
    # clearly better than half and twice of it
    beside = compare(scale * np.array([0.5, 2.0]))
    if not 0 < at < len(best) - 1 or not (beside >= CLEARLY_WORSE * errors[at]).all():
        return None
    return _Estimate(scale, compare)


def _compare(
    one: DepthView, other: DepthView, turn: Turn, scales: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns the median relative error [S] of depth that one image predicts for another.

    It is infinite at scales [S] at which too little is seen by both.
    """
    depth = turn(one.depth)
    height, width = depth.shape
    rows, columns = (axis.ravel() for axis in np.meshgrid(
        np.linspace(0, height - 1, min(_GRID, height)).astype(int),
        np.linspace(0, width - 1, min(_GRID, width)).astype(int), indexing="ij"))
    rays = undistort_pixels(one.lens, np.column_stack([columns, rows]) + 0.5)
    z = depth[rows, columns].astype(np.float64)
    good = (z > 0) & np.isfinite(rays).all(axis=1)
    points = np.column_stack([rays[good] * z[good, None], z[good]])
    motion = other.viewmat @ np.linalg.inv(one.viewmat)
    seen = scales[:, None, None] * (points @ motion[:3, :3].T) + motion[:3, 3]
    there = DepthView(turn(other.depth), other.lens, other.viewmat)
    depths = _look_up(there, seen) * scales[:, None]
    errors = np.full(len(scales), np.inf)
    for at, (expected, actual) in enumerate(zip(seen[..., 2], depths, strict=True)):
        known = actual > 0
        if known.sum() >= max(1, min(LEAST_SAMPLE, len(rows) // 4)):
            errors[at] = np.median(np.abs(expected[known] / actual[known] - 1))
    return errors


def _look_up(view: DepthView, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the depth of a view where its camera sees points [..., 3], 0 where it does not.

    Distortion is left out: it moves few pixels to another surface.
    """
    camera = view.lens.pinhole(np.eye(4))
    depths = np.zeros(points.shape[:-1])
    rows, column, line, _ = camera.find_visible(points.reshape(-1, 3))
    depths.reshape(-1)[rows] = view.depth[line, column]
    return depths
