"""A process that adds up tensors with a test, and keeps the sums."""

import os
import sys

import torch
from safetensors.torch import save_file

from recon_cli.train.distributed.process_group import TorchProcessGroup


def numbers(rank):
    """Tensors of every kind that are added: few numbers and many, and none."""
    generator = torch.Generator().manual_seed(rank)
    sizes = [(7,), (3, 4), (70_000, 2), (0, 3), (1,)]
    tensors = [torch.randn(*size, generator=generator) for size in sizes]
    return [*tensors, tensors[0].double() / 3, torch.arange(5) + rank]


if __name__ == "__main__":
    ranks = TorchProcessGroup.join()
    tensors = numbers(ranks.rank)
    ranks.add(tensors)
    save_file({str(i): tensor for i, tensor in enumerate(tensors)},
              f"{sys.argv[1]}/sums-{os.environ['RANK']}.safetensors")
    ranks.leave()
