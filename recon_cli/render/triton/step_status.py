"""The device's record while the host does not wait: which steps counted, and why not."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import triton
import triton.language as tl
from torch import Tensor

STEPS, STOPPED, NEEDED, SKIPPED, INSTANCES, LOSS = (tl.constexpr(place) for place in range(6))
_FIRST = (0.0, -1.0, 0.0, 0.0, 0.0, 0.0)
_BLOCK = 256
INFINITE = tl.constexpr(float("inf"))


@triton.jit(do_not_specialize=("count", "room"))
def admit_kernel(ends, count, room, status, starts, fits, BLOCK: tl.constexpr):
    """Lets a step continue if its instances fit into `room` and no step before it was stopped.

    Every program decides the same; the first one writes it into `fits` [1] int32. From `ends`
    [count + 1] int64, see `passes.ProjectedSplats`, come `starts` [count + 1] int32, all zero where
    the step is stopped. `record_kernel` stores the decision in `status` [6] float64.
    """
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    here = i <= count
    going = (tl.load(status + STOPPED) < 0.0) & (tl.load(ends + count) <= room)
    end = tl.load(ends + i, mask=here, other=0)
    tl.store(starts + i, tl.where(going, end, 0).to(tl.int32), mask=here)
    if tl.program_id(0) == 0:
        tl.store(fits, going.to(tl.int32))


@triton.jit(do_not_specialize=("count", "room"))
def record_kernel(ends, count, room, loss, fits, status, counted):
    """Records the result of a step in `status`; `loss` is [1] float64.

    `counted` [1] int32 out: the step has a finite loss and saw a Gaussian.
    """
    total, value = tl.load(ends + count), tl.load(loss)
    going = tl.load(fits) != 0
    finite = tl.abs(value) < INFINITE  # of NaN that is false
    steps, stopped = tl.load(status + STEPS), tl.load(status + STOPPED)
    tl.store(status + STOPPED, tl.where((stopped < 0.0) & (total > room), steps, stopped))
    tl.store(status + STEPS, steps + 1.0)
    tl.store(status + NEEDED, tl.maximum(tl.load(status + NEEDED), total.to(tl.float64)))
    skipped = tl.load(status + SKIPPED)
    tl.store(status + SKIPPED, tl.where(going & (finite == 0), skipped + 1.0, skipped))
    tl.store(status + INSTANCES, total.to(tl.float64))
    tl.store(status + LOSS, value)
    tl.store(counted, (going & finite & (total > 0)).to(tl.int32))


@dataclass(frozen=True)
class StepReport:
    """The results of the steps since the host last looked."""

    # How many were taken before one had too many instances; that one and those after it changed
    # nothing. None where all were taken.
    stopped: int | None
    needed: int  # most instances of a step
    skipped: int  # steps whose loss was not finite; they changed nothing
    instances: int  # of the last step
    loss: float  # of the last step


class StepStatus:
    """Six numbers on the device."""

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

    def close(self) -> StepReport:
        """Waits for the device, returns its record, and resets it."""
        _, stopped, needed, skipped, instances, loss = self.numbers.tolist()
        self.numbers.copy_(self._first)
        return StepReport(
            None if stopped < 0 else int(stopped), int(needed), int(skipped), int(instances), loss)


def admit_step(ends: Tensor, room: int, status: StepStatus, fits: Tensor) -> Tensor:
    """Returns the first slot [N + 1] int32 of each Gaussian; zeros where the step is stopped."""
    starts = torch.empty(len(ends), dtype=torch.int32, device=ends.device)
    admit_kernel[(triton.cdiv(len(ends), _BLOCK),)](
        ends, len(ends) - 1, room, status.numbers, starts, fits, BLOCK=_BLOCK)
    return starts


def record_step(
    ends: Tensor, room: int, loss: Tensor, fits: Tensor, status: StepStatus, counted: Tensor
) -> None:
    """Records a step, and whether it counts into `counted` [1] int32."""
    record_kernel[(1,)](ends, len(ends) - 1, room, loss, fits, status.numbers, counted)
