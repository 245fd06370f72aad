"""The compiling process: `python -m recon_cli.train.compile_worker BACKEND DEVICE`.

`pipeline.compile_ahead` starts it. It takes what other work leaves of the cores, writes on its
standard error alone, and does not outlive its parent.
"""

from __future__ import annotations

import sys

from recon_cli import machine
from recon_cli.processes import end_with_parent
from recon_cli.render import registry
from recon_cli.signals import leave_to_parent
from recon_cli.stereo import depths


def compile_kernels(backend: str, device: str) -> None:
    """Compiles the kernels that these options, `auto` or a name, will take, and those of stereo.

    Those for a GPU are compiled by their self-check, whose verdict is kept.
    """
    if registry.renders_on_cpu(backend, device):
        if registry.kernels_to_compile("numba"):
            registry.use_threads("numba", 1)
            registry.prepare("numba", lambda: None)
    elif backend in ("auto", "triton") and device != "cpu":
        registry.cuda_verdict()
    depths.compile_kernels()


def main() -> None:
    """Compiles for the options on the command line."""
    leave_to_parent()
    end_with_parent()
    machine.yield_to_others()
    compile_kernels(*sys.argv[1:])


if __name__ == "__main__":
    main()
