"""The black border around the round picture of a fisheye: found in all frames, and masked.

What a lens does not reach is black in every frame, and its rim is a circle that no motion of the
camera moves: features on it would hold cameras in place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.capture.frame_measures import shrink
from recon_cli.capture.ingested_source import IngestContext
from recon_cli.capture.masks import write_mask
from recon_cli.io.images import read_png
from recon_cli.workspace import records as store

SIZE = 256  # pixels of the longer side, at which the border is looked for
MOST_FRAMES = 16  # that are looked at, evenly spread: what is dark in all of them is border
BLACK = 24  # of 255, up to which a pixel is black in the brightest channel
CORNER = 0.02  # of the longer side: squares in the corners that are black in all frames
# Of the radius: by how much the rim may miss a circle, and what is masked inside it, where the
# picture fades.
ROUND, FADES = 0.015, 0.03
LEAST_RIM = 60  # pixels of the rim inside the frame
LEAST_BORDER = 0.03  # of the frame
# Of the pixels inside the circle that some frame shows, at least; and of those outside, at most.
LIT, STRAY = 0.9, 0.01


@dataclass(frozen=True)
class LensCircle:
    """The round picture of a fisheye, in shares of the frame's longer side."""

    x: float
    y: float
    radius: float

    def inside(self, width: int, height: int) -> NDArray[np.bool_]:  # [H, W]
        """Returns which pixels of frames of a size count: those well inside the rim."""
        side = max(width, height)
        across = (np.arange(width) + 0.5) / side - self.x
        down = (np.arange(height) + 0.5) / side - self.y
        return np.asarray(
            across[None]**2 + down[:, None]**2 < ((1 - FADES) * self.radius) ** 2)


def hide_border(
    stage: Path, names: Sequence[str], ctx: IngestContext
) -> NDArray[np.bool_] | None:  # [H, W]
    """Adds the border to the masks of frames of one size in ingest's folder, where there is one.

    Returns the pixels that it covers.
    """
    circle = find_circle([stage / store.FOLDER / name for name in names])
    if circle is None:
        return None
    height, width = read_png(stage / store.FOLDER / names[0]).shape[:2]
    counts = circle.inside(width, height)
    for name in names:
        path, mask = stage / store.MASKS / name, counts * np.uint8(255)
        if path.exists():
            mask = np.minimum(mask, read_png(path)[..., 0])
        write_mask(path, mask)
    ctx.notice(
        f"{1 - counts.mean():.0%} of each frame is masked: the black border around the round "
        "picture of a fisheye lens. --overlays keep leaves it in.")
    return ~counts


class BorderMeter:
    """Takes the gray frames of a sequence, one by one, and tells their border from darkness."""

    def __init__(self) -> None:
        self._brightest: NDArray[np.uint8] | None = None
        self._filled = False  # some corner is lit

    def advance(self, gray: NDArray[np.uint8]) -> None:  # [H, W]
        """Takes a frame; all are of one size."""
        if self._filled:
            return
        small = shrink(gray, SIZE)
        self._brightest = (small if self._brightest is None
                           else np.maximum(self._brightest, small))
        self._filled = not _has_black_corners(self._brightest)

    def without_border(self, exposures: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns exposures [F, 3], by `measure_exposure`, of what lies inside the border alone."""
        circle = None if self._filled or self._brightest is None else fit_circle(self._brightest)
        if circle is None:
            return exposures
        height, width = self._brightest.shape if self._brightest is not None else (1, 1)
        inside = float(circle.inside(width, height).mean())
        black, blown, spread = exposures.T
        return np.column_stack([
            np.clip((black - (1 - inside)) / inside, 0, 1), np.clip(blown / inside, 0, 1), spread])


def find_circle(frames: Sequence[Path]) -> LensCircle | None:
    """Returns the round picture in frames of one size; None where they fill their corners."""
    brightest: NDArray[np.uint8] | None = None
    for path in frames[::max(1, -(-len(frames) // MOST_FRAMES))]:
        small = _read_small(path)
        brightest = small if brightest is None else np.maximum(brightest, small)
        if not _has_black_corners(brightest):
            return None
    return None if brightest is None else fit_circle(brightest)


def fit_circle(brightest: NDArray[np.uint8]) -> LensCircle | None:  # [h, w]
    """Returns the circle outside which nothing is lit; None where that is not a circle."""
    lit = cv2.morphologyEx(
        (brightest > BLACK).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    contours, _ = cv2.findContours(lit, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not contours:
        return None
    height, width = lit.shape
    rim = max(contours, key=cv2.contourArea)[:, 0].astype(np.float64) + 0.5
    rim = rim[((rim > 2) & (rim < [width - 2, height - 2])).all(axis=1)]
    if len(rim) < LEAST_RIM:
        return None
    # Kasa's fit: |p|^2 = 2 c p + r^2 - |c|^2
    left = np.column_stack([2 * rim, np.ones(len(rim))])
    x, y, rest = np.linalg.lstsq(left, (rim**2).sum(axis=1), rcond=None)[0]
    radius = float(np.sqrt(max(rest + x * x + y * y, 0.0)))
    off = np.linalg.norm(rim - [x, y], axis=1) - radius
    if radius == 0 or np.sqrt((off**2).mean()) > ROUND * radius + 0.5:
        return None
    across, down = np.meshgrid(np.arange(width) + 0.5 - x, np.arange(height) + 0.5 - y)
    away = np.hypot(across, down) / radius
    border, inner = away > 1 + FADES, away < 1 - FADES
    if border.mean() < LEAST_BORDER or lit[inner].mean() < LIT or lit[border].mean() > STRAY:
        return None
    side = max(width, height)
    return LensCircle(float(x) / side, float(y) / side, radius / side)


def _read_small(path: Path) -> NDArray[np.uint8]:  # [h, w]
    """Returns the brightest channel of a frame, reduced."""
    return np.asarray(shrink(read_png(path), SIZE).max(axis=2), np.uint8)


def _has_black_corners(image: NDArray[np.uint8]) -> bool:
    edge = max(2, round(CORNER * max(image.shape)))
    corners = (image[:edge, :edge], image[:edge, -edge:], image[-edge:, :edge],
               image[-edge:, -edge:])
    return all(int(corner.max()) <= BLACK for corner in corners)
