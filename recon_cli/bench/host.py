"""The machine that was measured, as far as its figures depend on it."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from recon_cli import machine
from recon_cli.bench.peak import measured_peak
from recon_cli.render.numba.lanes import LANES


@dataclass(frozen=True)
class Host:
    """A machine and its programs.

    Attributes:
        cpu: model name.
        cores: that this process may use.
        threads: that the work was given.
        lanes: float32 in a vector of the kernels.
        peak_gflops: float32 multiply-adds of one thread, measured; an addition and a
            multiplication count as two.
        device: "cpu", or the GPU's model name.
        versions: of Python and the packages.
    """

    cpu: str
    cores: int
    threads: int
    lanes: int
    peak_gflops: float
    device: str
    versions: dict[str, str]

    @property
    def line(self) -> str:
        """One line for the head of a table."""
        place = "" if self.device == "cpu" else f", {self.device}"
        return (
            f"{self.cpu}{place}, {self.threads} of {self.cores} cores, {self.lanes} lanes, peak "
            f"{self.peak_gflops:.0f} GFLOP/s a core, torch {self.versions['torch']}, "
            f"numpy {self.versions['numpy']}, Python {self.versions['python']}")


def examine(threads: int, device: str) -> Host:
    """Returns this machine with its measured peak."""
    name = torch.cuda.get_device_name() if device == "cuda" else "cpu"
    return Host(
        machine.cpu_model(), machine.usable_threads(), threads, LANES, measured_peak(), name,
        machine.versions())
