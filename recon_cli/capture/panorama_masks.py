"""Masks of panoramas: the pole below the camera, and what moves along with it.

Below a panorama are the tripod, a hand, or a patch that hides them. Whoever carries the camera
stays in one place of each panorama, where colours change less from one to the next than at the same
height elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.capture.ingested_source import IngestContext
from recon_cli.capture.masks import write_mask
from recon_cli.io.images import read_png
from recon_cli.workspace import records as store

# Degrees around the lowest point. The patches in 19 panoramas of a house reach up to 24 degrees.
POLE_DEG = 25.0
SIZE = (240, 120)  # at which colours are compared
SMOOTH = 5  # pixels over which their changes are averaged
MIN_PANORAMAS = 15  # fewer look alike by chance
# Of the usual change at the same height: what certainly moves along, and what does where it adjoins
# that. Where an operator stands in two rooms it is .1 to .31, of a video .08; the lowest two
# thousandths elsewhere are .3 and .42 there, and .43 in a house without one. To compare with the
# median of all panoramas instead would not tell a lit operator from the room.
CARRIED = (0.25, 0.32)
LEAST = 60  # pixels of an area that is masked
HIGHEST_DEG = 30.0  # above the horizon; ceilings are even
GROW = 4  # pixels around it: cameras lean by some degrees


def hide_carried(stage: Path, names: Sequence[str], ctx: IngestContext) -> None:
    """Adds the pole and what moves along to the masks of panoramas in ingest's folder."""
    carried = find_carried(
        [stage / store.FOLDER / name for name in names],
        [stage / store.MASKS / name for name in names])
    if carried is not None:
        ctx.notice(
            f"{carried.mean():.0%} of each panorama is masked, because it moves along with the "
            "camera, as whoever carries it does.")
    for name in names:
        path = stage / store.MASKS / name
        height, width = read_png(stage / store.FOLDER / name).shape[:2]
        mask = pole_mask(width, height)
        if carried is not None:
            hidden = cv2.resize(carried.astype(np.float32), (width, height))
            mask[hidden > 0.5] = 0
        if path.exists():
            mask = np.minimum(mask, read_png(path)[..., 0])
        write_mask(path, mask)


def pole_mask(width: int, height: int) -> NDArray[np.uint8]:
    """Returns a mask [H, W] that hides the lowest point and what is near it: 0 there, else 255."""
    angles = 180 - (np.arange(height) + 0.5) / height * 180  # from the lowest point
    rows = np.where(angles < POLE_DEG, 0, 255).astype(np.uint8)
    return np.repeat(rows[:, None], width, axis=1)


def find_carried(
    panoramas: Sequence[Path], masks: Sequence[Path] = ()
) -> NDArray[np.bool_] | None:  # [h, w]
    """Returns where panoramas show what moves along with the camera, at `SIZE`; None if nowhere.

    They are in the order in which they were taken, as far as that is known. Where most have a mask
    that hides a place, as beyond a crop, nothing is told of it. A mask that is not there hides
    nothing.
    """
    if len(panoramas) < MIN_PANORAMAS:
        return None
    colours = np.stack([_read_colours(path) for path in panoramas])
    steps = np.median(np.abs(np.diff(colours, axis=0)), axis=0)
    change = np.sqrt((steps**2).sum(axis=2))
    wrapped = np.concatenate([change[:, -SMOOTH:], change, change[:, :SMOOTH]], axis=1)
    change = cv2.blur(wrapped, (SMOOTH, SMOOTH))[:, SMOOTH:-SMOOTH]
    hidden = _find_hidden(masks)
    usual = [np.median(row[seen]) if seen.any() else np.inf
             for row, seen in zip(change, ~hidden, strict=True)]
    share = change / np.maximum(usual, 1e-6)[:, None]
    share[hidden] = np.inf
    share[:round((90 - HIGHEST_DEG) / 180 * SIZE[1])] = np.inf
    # twice beside itself, so that an area across the seam is one
    near = np.concatenate([share, share], axis=1) < CARRIED[1]
    count, labels = cv2.connectedComponents(near.astype(np.uint8))
    sure = np.concatenate([share, share], axis=1) < CARRIED[0]
    seeds = np.bincount(labels[sure], minlength=count)
    seeds[0] = 0
    found = np.asarray((seeds >= LEAST)[labels], np.bool_)
    carried = found[:, :SIZE[0]] | found[:, SIZE[0]:]
    if not carried.any():
        return None
    grown = cv2.dilate(np.tile(carried, 3).astype(np.uint8), np.ones((2 * GROW + 1,) * 2, np.uint8))
    return np.asarray(grown[:, SIZE[0]:2 * SIZE[0]], np.bool_)


def _read_colours(path: Path) -> NDArray[np.float32]:
    """Returns the colours of a panorama, L*a*b*, reduced to `SIZE`, [h, w, 3]."""
    small = cv2.resize(read_png(path), SIZE, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.cvtColor(small.astype(np.float32) / 255, cv2.COLOR_RGB2LAB), np.float32)


def _find_hidden(masks: Sequence[Path]) -> NDArray[np.bool_]:  # [h, w]
    """Returns which places of panoramas at `SIZE` most of these masks hide, or one beside them."""
    hidden = np.zeros(SIZE[::-1])
    for path in filter(Path.exists, masks):
        small = cv2.resize(read_png(path)[..., 0], SIZE, interpolation=cv2.INTER_AREA)
        hidden += small < 255
    most = (hidden > len(masks) / 2).astype(np.uint8)
    return np.asarray(cv2.dilate(most, np.ones((SMOOTH, SMOOTH), np.uint8)), np.bool_)
