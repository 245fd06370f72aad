"""Pictures that hold two: of two fisheye lenses side by side, or one view for each eye.

Both look like ordinary pictures to a reader of files; a scene made of them shows the room twice.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.capture.decoded_picture import Packing
from recon_cli.capture.frame_measures import shrink
from recon_cli.capture.lens_border import LensCircle, fit_circle
from recon_cli.capture.limits import TRACK_SIZE
from recon_cli.capture.strangers import find_features, match_features
from recon_cli.scene.matches import MIN_PAIR_INLIERS

# Of a half's sides: by how much the middle of a fisheye's circle may miss that of its half.
OFF_CENTRE = 0.1
# Between the views of two eyes nothing moves up or down by more than this share of the height, and
# to the side by no more than that of the width: a thing at arm's length, eyes 65 mm apart.
PARALLAX = (0.2, 0.02)
SAME = 0.2  # of the features of a view: those that its twin shows in the same place


def has_two_circles(pictures: Sequence[NDArray[np.uint8]]) -> bool:
    """Returns whether pictures [H, W, 3] of one size show the circles of two fisheye lenses."""
    if not pictures or len({picture.shape for picture in pictures}) > 1:
        return False
    small = [shrink(picture, 2 * TRACK_SIZE).max(axis=2) for picture in pictures]
    brightest = np.asarray(np.max(small, axis=0), np.uint8)
    axis = int(brightest.shape[1] > brightest.shape[0])
    return all(_is_centred(fit_circle(half), half.shape) for half in _halves(brightest, axis))


def _is_centred(circle: LensCircle | None, shape: tuple[int, ...]) -> bool:
    """Returns whether a circle is that of a whole fisheye in a picture [h, w]."""
    if circle is None:
        return False
    height, width = shape[0], shape[1]
    side = max(width, height)
    return (abs(circle.x * side - width / 2) <= OFF_CENTRE * width
            and abs(circle.y * side - height / 2) <= OFF_CENTRE * height)


def find_two_views(pictures: Sequence[NDArray[np.uint8]]) -> Packing | None:
    """Returns how all of some pictures [H, W, 3] show one view twice; None where one does not.

    Of pictures with too little to match nothing is known; None where that are all.
    """
    for packing, axis in ((Packing.SIDE_BY_SIDE, 1), (Packing.TOP_AND_BOTTOM, 0)):
        has_evidence = False
        for picture in pictures:
            answer = _shows_twice(shrink(picture, 2 * TRACK_SIZE), axis)
            if answer is False:
                break
            has_evidence = has_evidence or answer is True
        else:
            if has_evidence:
                return packing
    return None


def _shows_twice(rgb: NDArray[np.uint8], axis: int) -> bool | None:
    """Returns whether the halves of a picture are two eyes' views; None if they show nothing."""
    first, second = (find_features(half) for half in _halves(
        np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8), axis))
    fewer = min(len(first.xy), len(second.xy))
    if fewer < MIN_PAIR_INLIERS:
        return None if fewer == len(first.xy) == len(second.xy) == 0 else False
    height, width = rgb.shape[0], rgb.shape[1]
    sides = np.array([width / 2, height] if axis else [width, height / 2])
    start, end = match_features(first, second)
    apart = np.abs(end - start) / sides
    same = int((apart <= PARALLAX).all(axis=1).sum())
    return same >= max(MIN_PAIR_INLIERS, SAME * fewer)


def _halves(pixels: NDArray[np.uint8], axis: int) -> list[NDArray[np.uint8]]:
    """Returns the top and the bottom (axis 0), or the left and the right half of a picture."""
    middle = pixels.shape[axis] // 2
    return np.split(pixels, [middle, 2 * middle], axis=axis)[:2]
