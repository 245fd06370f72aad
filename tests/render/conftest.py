"""One thread for every test of the rasterizer; the processes that compile numba's kernels."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
from numba_runs import Run, compile_for_avx2, damage_and_repair, read_run

from recon_cli.kernels.simd import LANES

BuildOnce = Callable[[str, Callable[[Path], object]], Path]


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Small pictures: threads that wait for each other cost more than what they compute."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def damaged_run(build_once: BuildOnce) -> Run:
    """The process that found every file of the cache cut in half."""
    return read_run(build_once("numba-damaged", damage_and_repair) / "damaged")


@pytest.fixture(scope="session")
def repaired_run(build_once: BuildOnce) -> Run:
    """The process after that one, in the same cache folder."""
    return read_run(build_once("numba-damaged", damage_and_repair) / "repaired")


@pytest.fixture(scope="session")
def avx2_run(build_once: BuildOnce) -> Run:
    """The process that compiled for a CPU with AVX2."""
    if platform.machine() not in ("x86_64", "AMD64"):
        pytest.skip("AVX2 is of x86 CPUs; this machine has another")
    if LANES == 8:
        pytest.skip("this machine computes with 8 lanes anyway: all other tests are of them")
    return read_run(build_once("numba-avx2", compile_for_avx2) / "avx2")
