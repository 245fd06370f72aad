"""The processes that train one model together, and what they tell each other.

Every process holds the whole state and changes it in the same way: a step's views are shared out,
and what they leave behind is added up before anybody uses it. `train.processes` holds what there
is beside the process that is alone; torch is not imported here, for who asks for help does not
wait for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

    from recon_cli.train.step import TrainView


@dataclass(eq=False)
class Ranks:
    """This process among those that train together; by itself there is but one.

    Attributes:
        rank: of this process, 0 to count - 1. The first one leads: it writes and decides.
        count: of the processes.
        local: how many of them share this machine.
        lacks_gpu: some have a GPU of their own, and some have none.
        views: the training views that all of them hold by now.
    """

    rank: int = 0
    count: int = 1
    local: int = 1
    lacks_gpu: bool = False
    views: Sequence[TrainView] = field(default=(), repr=False)

    @property
    def leads(self) -> bool:
        """Whether this process writes and decides."""
        return self.rank == 0

    @property
    def alone(self) -> bool:
        """Whether there is nobody else."""
        return self.count == 1

    def most_of(self, views: int) -> int:
        """Returns the most views that one process looks at in a step of so many."""
        return -(-views // self.count)

    def threads_of(self, cores: int) -> int:
        """Returns this process's share of the cores of its machine, at least one."""
        return max(1, cores // self.local)

    def add(self, tensors: Sequence[Tensor]) -> None:
        """Replaces tensors by their sums over all processes, the same bits in each."""

    def raise_to_most(self, tensor: Tensor) -> None:
        """Replaces the values of a tensor by the greatest of all processes."""

    def told(self, number: int) -> int:
        """Returns the number that the leader gives; the others' own does not matter."""
        return number

    def spread(self, tensor: Tensor) -> None:
        """Replaces the values of a tensor by those of the leader's."""

    def leave(self) -> None:
        """Ends the connection: whoever waits for this process hears that it is gone."""


ALONE = Ranks()
