"""`recon bench`: checks what was asked for, measures once, then prints tables and writes files."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from recon_cli import machine
from recon_cli.errors import ConfigError
from recon_cli.experiments import bench_report
from recon_cli.experiments.bench_measure import BenchPlan, measure
from recon_cli.experiments.bench_result import (
    BenchResult,
    check_comparable,
    comparison_table,
    machine_difference,
    read_record,
)
from recon_cli.experiments.host import examine, warm_start
from recon_cli.experiments.outputs import OutputFiles
from recon_cli.experiments.synthetic_room import QUICK, SIZES
from recon_cli.progress import Progress
from recon_cli.render import registry

_ROUNDS, _QUICK_ROUNDS = 7, 2

logger = logging.getLogger("recon")


@dataclass(frozen=True)
class BenchRequest:
    """The options of `recon bench`.

    Raises:
        ConfigError: the size is not WIDTHxHEIGHT.
        ReconError: an output cannot be written.
    """

    scene: str = "room"  # or "small"
    gaussians: int | None = None  # instead of the scene's own number
    size: str | None = None  # "WxH" in pixels, instead of the scene's own
    sh_degree: int = 3
    backends: tuple[str, ...] = ()  # empty for all that run on the device
    device: str = "auto"
    threads: int | None = None  # None for all cores
    rounds: int | None = None  # behind each median; None for the usual number
    quick: bool = False  # a tiny scene and few rounds
    outputs: OutputFiles = field(default_factory=OutputFiles)
    compare: Path | None = None  # the figures of an earlier run

    def __post_init__(self) -> None:
        if self.size is not None:
            parse_size(self.size)
        self.outputs.check()

    def plan(self) -> BenchPlan:
        """Returns what is measured.

        Raises:
            BackendError: a backend or device is not there.
        """
        if self.backends:
            resolved = [registry.resolve(name, self.device) for name in self.backends]
            backends, device = tuple(dict.fromkeys(name for name, _ in resolved)), resolved[0][1]
        else:
            _, device = registry.resolve("torch", self.device)
            backends = tuple(
                status.name for status in registry.available_backends()
                if device in status.devices and not status.missing)
        size = QUICK if self.quick else SIZES[self.scene]
        if self.gaussians is not None:
            size = replace(size, gaussians=self.gaussians)
        if self.size is not None:
            width, height = parse_size(self.size)
            size = replace(size, width=width, height=height)
        rounds = self.rounds or (_QUICK_ROUNDS if self.quick else _ROUNDS)
        return BenchPlan(size, self.sh_degree, backends, device,
                         self.threads or machine.usable_threads(), rounds)

    def earlier_record(self, plan: BenchPlan) -> Mapping[str, Any] | None:
        """Returns the record to compare with, None where there is none.

        Raises:
            ReconError: the earlier run cannot be compared with.
        """
        if self.compare is None:
            return None
        old, size = read_record(self.compare), plan.size
        settings = {"gaussians": size.gaussians, "width": size.width, "height": size.height,
                    "sh_degree": plan.sh_degree}
        check_comparable(old, self.scene, settings, plan.threads)
        return old


def parse_size(size: str) -> tuple[int, int]:
    """Returns width and height of "640x360".

    Raises:
        ConfigError: the text has another form, or a side is shorter than a pixel.
    """
    match = re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", size)
    if not match:
        raise ConfigError(
            f"--size is {size!r}, but it must be WIDTHxHEIGHT in pixels.",
            hint="Try --size 640x360.")
    return int(match[1]), int(match[2])


def run(request: BenchRequest, progress: Progress) -> str:
    """Measures what was asked for, writes the files, and returns what the terminal shows.

    Raises:
        ReconError: something cannot be done; it is found before the measurement.
    """
    plan = request.plan()
    old = request.earlier_record(plan)
    host = examine(plan.threads, plan.device)
    warm = warm_start(plan.rounds) if "numba" in plan.backends else None
    result = BenchResult(host, plan.rounds, {request.scene: measure(plan, host, progress)}, warm)
    head, tables, record = bench_report.head(result), bench_report.tables(result), result.record()
    request.outputs.write(record, head, tables, lambda path: bench_report.draw(result, path))
    parts = [head, *(table.text() for table in tables)]
    if old is not None:
        parts.append(comparison_table(old, record).text())
        if difference := machine_difference(old, record):
            logger.warning("the other file is of another machine: %s", difference)
    return "\n\n".join(parts)
