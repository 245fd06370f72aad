"""Where an axis has its ticks, and what is written at them."""

from __future__ import annotations

import math
from collections.abc import Sequence

_STEPS = (1.0, 2.0, 5.0, 10.0)  # a tick lies at a multiple of one of these and a power of ten
_NEAR_ZERO = 0.2  # of the highest value
_LEAST_DECADES = 1.0  # below, a logarithmic axis has too few round numbers and takes linear ticks


def linear_ticks(low: float, high: float, most: int = 6) -> list[float]:
    """Returns round numbers from `low` to `high`, at most `most` and at least two.

    Args:
        low: end of the axis.
        high: the other end, above `low`.
        most: how many there may be, 3 or more.
    """
    rough = (high - low) / (most - 1)
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(one * power for one in _STEPS if one * power >= rough * (1 - 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [number * step for number in range(first, last + 1)]


def log_ticks(low: float, high: float, most: int = 6) -> list[float]:
    """Returns 1, 2, 5 times powers of ten from `low` to `high`, or powers alone where many fit.

    Args:
        low: end of the axis, above 0.
        high: the other end, above `low`.
        most: how many there may be.
    """
    if math.log10(high / low) < _LEAST_DECADES:
        return [tick for tick in linear_ticks(low, high, most) if tick > 0]
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for factors in ((1, 2, 5), (1, 3), (1,)):
        ticks = [factor * 10.0 ** power for power in powers for factor in factors]
        inside = [tick for tick in ticks if low * (1 - 1e-9) <= tick <= high * (1 + 1e-9)]
        if len(inside) <= most:
            return inside
    return inside[::math.ceil(len(inside) / most)]


def widened(values: Sequence[float], *, log: bool) -> tuple[float, float]:
    """Returns the ends of an axis that holds all values with a little room, never an empty one."""
    low, high = min(values), max(values)
    if log:
        room = max((high / low) ** 0.04, 1.05)
        return low / room, high * room
    room = max(0.05 * (high - low), 1e-3 * abs(high), 1e-9)
    # counts and seconds begin at 0: an axis that begins near it begins there
    return (0.0 if 0 <= low < _NEAR_ZERO * high else low - room), high + room


def shown(value: float) -> str:
    """Returns a tick's number as short as can be read: 0.02, 1,500, 20k, 1.5M."""
    if value == 0 or abs(value) < 1e-12:
        return "0"
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e4, "k")):
        if abs(value) >= size * (1 - 1e-9):
            return f"{value / (1e3 if letter == 'k' else size):.6g}{letter}"
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.6g}"
