"""Finds what moves: regions of a view that contradict what other views show of the same surfaces.

A person who walks through is in few views, and behind him the others see the room. Where a model of
the room explains the others but not this view, this view shows something else. Errors of the model
itself do not count: it errs alike in all views of a surface.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.evaluation.reference_views import render_view
from recon_cli.io.images import reduce_to
from recon_cli.render.surface_depth import render_surface
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats
from recon_cli.scene.statistics import MIN_OBSERVATIONS, OUTLIER_SIGMAS, at_least
from recon_cli.scene.train_view import TrainView
from recon_cli.stereo.depths import COMPARED, unproject
from recon_cli.train.parts.part import SEARCH_SIDE

_SHARED = 0.15  # of a view's surface that another must see to be one of them
_GRID = 6  # pixels from one to the next that are looked at to tell that
_TOLERANCE = 0.06  # of a depth, within which two views see the same surface
_SMOOTH = 1.0  # pixels, standard deviation: small errors of poses do not count
# Pixels that two of them reach: from the middle of a region to its border at least, as edges of
# things are thin, and what a region is widened by.
_MARGIN = round(2 * _SMOOTH)
_DARK = 0.06  # brightness from which a pixel tells the gain of a view
# A region begins where the contradiction is beyond all noise and ends where it is no more. Noise is
# the capture's own: the median over all pixels of all views.
# The brightness of the one and of the other: at least, and in noises.
_STRONG, _WEAK = (0.10, 8.0), (0.025, OUTLIER_SIGMAS)
_TELLS = 0.04  # brightness; shadows begin faintly: what is fainter only adds to a region
_AREA = 0.004  # of a view's pixels; smaller regions are errors of the model
# Half of a region must be this many times beyond the spread of the others, who must agree. After a
# short run it was 15 and more for 40 made people and 30 for a monitor that shows something else
# (desk_monitors), up to 10.8 for gloss, windows, vignettes and poor surfaces in nine captures.
SURE, _SPREAD_FLOOR = 12.0, 0.001
# A tenth of it must stand out clearly: shadows of whoever films stay below .21 (fox), people had
# more than .3. And half of it must be visible to so many others.
_CLEAR, _WITNESSES = 0.22, 4
_REACH = 0.12  # of the longer side: a faint part is no farther from a strong one
_ALONE = 0.8  # of _CLEAR: what a view errs by where it contradicts others
# Share of the views of a surface that may show something else there. Where more do, as at a window
# or a mirror, it is the model that is wrong.
_FEW = 0.5
_TOO_NOISY = 0.03  # noise of a model that is too poor to tell: two walks of three such had errors

Error = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class ComparedView:
    """A view beside the render of a model."""

    camera: Camera
    error: Error  # [H, W, 3] photo minus render after the best gain, smoothed; 0 where ignored
    depth: NDArray[np.float32]  # [H, W] of the model's surface, world units; 0 where there is none
    counts: NDArray[np.bool_]  # [H, W] False where a mask ignores the photo


def compare_view(
    splats: Splats, view: TrainView, sh_degree: int, backend: str, *, side: int = SEARCH_SIDE
) -> ComparedView:
    """Returns a view, reduced to `side` pixels, beside its render."""
    small = reduce_to(view, side)
    rgb = render_view(splats, small.camera, sh_degree, backend).rgb.cpu().numpy()
    depth = render_surface(splats, small.camera, backend=backend).depth.cpu().numpy()
    photo = (small.image / 255).astype(np.float32)
    counts = np.ones(photo.shape[:2], np.bool_) if small.mask is None else small.mask
    error = (photo - rgb * _median_gain(rgb, photo, counts)) * counts[..., None]
    return ComparedView(
        small.camera, _smooth(np.asarray(error, np.float32)), np.asarray(depth, np.float32), counts)


def _median_gain(
    rgb: NDArray[np.float32], photo: NDArray[np.float32], counts: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Returns the gain [3] of a view that a third of other content does not change."""
    tells = counts & (rgb.min(axis=2) > _DARK) & (photo.min(axis=2) > _DARK)
    if not tells.any():
        return np.ones(3, np.float32)
    return np.asarray(np.median(photo[tells] / rgb[tells], axis=0), np.float32)


