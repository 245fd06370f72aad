"""A time by which work is to be done, handed to whatever may be left out where it does not fit."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

Clock = Callable[[], float]

_TELLING = 0.05  # share of some work after which its pace says how long all of it takes


class OutOfTime(Exception):  # noqa: N818 - an event, not an error
    """Work that may be left out would take more time than there is."""


class Deadline:
    """So many seconds from now; without a number there is no limit."""

    def __init__(self, seconds: float = math.inf, clock: Clock = time.monotonic) -> None:
        self.seconds, self._clock, self._start = seconds, clock, clock()

    @property
    def limited(self) -> bool:
        """Whether there is a limit."""
        return math.isfinite(self.seconds)

    @property
    def spent(self) -> float:
        """Seconds so far."""
        return self._clock() - self._start

    @property
    def left(self) -> float:
        """Seconds until then, negative once it has passed."""
        return self.seconds - self.spent

    def part(self, share: float) -> Deadline:
        """Returns the deadline of work that may take a share of all the seconds, from now on."""
        return Deadline(min(share * self.seconds, self.left), self._clock)

    def refuse_late(self, seconds: float) -> None:
        """Raises OutOfTime where work of so many seconds would end too late."""
        if seconds > self.left:
            raise OutOfTime

    def keep_pace(self, total: int) -> Callable[[int], None]:
        """Returns what gets the units of work done so far, of a total.

        It raises OutOfTime as soon as the rest would end too late at the pace so far.
        """
        start = self.spent

        def check(done: int) -> None:
            tells = done >= _TELLING * total
            self.refuse_late((self.spent - start) * (total - done) / done if tells else 0.0)

        return check
