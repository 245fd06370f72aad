"""What processes send each other in a step, timed before a run: no view is looked at for that."""

from __future__ import annotations

import statistics
import time
from dataclasses import replace

import torch

from recon_cli.scene.splats import TERMS
from recon_cli.train.cost import CostModel
from recon_cli.train.gathered import Gathered
from recon_cli.train.ranks import Ranks

EXCHANGE = 2  # what the leader says to have one timed
_FEW, _MANY = 1000, 100_000  # Gaussians, at least and at most
_ROUNDS, _WARM = 7, 2
_WIDTHS = 3, 4, 3, 1, 3  # numbers of a Gaussian, parameter by parameter, higher SH apart


def with_exchange(
    cost: CostModel, ranks: Ranks, most: int, sh_degree: int, device: torch.device
) -> CostModel:
    """Returns the cost of steps that `ranks` take together, from that of one process's share.

    Args:
        cost: of steps with the views of one process.
        ranks: led by this process; the others wait for a word.
        most: Gaussians of the run.
        sh_degree: of the run.
        device: where the tensors live.
    """
    if ranks.alone:
        return cost
    begin = time.perf_counter()
    many = min(_MANY, max(2 * _FEW, most))
    low, high = (_led(ranks, n, TERMS[sh_degree], device) for n in (_FEW, many))
    each = max(0.0, (high - low) / ((many - _FEW) / 1000))
    fixed = max(0.0, low - each * _FEW / 1000)
    levels = tuple(
        replace(one, fixed_ms=one.fixed_ms + fixed, each_ms=one.each_ms + each)
        for one in cost.levels)
    return replace(cost, levels=levels, seconds=cost.seconds + time.perf_counter() - begin)


def _led(ranks: Ranks, count: int, terms: int, device: torch.device) -> float:
    try:
        ranks.told(EXCHANGE)
        for number in (count, terms, int(device.type == "cuda")):
            ranks.told(number)
        return _exchange_ms(ranks, count, terms, device)
    except BaseException:  # the others are in the middle of it, and hear of nothing else
        ranks.leave()
        raise


def join_exchange(ranks: Ranks) -> None:
    """Takes part in an exchange that the leader times."""
    count, terms, on_gpu = (ranks.told(0) for _ in range(3))
    _exchange_ms(ranks, count, terms, torch.device("cuda" if on_gpu else "cpu"))


def _exchange_ms(ranks: Ranks, count: int, terms: int, device: torch.device) -> float:
    """Returns the median of what a step with so many Gaussians exchanges."""
    gradients = [torch.zeros(count, width, device=device) for width in (*_WIDTHS, 3 * terms)]
    found, gathered = torch.zeros(11, dtype=torch.float64), Gathered.zeros(count, device)
    marks = []
    for _ in range(_ROUNDS + _WARM + 1):
        marks.append(time.perf_counter())
        ranks.told(0)
        ranks.add(gradients)
        ranks.add([found])
        gathered.over(ranks)
        float(gathered.radius[0])  # waits for a GPU
    return 1e3 * statistics.median(
        end - start for start, end in zip(marks[_WARM:], marks[_WARM + 1 :], strict=False))
