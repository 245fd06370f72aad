"""How large the frames are, and whether they fit into memory."""

from __future__ import annotations

from recon_cli.errors import ConfigError
from recon_cli.io.calibration import MAX_SIDE
from recon_cli.machine import free_memory_bytes
from recon_cli.shots.request import Request

# Of a frame with all outputs, from 1200x680 to 3000x1700 pixels: 55 with numba, 93 with torch.
_BYTES_PER_PIXEL = 100


def frame_size(width: int, height: int, request: Request) -> tuple[int, int]:
    """Returns the (width, height) of frames whose own size is `width` x `height`.

    A side that is not given follows from the other; for a video it is even.

    Raises:
        ConfigError: a side that was given is odd, but is to be that of a video.
    """
    given = (request.width, request.height)
    if request.size:
        given = (request.size, None) if width >= height else (None, request.size)
    if request.video and any(side and side % 2 for side in given):
        raise ConfigError(
            f"A video of {_words(given)} cannot be: H.264 and AV1 store the colour of two by two "
            "pixels at once, so sides are even.", hint="Give even numbers.")
    factor = _factor(given, (width, height))
    step = 2 if request.video else 1
    sides = [side or max(step, step * round(own * factor / step))
             for side, own in zip(given, (width, height), strict=True)]
    return sides[0], sides[1]


def _factor(given: tuple[int | None, int | None], own: tuple[int, int]) -> float:
    return next((side / one for side, one in zip(given, own, strict=True) if side), 1.0)


def _words(given: tuple[int | None, int | None]) -> str:
    return " by ".join(str(side) for side in given if side) + " pixels"


def refuse_what_does_not_fit(width: int, height: int) -> None:
    """Raises ConfigError unless a frame of this size can be rendered in the memory that is free."""
    needed, free = width * height * _BYTES_PER_PIXEL, free_memory_bytes()
    if needed > free or max(width, height) > MAX_SIDE:
        raise ConfigError(
            f"A picture of {width}x{height} pixels takes about {needed / 1e6:,.0f} MB to render; "
            f"{free / 1e6:,.0f} MB are free, and {MAX_SIDE:,} pixels are the longest side.",
            hint="Lower --size, or --width and --height.")
