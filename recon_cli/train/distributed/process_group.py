"""Processes that torch.distributed connects: gloo on the CPU, NCCL on GPUs, no pickling."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta

import torch
import torch.distributed as dist
from torch import Tensor

from recon_cli.context import ProcessGroup
from recon_cli.errors import BackendError, LostError

# The others wait while the leader maps a capture; a lost process is noticed by its connection
_PATIENCE = timedelta(days=7)
_SMALL = 1 << 16  # numbers; sending fewer costs about as much as sending one


@dataclass(eq=False)
class TorchProcessGroup(ProcessGroup):
    """One of torchrun's processes; all call the same methods, which may raise LostError."""

    @staticmethod
    def join() -> TorchProcessGroup:
        """Returns this process once all are there, by what torchrun put in the environment.

        Raises:
            BackendError: they cannot be connected.
        """
        own = int(os.environ["LOCAL_RANK"])
        gpus = torch.cuda.device_count() if torch.cuda.is_available() else 0
        if own < gpus:  # pragma: no cover
            torch.cuda.set_device(own)
        by_nccl = gpus > 0 and dist.is_nccl_available()
        try:
            dist.init_process_group("cpu:gloo,cuda:nccl" if by_nccl else "gloo", timeout=_PATIENCE)
        except (RuntimeError, ValueError) as error:
            raise BackendError(
                f"The processes cannot be connected: {error}.",
                hint="Start them with torchrun, and name the network with GLOO_SOCKET_IFNAME where "
                "there are several.") from error
        group = TorchProcessGroup(
            dist.get_rank(), dist.get_world_size(), int(os.environ["LOCAL_WORLD_SIZE"]))
        has_and_lacks = torch.tensor([own < gpus, own >= gpus], dtype=torch.int64)
        group.all_reduce_max(has_and_lacks)
        group.lacks_gpu = bool(has_and_lacks.all())
        return group

    def add(self, tensors: Sequence[Tensor]) -> None:
        """Replaces tensors by their sums over all processes, the same bits in each."""
        small: dict[tuple[torch.dtype, torch.device], list[Tensor]] = {}
        for tensor in tensors:
            if tensor.numel() > _SMALL:
                with _catch_lost():
                    dist.all_reduce(tensor)
            else:
                small.setdefault((tensor.dtype, tensor.device), []).append(tensor)
        for several in small.values():
            flat = torch.cat([tensor.reshape(-1) for tensor in several])
            with _catch_lost():
                dist.all_reduce(flat)
            for tensor in several:
                tensor.copy_(flat[: tensor.numel()].view_as(tensor))
                flat = flat[tensor.numel() :]

    def all_reduce_max(self, tensor: Tensor) -> None:
        """Replaces the values of a tensor by the greatest of all processes."""
        with _catch_lost():
            dist.all_reduce(tensor, dist.ReduceOp.MAX)

    def broadcast_int(self, number: int) -> int:
        """Returns the number that the leader gives; the others' own does not matter."""
        word = torch.tensor([number], dtype=torch.int64)
        self.broadcast(word)
        return int(word)

    def broadcast(self, tensor: Tensor) -> None:
        """Replaces the values of a tensor by those of the leader's."""
        with _catch_lost():
            dist.broadcast(tensor, 0)

    def leave(self) -> None:
        """Ends the connection: whoever waits for this process hears that it is gone."""
        if dist.is_initialized():
            dist.destroy_process_group()


@contextmanager
def _catch_lost() -> Iterator[None]:
    """Raises LostError where a process is gone."""
    if not dist.is_initialized():
        raise _lost()
    try:
        yield
    except RuntimeError as error:
        raise _lost() from error


def _lost() -> LostError:
    return LostError(
        "A process that trained along is gone, or cannot be reached.",
        hint="Its own message says why. Run the same command again; it goes on from the last "
        "checkpoint.")
