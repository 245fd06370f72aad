"""What the device writes down while the host does not look: whether steps counted, and why not."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import triton
import triton.language as tl
from torch import Tensor

STEPS, STOPPED, NEEDED, SKIPPED, SEEN, LOSS = (tl.constexpr(place) for place in range(6))
_FIRST = (0.0, -1.0, 0.0, 0.0, 0.0, 0.0)
INFINITE = tl.constexpr(float("inf"))


@triton.jit(do_not_specialize=("count", "room"))
def admit(ends, count, room, ledger, starts, fits, BLOCK: tl.constexpr):
    """Lets a step go on if its instances fit and no step before it was stopped.

    Every program decides the same; the first one writes it down in `note`.

    Args:
        ends: [N + 1] int64, see `lists.Projected`.
        count: N.
        room: instances that there is memory for.
        ledger: [6] float64, see `Ledger`.
        starts: [N + 1] int32 out; all zero where the step is stopped.
        fits: [1] int32 out.
        BLOCK: numbers a program.
    """
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    here = i <= count
    going = (tl.load(ledger + STOPPED) < 0.0) & (tl.load(ends + count) <= room)
    end = tl.load(ends + i, mask=here, other=0)
    tl.store(starts + i, tl.where(going, end, 0).to(tl.int32), mask=here)
    if tl.program_id(0) == 0:
        tl.store(fits, going.to(tl.int32))


@triton.jit(do_not_specialize=("count", "room"))
def note(ends, count, room, loss, fits, ledger, counted):
    """Writes down what became of a step.

    Args:
        ends: as in `admit`, and so on.
        count: N.
        room: instances that there is memory for.
        loss: [1] float64.
        fits: [1] int32.
        ledger: [6] float64, changed.
        counted: [1] int32 out: the step has a finite loss and saw a Gaussian.
    """
    total, value = tl.load(ends + count), tl.load(loss)
    going = tl.load(fits) != 0
    finite = tl.abs(value) < INFINITE  # of NaN that is false
    steps, stopped = tl.load(ledger + STEPS), tl.load(ledger + STOPPED)
    tl.store(ledger + STOPPED, tl.where((stopped < 0.0) & (total > room), steps, stopped))
    tl.store(ledger + STEPS, steps + 1.0)
    tl.store(ledger + NEEDED, tl.maximum(tl.load(ledger + NEEDED), total.to(tl.float64)))
    skipped = tl.load(ledger + SKIPPED)
    tl.store(ledger + SKIPPED, tl.where(going & (finite == 0), skipped + 1.0, skipped))
    tl.store(ledger + SEEN, total.to(tl.float64))
    tl.store(ledger + LOSS, value)
    tl.store(counted, (going & finite & (total > 0)).to(tl.int32))


@dataclass(frozen=True)
class Account:
    """What became of the steps since the host last looked.

    Attributes:
        stopped: how many of them happened before one had too many instances; that one and those
            after it changed nothing. None where all happened.
        needed: most instances of a step.
        skipped: steps whose loss was not finite; they changed nothing.
        seen: instances of the last step.
        loss: of the last step.
    """

    stopped: int | None
    needed: int
    skipped: int
    seen: int
    loss: float


class Ledger:
    """Six numbers on the device.

    Args:
        device: where.
    """

    def __init__(self, device: torch.device) -> None:
        self.numbers = torch.tensor(_FIRST, dtype=torch.float64).to(device)
        self._first = self.numbers.clone()

    @property
    def going(self) -> Tensor:
        """[] bool on the device: no step was stopped since the host last looked."""
        return self.numbers[STOPPED.value] < 0

    @property
    def skipped(self) -> Tensor:
        """[] float64 on the device: steps since then whose loss was not finite."""
        return self.numbers[SKIPPED.value]

    @property
    def loss(self) -> Tensor:
        """[] float64 on the device: of the last step."""
        return self.numbers[LOSS.value]

    def close(self) -> Account:
        """Waits for the device, returns what it wrote, and begins anew."""
        _, stopped, needed, skipped, seen, loss = self.numbers.tolist()
        self.numbers.copy_(self._first)
        return Account(
            None if stopped < 0 else int(stopped), int(needed), int(skipped), int(seen), loss)


def admitted(ends: Tensor, room: int, ledger: Ledger, fits: Tensor) -> Tensor:
    """Returns the first slot [N + 1] int32 of each Gaussian; zeros where the step is stopped."""
    starts = torch.empty(len(ends), dtype=torch.int32, device=ends.device)
    admit[(triton.cdiv(len(ends), _BLOCK),)](
        ends, len(ends) - 1, room, ledger.numbers, starts, fits, BLOCK=_BLOCK)
    return starts


def noted(
    ends: Tensor, room: int, loss: Tensor, fits: Tensor, ledger: Ledger, counted: Tensor
) -> None:
    """Writes down a step, and whether it counts into `counted` [1] int32."""
    note[(1,)](ends, len(ends) - 1, room, loss, fits, ledger.numbers, counted)


_BLOCK = 256