def _smooth(error: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(cv2.GaussianBlur(error, (0, 0), _SMOOTH), np.float32)


def find_overlapping(
    own: ComparedView, views: Sequence[ComparedView], most: int = COMPARED
) -> NDArray[np.int64]:
    """Returns which of `views` see the surface of another view, spread evenly over the capture."""
    pixels = _grid(own.depth)
    if not len(pixels):
        return np.empty(0, np.int64)
    where = unproject(own.camera, own.depth, pixels)
    shares = np.array([0.0 if other is own else float(np.mean(sees(other, where)))
                       for other in views])
    good = np.flatnonzero(shares >= _SHARED)
    spread = np.unique(np.linspace(0, len(good) - 1, min(most, len(good))).round().astype(int))
    return np.asarray(good[spread], np.int64)


def _grid(depth: NDArray[np.float32]) -> NDArray[np.int64]:
    height, width = depth.shape
    rows, columns = np.mgrid[_GRID // 2:height:_GRID, _GRID // 2:width:_GRID]
    pixels = (rows * width + columns).reshape(-1)
    return np.asarray(pixels[depth.reshape(-1)[pixels] > 0], np.int64)


def _project(
    camera: Camera, where: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Returns column and line, from the centre of the first pixel, and depth of places [N, 3]."""
    pixels, depths = camera.project(where)
    column, line = (np.nan_to_num(pixels, nan=-1) - 0.5).astype(np.float32).T
    return column, line, depths.astype(np.float32)


def sees(view: ComparedView, where: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Returns which places [N, 3] are on the surface that a view sees, and count there."""
    column, line, depth = _project(view.camera, where)
    u, v = (np.rint(np.clip(item, -2, 1 << 20)).astype(np.int64) for item in (column, line))
    inside = (depth > 0) & (u >= 0) & (v >= 0) & (
        u < view.camera.width) & (v < view.camera.height)
    u, v = np.where(inside, u, 0), np.where(inside, v, 0)
    surface = view.depth[v, u]
    return np.asarray(
        inside & view.counts[v, u] & (np.abs(depth - surface) < _TOLERANCE * depth))


@dataclass(frozen=True, eq=False)
class Contradiction:
    """How much a view differs from what others show of the same surfaces."""

    # [H, W] error beyond the others' median error, 0 to 1; where too few see the surface, all of it
    amount: NDArray[np.float32]
    spread: NDArray[np.float32]  # [H, W] how far the others differ from their median
    visible: NDArray[np.int64]  # [H, W] others that see the surface


def contradict(
    views: Sequence[ComparedView], own: ComparedView, others: NDArray[np.int64],
    candidates: NDArray[np.bool_],
) -> Contradiction:
    """Returns how `own` contradicts those of `views` that `others` names, in some pixels [H, W]."""
    height, width = own.depth.shape
    pixels = np.flatnonzero((own.depth.reshape(-1) > 0) & candidates.reshape(-1))
    amount = (_length(own.error) * candidates).reshape(-1)
    spread = np.zeros(height * width, np.float32)
    witnesses = np.zeros(height * width, np.int64)
    if not len(pixels) or not len(others):
        return Contradiction(amount.reshape(height, width), spread.reshape(height, width),
                             witnesses.reshape(height, width))
    where = unproject(own.camera, own.depth, pixels)
    errors = np.full((len(others), len(pixels), 3), np.inf, np.float32)
    for row, index in zip(errors, others, strict=True):
        other = views[index]
        visible = sees(other, where)
        column, line, _ = _project(other.camera, where[visible])
        row[visible] = _sample(other.error, column, line)
    count = np.isfinite(errors[..., 0]).sum(axis=0)
    has_evidence = count >= MIN_OBSERVATIONS
    errors, rows = errors[:, has_evidence], (count[has_evidence] - 1) // 2
    middle = _median(errors, rows)
    mine = own.error.reshape(-1, 3)[pixels[has_evidence]]
    amount[pixels[has_evidence]] = np.sqrt(np.square(mine - middle).mean(axis=1))
    spread[pixels[has_evidence]] = _median(np.abs(errors - middle).mean(axis=2), rows)
    witnesses[pixels] = count
    amount[~own.counts.reshape(-1)] = 0
    return Contradiction(amount.reshape(height, width), spread.reshape(height, width),
                         witnesses.reshape(height, width))


def _median(values: NDArray[np.float32], rows: NDArray[np.int64]) -> NDArray[np.float32]:
    """Returns the lower median [N, ...] of values [K, N, ...]; what is missing is infinite."""
    ranked = np.sort(values, axis=0)
    return np.asarray(ranked[rows, np.arange(values.shape[1])], np.float32)


def _sample(
    image: NDArray[np.float32], column: NDArray[np.float32], line: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Returns the values [N, 3] of an image between its pixels."""
    if not len(column):
        return np.empty((0, 3), np.float32)
    across = 1 << 14  # OpenCV takes no longer lines
    rows = -(-len(column) // across)
    padded = np.zeros((2, rows * across), np.float32)
    padded[0, :len(column)], padded[1, :len(column)] = column, line
    u, v = padded.reshape(2, rows, across)
    values = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values.reshape(-1, 3)[:len(column)], np.float32)


def noise_level(views: Sequence[ComparedView]) -> float:
    """Returns the error that half of the pixels of a capture stay below, 0 to 1."""
    values = np.concatenate([_length(view.error)[view.counts] for view in views])
    return float(np.median(values)) if len(values) else 0.0


def _length(error: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(np.sqrt(np.square(error).mean(axis=-1)), np.float32)


def find_candidates(view: ComparedView, noise: float) -> NDArray[np.bool_]:
    """Returns where a view differs enough from its render to be compared with others, [H, W].

    What moves errs by itself about as much as it contradicts others, so that most regions of most
    views need no look at the others.
    """
    error = _length(view.error)
    strong, weak = _thresholds(error, noise)
    result = np.zeros(weak.shape, np.bool_)
    for region in _components(weak):
        if _is_large(region, strong) and np.quantile(
                error[region & (error >= _TELLS)], 0.9) >= _ALONE * _CLEAR:
            result |= region
    return np.asarray(cv2.dilate(result.astype(np.uint8), _disc(_MARGIN)) > 0)


def _thresholds(
    beyond: NDArray[np.float32], noise: float
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Returns where an error is strong, and where it is weak or strong."""
    strong = _morphed(beyond > at_least(_STRONG, noise), cv2.MORPH_OPEN, 1)
    weak = strong | (beyond > at_least(_WEAK, noise))
    return strong, _morphed(weak, cv2.MORPH_CLOSE, 2)


def _components(mask: NDArray[np.bool_]) -> list[NDArray[np.bool_]]:
    """Returns the connected parts of a mask that are large and thick."""
    small = mask.astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(small, connectivity=4)
    inside = cv2.distanceTransform(small, cv2.DIST_L2, 3)
    return [region for label in range(1, count)
            if stats[label, cv2.CC_STAT_AREA] >= _AREA * mask.size
            and inside[region := labels == label].max() >= _MARGIN]


def _is_large(region: NDArray[np.bool_], strong: NDArray[np.bool_]) -> bool:
    return bool(np.count_nonzero(region & strong) >= _AREA * region.size / 4)


def find_regions(
    contradiction: Contradiction, noise: float, agreed: float = SURE
) -> NDArray[np.bool_]:
    """Returns where a view shows what moves, [H, W]: connected, large and contradicted."""
    strong, weak = _thresholds(contradiction.amount - OUTLIER_SIGMAS * contradiction.spread, noise)
    ratio = contradiction.amount / (contradiction.spread + _SPREAD_FLOOR)
    result = np.zeros(weak.shape, np.bool_)
    for region in _components(weak):
        # what others do not see belongs to a region that they contradict, and makes none
        has_evidence = (region & (contradiction.visible >= MIN_OBSERVATIONS)
                        & (contradiction.amount >= _TELLS))
        if (_is_large(has_evidence, strong)
                and np.median(ratio[has_evidence]) >= agreed
                and np.quantile(contradiction.amount[has_evidence], 0.9) >= _CLEAR
                and np.median(contradiction.visible[has_evidence]) >= _WITNESSES):
            reach = round(_REACH * max(region.shape))
            near = cv2.dilate((has_evidence & strong).astype(np.uint8), _disc(reach)) > 0
            result |= region & near
    return np.asarray(cv2.dilate(result.astype(np.uint8), _disc(_MARGIN)) > 0)


def drop_common(
    views: Sequence[ComparedView], others: Mapping[int, NDArray[np.int64]],
    regions: Sequence[NDArray[np.bool_]],
) -> list[NDArray[np.bool_]]:
    """Returns the regions of each view without those that most views of the same surface have."""
    kept = []
    for own, (view, region) in enumerate(zip(views, regions, strict=True)):
        result = region.copy()
        count, labels = cv2.connectedComponents(region.astype(np.uint8), connectivity=4)
        for label in range(1, count):
            part = labels == label
            if _common(views, view, others[own], regions, part) > _FEW:
                result[part] = False
        kept.append(result)
    return kept


def _common(
    views: Sequence[ComparedView], own: ComparedView, others: NDArray[np.int64],
    regions: Sequence[NDArray[np.bool_]], part: NDArray[np.bool_],
) -> float:
    """Returns in what share of the other views of its surface a part of a view is in a region."""
    pixels = np.flatnonzero(part.reshape(-1) & (own.depth.reshape(-1) > 0))
    where = unproject(own.camera, own.depth, pixels)
    seen = inside = 0
    for index in others:
        other = views[index]
        visible = where[sees(other, where)]
        column, line, _ = _project(other.camera, visible)
        seen += len(visible)
        inside += int(regions[index][np.rint(line).astype(int), np.rint(column).astype(int)].sum())
    return inside / max(1, seen)


def _morphed(mask: NDArray[np.bool_], how: int, radius: int) -> NDArray[np.bool_]:
    return np.asarray(cv2.morphologyEx(mask.astype(np.uint8), how, _disc(radius)) > 0)


def _disc(radius: int) -> NDArray[np.uint8]:
    size = 2 * radius + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), np.uint8)


def find_moving(
    views: Sequence[ComparedView], witnesses: Sequence[ComparedView] | None = None, *,
    agreed: float = SURE,
) -> list[NDArray[np.bool_]]:
    """Returns where each view shows what moves, [H, W]: it contradicts `witnesses`, or the others.

    Nowhere where the model is too poor to tell. `agreed` is how far beyond the spread of the others
    a region must be.
    """
    others = views if witnesses is None else witnesses
    regions = [np.zeros(view.depth.shape, np.bool_) for view in views]
    noise = noise_level(others)
    if noise > _TOO_NOISY:
        return regions
    candidates = {row: where for row, view in enumerate(views)
                if (where := find_candidates(view, noise)).any()}
    partners = {row: find_overlapping(views[row], others) for row in candidates}
    for row, where in candidates.items():
        found = contradict(others, views[row], partners[row], where)
        regions[row] = find_regions(found, noise, agreed)
    if witnesses is not None:
        return regions
    return drop_common(views, partners, regions)
