"""How much of a frame the sensor could not tell: black, blown out, or flat all over.

Four phone and rendered videos stay under .18 black, .11 blown out and over a spread of 22, frames
against a bright window among them (a dim entry, a bedroom, two rooms).
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import InputError

# Gray values of 8 bits; a codec moves true black and white by a few.
BLACK, BLOWN_OUT = 16, 250
# More than this and the frame is clipped: it is passed over where neighbours are better.
MOST_CLIPPED = 0.5
# More than this and nothing in the frame can be matched: it is never taken.
ALL_CLIPPED = 0.95
# A frame whose areas differ by less than this many gray values (standard deviation) is flat: a
# lens cap, a wall that fills the view. Noise is averaged out before.
FLAT = 4.0
AREAS = 32  # along each side
EVERY = 4  # pixels; a share is known well enough from every 16th


def exposure(
    gray: NDArray[np.uint8],  # [H, W]
) -> tuple[float, float, float]:
    """Returns the share of black pixels, that of blown-out ones, and the spread of the rest.

    The spread is the standard deviation over 32x32 areas, in gray values of 8 bits.
    """
    few = gray[::EVERY, ::EVERY]
    areas = cv2.resize(gray, (AREAS, AREAS), interpolation=cv2.INTER_AREA)
    return float(np.mean(few <= BLACK)), float(np.mean(few >= BLOWN_OUT)), float(areas.std())


def well_exposed(
    exposures: NDArray[np.float64],  # [F, 3], rows of `exposure`
) -> NDArray[np.bool_]:  # [F]
    """Returns which frames are neither black nor blown out for the most part."""
    return np.asarray(exposures[:, :2].sum(axis=1) <= MOST_CLIPPED)


def telling(
    exposures: NDArray[np.float64],  # [F, 3], rows of `exposure`
) -> NDArray[np.bool_]:  # [F]
    """Returns which frames show anything at all: neither all clipped nor flat."""
    seen = exposures[:, :2].sum(axis=1) <= ALL_CLIPPED
    return np.asarray(seen & (exposures[:, 2] >= FLAT))


def check_exposure(
    name: str,
    exposures: NDArray[np.float64],  # [F, 3], rows of `exposure`
    *,
    least: int,
    unit: str = "frames",
) -> None:
    """Raises InputError when too few frames show anything, and says what is wrong with most.

    Args:
        name: of the capture, for the message.
        exposures: of all frames that could be read.
        least: how many must show something.
        unit: what the capture consists of, for the message.

    Raises:
        InputError: with what is wrong with most of them.
    """
    shown = int(telling(exposures).sum())
    if shown >= least:
        return
    black, blown, _ = exposures.T
    kinds: Sequence[tuple[str, NDArray[np.bool_], str]] = (
        ("too dark", black > MOST_CLIPPED, "Turn on the light, take off the lens cap, and record "
         "again; a dark but clean recording can be brightened in an editor first."),
        ("over-exposed", blown > MOST_CLIPPED, "Record again with less exposure: tap on a bright "
         "part of the room before you start."),
        ("flat", ~telling(exposures), "Record again with furniture, edges and texture in view; "
         "bare walls cannot be reconstructed."),
    )
    kind, hit, hint = next((one for one in kinds if one[1].sum() * 2 > len(black)), kinds[-1])
    raise InputError(
        f"{name} is {kind}: so are {int(hit.sum())} of its {len(black)} {unit}. Only {shown} show "
        f"anything that can be matched, but at least {least} are needed.", hint=hint)
