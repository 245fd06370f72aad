"""Values that other programs write in their own way: found by evidence, converted, and reported.

Rows that are not finite are dropped; opacities and scales that are not logits and logarithms are
recognized by values that no trained scene has; positions far from the origin, which float32
would round by more than a Gaussian is large, are moved to it.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import FormatError
from recon_cli.scene.splat_arrays import TERMS
from recon_cli.splats.format import Origin
from recon_cli.splats.values import measure_extent

_MOST_BAD = 0.5  # of all rows; a file with more does not match its header
# Fewer Gaussians, or nearly equal opacities, are not enough evidence.
_ENOUGH, _SPREAD = 50, 0.25
# Gaussians whose centre is within one size of a place, on the mean: .003 in a trained room, but 45
# if its sizes are read as logarithms.
_COVERED = 1.0
_ROUNDING = 0.1  # of the median Gaussian's size: float32 cannot hold positions that move by more
_MOST_DEGREE = 10
_MOST_LOG_OPACITY = -1e-15  # an opacity of exactly 1 has no logit
NOT_GAUSSIANS_HINT = (
    "Give a file of Gaussians, as programs that train 3D Gaussian Splatting write it.")
FLAT = math.log(1e-6)  # log scale of a flat Gaussian, as SuperSplat sets it

logger = logging.getLogger("recon")
Columns = dict[str, NDArray[Any]]


def drop_not_finite(
    path: Path, columns: Mapping[str, NDArray[Any]],
    named: Mapping[str, NDArray[Any]] | None = None,
) -> Columns:
    """Returns columns [N, ...] without the rows that hold a NaN or an infinity, with a warning.

    `named` are the same values by the names that the file has for them. FormatError, with the count
    in each column, if these rows are more than half of all.
    """
    with np.errstate(over="ignore"):
        bad = {name: ~np.isfinite(value).all(axis=tuple(range(1, value.ndim)))
               for name, value in (named or columns).items()}
    bad = {name: rows for name, rows in bad.items() if rows.any()}
    if not bad:
        return dict(columns)
    rows = np.logical_or.reduce(list(bad.values()))
    listed = ", ".join(f"{name} ({found.sum():,})" for name, found in bad.items())
    if rows.sum() > _MOST_BAD * len(rows):
        raise FormatError(
            f"{path} holds values that are not finite in {listed}, in {rows.sum():,} of "
            f"{len(rows):,} Gaussians.",
            hint="Export it again from the program it came from.")
    logger.warning("%s: %s of %s Gaussians are left out: not finite in %s",
                   path.name, f"{rows.sum():,}", f"{len(rows):,}", listed)
    return {name: value[~rows] for name, value in columns.items()}


def count_terms(path: Path, coefficients: int) -> int:
    """Returns the terms a channel of a file with that many coefficients of degrees 1 and up.

    FormatError if that many do not fill a degree.
    """
    degrees = {3 * ((degree + 1) ** 2 - 1): degree for degree in range(_MOST_DEGREE + 1)}
    if coefficients not in degrees:
        raise FormatError(
            f"{path} has {coefficients} coefficients of spherical harmonics beside the first "
            "(f_rest); 0, 9, 24, 45 or 72, numbered from 0, fill a degree.",
            hint="Export it again from the program it came from.")
    warn_of_degree(path, degrees[coefficients])
    return coefficients // 3


def warn_of_degree(path: Path, degree: int) -> None:
    """Warns if a file has a higher degree than recon supports."""
    most = len(TERMS) - 1
    if degree > most:
        logger.warning("%s: harmonics of degree %d are cut to degree %d, so colours change a "
                       "little with the view", path.name, degree, most)


def accept_surplus(path: Path, count: int, row: float = math.inf) -> None:
    """Warns of `count` bytes after the data, which are left out; FormatError if they fill a row.

    Programs pad files or end them with a line break; a whole row means that the header is wrong.
    """
    if count >= row:
        raise FormatError(
            f"{path} holds {count:,} bytes more than its header promises, at least a Gaussian: it "
            "is damaged.", hint="Write or copy the file again.")
    if count:
        logger.warning("%s: %s bytes after its data are left out", path.name, f"{count:,}")


def add_filter(path: Path, columns: Columns, sizes: NDArray[Any]) -> None:
    """Widens Gaussians by the 3D filter of Mip-Splatting [N], in place, with a warning.

    Mip-Splatting (Yu et al. 2024, equation 9), and GOF and RaDe-GS after it, keep the filter's size
    f in `filter_3D`; they draw sizes of sqrt(s^2 + f^2), and opacities times the ratio of volumes.
    """
    before = columns["log_scales"].astype(np.float64)
    logits = columns["logit_opacities"].astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):  # a filter of 0 changes nothing
        after = np.logaddexp(2 * before, 2 * np.log(np.abs(sizes.astype(np.float64)))[:, None]) / 2
    shrunk = -np.logaddexp(0, -logits) + (before - after).sum(axis=1)  # log of the opacity
    columns["log_scales"] = after.astype(np.float32)
    columns["logit_opacities"] = (shrunk - np.log(-np.expm1(
        np.minimum(shrunk, _MOST_LOG_OPACITY)))).astype(np.float32)
    logger.warning("%s: the 3D filter of Mip-Splatting (filter_3D) is added to sizes and opacities",
                   path.name)


def undo_activations(path: Path, columns: Columns) -> Columns:
    """Returns logits and log scales of columns that may hold opacities and sizes instead."""
    values = columns["logit_opacities"]
    if len(values) < _ENOUGH:
        return columns
    changed = dict(columns)
    low, high = float(values.min()), float(values.max())
    opacities = low >= 0 and high <= 1 and high - low >= _SPREAD
    if opacities:
        inner = np.clip(values.astype(np.float64), 0.25 / 255, 254.75 / 255)
        changed["logit_opacities"] = np.log(inner / (1 - inner)).astype(np.float32)
        logger.warning(
            "%s: opacities are taken as they are, not as logits: all %s lie between %.3g and %.3g",
            path.name, f"{len(values):,}", low, high)
    scales = columns["log_scales"]
    if scales.min() >= 0 and (opacities or _covers_everything(columns["means"], scales)):
        changed["log_scales"] = np.log(np.maximum(scales, math.exp(FLAT))).astype(np.float32)
        logger.warning(
            "%s: scales are taken as they are, not as logarithms: all lie between %.3g and %.3g",
            path.name, scales.min(), scales.max())
    return changed


def _covers_everything(means: NDArray[Any], log_scales: NDArray[Any]) -> bool:
    """Returns whether many Gaussians would cover each place if these were logarithms."""
    _, radius = measure_extent(means)
    size = float(np.median(log_scales))
    return radius > 0 and math.log(len(means)) + 3 * (size - math.log(radius)) > math.log(_COVERED)


def find_origin(means: NDArray[Any], log_scales: NDArray[Any]) -> Origin | None:
    """Returns the point to subtract from positions [N, 3]; None if float32 holds them as is."""
    middle = np.median(means.astype(np.float64), axis=0)
    rounding = float(np.spacing(np.float32(np.abs(middle).max()))) / 2
    size = math.exp(float(np.median(log_scales)))
    if not _ROUNDING * size < rounding < math.inf:
        return None
    rounded = np.rint(middle)
    x, y, z = (float(value) for value in (rounded if rounded.any() else middle))
    return Origin((x, y, z), rounding, size, rounded=means.dtype == np.float32)
