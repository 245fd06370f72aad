"""The processes that several tests of the numba backend look at; each of them runs once.

Two of them compile every kernel, some ten seconds each: the one whose cache was damaged, and the
one that compiles for a CPU with AVX2. Their machine code is read by the guard of vectorization.
"""

from __future__ import annotations

import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recon_cli.render.numba import kernel, warm
from recon_cli.render.numba.simd import LANES

HERE = Path(__file__).parent
# What every CPU with AVX2 has; numba takes the name and the features together.
HASWELL = {
    "NUMBA_CPU_NAME": "haswell",
    "NUMBA_CPU_FEATURES": "+64bit,+sse,+sse2,+sse3,+ssse3,+sse4.1,+sse4.2,+popcnt,+cx16,+avx,"
                          "+avx2,+fma,+bmi,+bmi2,+lzcnt,+f16c,+movbe"}


@dataclass(frozen=True)
class Run:
    """What a process left.

    Attributes:
        report: of numba_process.
        picture: image, gradients and statistics by name.
        stderr: all that it logged.
        folder: with the machine code of what it compiled, KERNEL.s.
    """

    report: dict[str, Any]
    picture: dict[str, np.ndarray]
    stderr: str
    folder: Path


def run(cache_dir: Path, **variables: str) -> Run:
    """Runs numba_process with a cache folder of its own."""
    out = Path(tempfile.mkdtemp(dir=_base()))
    environment = {name: value for name, value in os.environ.items()
                   if not name.startswith("NUMBA_")}
    done = subprocess.run(
        [sys.executable, str(HERE / "numba_process.py"), str(out)],
        env=environment | {"RECON_CACHE_DIR": str(cache_dir), "OMP_NUM_THREADS": "1"} | variables,
        capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    with np.load(out / "picture.npz") as arrays:
        picture = dict(arrays)
    return Run(report, picture, done.stderr, out)


@cache
def after_damage() -> Run:
    """Returns the run that found every file of the cache cut in half."""
    return run(_damaged_cache())


@cache
def after_repair() -> Run:
    """Returns the run after `after_damage`, in the same cache folder."""
    return run(Path(after_damage().report["folder"]).parents[1])


@cache
def for_avx2() -> Run:
    """Returns the run that compiled for a CPU with AVX2, from an empty cache folder."""
    if platform.machine() not in ("x86_64", "AMD64"):
        pytest.skip("AVX2 is of x86 CPUs; this machine has another")
    if LANES == 8:
        pytest.skip("this machine computes with 8 lanes anyway: all other tests are of them")
    return run(_base() / "avx2", **HASWELL)


@cache
def _holder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="recon-numba-")  # deleted when the tests end


def _base() -> Path:
    return Path(_holder().name)


def _damaged_cache() -> Path:
    """Copies this process's own cache, so that nothing is compiled for it, and cuts the files."""
    warm.warm_up()
    source = kernel.cache_folder()
    if source is None:
        pytest.skip("there is no place to keep compiled kernels, see RECON_CACHE_DIR")
    target = _base() / "damaged"
    shutil.copytree(source, target / "kernels" / source.name)
    files = [*target.rglob("*.nbc"), *target.rglob("*.nbi")]
    assert files
    for path in files:
        os.truncate(path, path.stat().st_size // 2)
    return target
