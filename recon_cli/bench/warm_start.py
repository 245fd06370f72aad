"""How long a fresh process waits for its kernels when they are in the cache."""

from __future__ import annotations

import subprocess
import sys

from recon_cli.bench.clock import Timing, timing_of
from recon_cli.render import registry

# torch is there anyway; its import is not counted
_SCRIPT = """
import torch, time
start = time.perf_counter()
from recon_cli.render import registry
registry.prepare("numba", lambda: None)
print(time.perf_counter() - start)
"""


def warm_start(rounds: int) -> Timing:
    """Returns the time from importing the backend to kernels that are ready, in new processes."""
    registry.prepare("numba", lambda: None)  # fills the cache
    seconds = []
    for _ in range(rounds):
        done = subprocess.run(
            [sys.executable, "-c", _SCRIPT], capture_output=True, text=True, check=True)
        seconds.append(float(done.stdout.split()[-1]))
    return timing_of([1e3 * value for value in seconds])
