"""A tenth of the campaign of injected faults; `make faults` runs all of it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

RUN = Path(__file__).with_name("run.py")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="forks, pidfds and /proc are needed")
@pytest.mark.timeout(1800)
def test_every_fault_ends_in_the_right_result_or_a_clear_error() -> None:
    count, seed = (os.environ.get(f"RECON_FAULTS_{name}", default)
                   for name, default in (("COUNT", "100"), ("SEED", "1")))
    # A process of its own: it must start no thread, and import torch for one thread.
    done = subprocess.run(
        [sys.executable, str(RUN), "--seed", seed, "--count", count], capture_output=True,
        text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
