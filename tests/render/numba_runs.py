"""The processes that several tests of the numba backend look at; each of them runs once.

Two of them compile every kernel, some ten seconds each: the one whose cache was damaged, and the
one that compiles for a CPU with AVX2. Their machine code is read by the guard of vectorization.
The fixtures `damaged_run`, `repaired_run` and `avx2_run` (conftest.py) hold what they left.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recon_cli.kernels import kernel
from recon_cli.render.numba import backend

HERE = Path(__file__).parent
# What every CPU with AVX2 has; numba takes the name and the features together.
HASWELL = {
    "NUMBA_CPU_NAME": "haswell",
    "NUMBA_CPU_FEATURES": "+64bit,+sse,+sse2,+sse3,+ssse3,+sse4.1,+sse4.2,+popcnt,+cx16,+avx,"
                          "+avx2,+fma,+bmi,+bmi2,+lzcnt,+f16c,+movbe"}


@dataclass(frozen=True)
class Run:
    """The results of a process.

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


def start(out: Path, cache_dir: Path, **variables: str) -> None:
    """Runs numba_process with a cache folder of its own; `out` is what `read_run` reads."""
    out.mkdir()
    environment = {name: value for name, value in os.environ.items()
                   if not name.startswith("NUMBA_")}
    process = subprocess.run(
        [sys.executable, str(HERE / "numba_process.py"), str(out)],
        env=environment | {"RECON_CACHE_DIR": str(cache_dir), "OMP_NUM_THREADS": "1"} | variables,
        capture_output=True, text=True, timeout=300, check=False)
    assert process.returncode == 0, process.stderr
    (out / "stderr.txt").write_text(process.stderr, encoding="utf-8")


def read_run(out: Path) -> Run:
    """Returns what a process left in `out`."""
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    with np.load(out / "picture.npz") as arrays:
        picture = dict(arrays)
    return Run(report, picture, (out / "stderr.txt").read_text(encoding="utf-8"), out)


def damage_and_repair(folder: Path) -> None:
    """Runs a process that finds every file of the cache cut in half, and one after it."""
    cache_dir = folder / "cache"
    copy = copy_cache(cache_dir)
    files = [*copy.rglob("*.nbc")]
    assert files
    for path in files:
        os.truncate(path, path.stat().st_size // 2)
    start(folder / "damaged", cache_dir)
    start(folder / "repaired", cache_dir)


def compile_for_avx2(folder: Path) -> None:
    """Runs a process that compiles for a CPU with AVX2, from an empty cache folder."""
    start(folder / "avx2", folder / "cache", **HASWELL)


def copy_cache(target: Path) -> Path:
    """Copies this process's own cache, so that nothing is compiled for it, and returns the folder
    of the kernels."""
    backend.warm_up()
    source = kernel.cache_folder()
    if source is None:
        pytest.skip("no folder for compiled kernels, see RECON_CACHE_DIR")
    return Path(shutil.copytree(source, target / "kernels" / source.name))
