"""The processes that train one model together, and what they tell each other.

Every process holds the whole state and changes it in the same way: a step's views are shared out,
and what they leave behind is added up before anybody uses it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Ranks:
    """This process among those that train together; by itself there is but one.

    Attributes:
        rank: of this process, 0 to count - 1. The first one leads: it writes and decides.
        count: of the processes.
    """

    rank: int = 0
    count: int = 1

    @property
    def leads(self) -> bool:
        """Whether this process writes and decides."""
        return self.rank == 0

    @property
    def alone(self) -> bool:
        """Whether there is nobody else."""
        return self.count == 1

    def add(self, tensors: Sequence[Tensor]) -> None:
        """Replaces tensors by their sums over all processes, the same bits in each."""

    def raise_to_most(self, tensor: Tensor) -> None:
        """Replaces the values of a tensor by the greatest of all processes."""

    def told(self, number: int) -> int:
        """Returns the number that the leader gives; the others' own does not matter."""
        return number


ALONE = Ranks()
