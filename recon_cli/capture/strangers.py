"""Which pictures of a folder show nothing that the others show: those of another scene.

Features are matched at a reduced size, and only for the few pictures that look out of place.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.capture.frame_measures import shrink
from recon_cli.capture.limits import MOST_FEATURES, TRACK_SIZE
from recon_cli.scene.matches import MAX_RATIO, MIN_PAIR_INLIERS

REACH = 2.0  # pixels between a feature and the epipolar line of its match
MOST_COMPARED = 80  # pictures that one is compared with, spread evenly

# The gray values [H, W] of a picture by index; None where it cannot be read.
Read = Callable[[int], NDArray[np.uint8] | None]


@dataclass(frozen=True, eq=False)
class _Features:
    xy: NDArray[np.float32]  # [K, 2]
    descriptors: NDArray[np.float32]  # [K, 128]


def find_strangers(suspects: Collection[int], others: Collection[int], read: Read) -> list[int]:
    """Returns those of the suspects that have nothing in common with any of the others."""
    @cache
    def features(index: int) -> _Features | None:
        gray = read(index)
        return None if gray is None else find_features(gray)

    strangers = []
    for suspect in sorted(suspects):
        nearest = sorted(others, key=lambda index: (abs(index - suspect), index))
        known = dict.fromkeys([*nearest[:4], *nearest[::max(1, len(nearest) // MOST_COMPARED)]])
        own = features(suspect)
        if own is not None and not any(
                (other := features(index)) is not None
                and count_agreeing(own, other) >= MIN_PAIR_INLIERS for index in known):
            strangers.append(suspect)
    return strangers


def find_features(gray: NDArray[np.uint8]) -> _Features:
    """Returns the SIFT features of a picture [H, W]."""
    keypoints, descriptors = cv2.SIFT.create(MOST_FEATURES).detectAndCompute(
        shrink(gray, TRACK_SIZE), None)
    if descriptors is None:
        descriptors = np.zeros((0, 128), np.float32)
    return _Features(
        np.array([keypoint.pt for keypoint in keypoints], np.float32).reshape(-1, 2),
        np.asarray(descriptors, np.float32))


def match_features(
    first: _Features, second: _Features
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Returns the places [M, 2] of matching features in two pictures of two features or more."""
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(first.descriptors, second.descriptors, k=2)
    good = [best for best, next_best in pairs if best.distance < MAX_RATIO * next_best.distance]
    good = list({match.trainIdx: match for match in good}.values())
    return (first.xy[[match.queryIdx for match in good]],
            second.xy[[match.trainIdx for match in good]])


def count_agreeing(first: _Features, second: _Features) -> int:
    """Returns how many features of two pictures match under one epipolar geometry."""
    if min(len(first.xy), len(second.xy)) < MIN_PAIR_INLIERS:
        return 0
    start, end = match_features(first, second)
    if len(start) < MIN_PAIR_INLIERS:
        return 0
    _, inside = cv2.findFundamentalMat(start, end, cv2.FM_RANSAC, REACH, 0.999, 2000)
    return 0 if inside is None else int(inside.sum())
