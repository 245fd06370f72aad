"""Why an image has no camera, as far as its features and matches tell."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from recon_cli.mapping.evidence import Evidence

# COLMAP gives an image a camera from 30 inliers on, and in six of eight captures 19 of 20 images
# had a fifth of their keypoints or more in the model. The fewest of any image with a camera: 450.
MIN_KEYPOINTS = 150
# Share of the median sharpness below which an image is called blurred: the bound that `recon
# ingest` sets itself (IngestConfig.sharpness).
BLURRED = 0.5


def reasons(evidence: Evidence, sharpness: Mapping[str, float | None]) -> dict[str, str]:
    """Returns a reason for every image without a camera, the most telling one of each.

    Args:
        evidence: of the model.
        sharpness: variance of the Laplacian by name; None or absent where it is not known.
    """
    known = [value for value in sharpness.values() if value is not None]
    usual = float(np.median(known)) if known else None
    return {
        evidence.names[index]: _reason(evidence, int(index), sharpness, usual)
        for index in np.flatnonzero(~evidence.registered)
    }


def _reason(
    evidence: Evidence, index: int, sharpness: Mapping[str, float | None], usual: float | None
) -> str:
    of = (evidence.pairs == index).any(axis=1)
    others = evidence.pairs[of].sum(axis=1) - index
    placed, matches = evidence.registered[others], evidence.matches[of]
    blur = _blur(sharpness.get(evidence.names[index]), usual)
    # A blurred image matches little. One that matches others well may show another room.
    if blur and matches[~placed].sum() <= matches[placed].sum():
        return f"blurred: {blur}"
    if evidence.keypoints[index] < MIN_KEYPOINTS:
        return f"too few features: {evidence.keypoints[index]} keypoints"
    if not placed.any():
        where = f", only with {len(others)} that have none" if len(others) else ""
        also = f"; {blur}" if blur else ""
        return f"no overlap: no verified match with an image that has a camera{where}{also}"
    return (f"matched but not placed: {matches[placed].sum()} matches to "
            f"{np.count_nonzero(placed)} images that have a camera")


def _blur(own: float | None, usual: float | None) -> str:
    """Returns how sharp an image is that is far less sharp than usual; empty for others."""
    if own is None or usual is None or own >= BLURRED * usual:
        return ""
    return f"sharpness {own:.0f}, {usual:.0f} is usual"
