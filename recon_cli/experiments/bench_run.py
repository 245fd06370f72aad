"""From a request to tables and files: checks everything, measures once, then writes."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from recon_cli import machine
from recon_cli.errors import ConfigError, InputError
from recon_cli.experiments import bench_compare, bench_plot, bench_report
from recon_cli.experiments.bench_compare import check_comparable, compared, other_machine
from recon_cli.experiments.bench_measure import Plan, measure
from recon_cli.experiments.bench_result import Result, read_record
from recon_cli.experiments.host import examine, warm_start
from recon_cli.experiments.synthetic_room import QUICK, SIZES
from recon_cli.progress import Progress
from recon_cli.render import registry
from recon_cli.workspace import atomic

_ROUNDS, _QUICK_ROUNDS = 7, 2


@dataclass(frozen=True)
class Request:
    """The options of the verb.

    Attributes:
        scene: "room" or "small".
        gaussians: instead of the scene's own number.
        size: "WxH" in pixels, instead of the scene's own.
        sh_degree: 0 to 3.
        backends: by name; empty for all that run on the device.
        device: "auto", "cpu" or "cuda".
        threads: CPU threads; None for all cores.
        rounds: behind each median; None for the usual number.
        quick: a tiny scene and few rounds.
        json_file: where all figures go.
        plot: where the picture goes.
        markdown: the page that the tables go into.
        compare: the figures of an earlier run.

    Raises:
        ConfigError: the size is none.
        InputError: the folder of an output does not exist.
    """

    scene: str
    gaussians: int | None
    size: str | None
    sh_degree: int
    backends: tuple[str, ...]
    device: str
    threads: int | None
    rounds: int | None
    quick: bool
    json_file: Path | None = None
    plot: Path | None = None
    markdown: Path | None = None
    compare: Path | None = None

    def __post_init__(self) -> None:
        if self.size is not None:
            pixels(self.size)
        refuse_missing_folders(self.json_file, self.plot)

    @property
    def count(self) -> int:
        """Rounds behind each median."""
        return self.rounds or (_QUICK_ROUNDS if self.quick else _ROUNDS)


def refuse_missing_folders(*files: Path | None) -> None:
    """Raises InputError where the folder of a file to write does not exist."""
    for path in files:
        if path is not None and not path.absolute().parent.is_dir():
            raise InputError(
                f"The folder of {path} does not exist.", hint=f"mkdir -p {path.parent}")


def pixels(size: str) -> tuple[int, int]:
    """Returns width and height of "640x360".

    Raises:
        ConfigError: the text has another form, or a side is shorter than a pixel.
    """
    found = re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", size)
    if not found:
        raise ConfigError(
            f"--size is {size!r}, but it must be WIDTHxHEIGHT in pixels.",
            hint="Try --size 640x360.")
    return int(found[1]), int(found[2])


logger = logging.getLogger("recon")


def run(request: Request, progress: Progress) -> str:
    """Measures what was asked for, writes the files, and returns what the terminal shows.

    Raises:
        ReconError: something cannot be done; it is found before the measurement.
    """
    plan = plan_of(request)
    old = check(request, plan)
    host = examine(plan.threads, plan.device)
    warm = warm_start(plan.rounds) if "numba" in plan.backends else None
    result = Result(host, plan.rounds, {request.scene: measure(plan, host, progress)}, warm)
    _write(request, result)
    parts = [bench_report.head(result), *(table.text() for table in bench_report.tables(result))]
    if old is not None:
        record = result.record()
        parts.append(compared(old, record).text())
        if difference := other_machine(old, record):
            logger.warning("the other file is of another machine: %s", difference)
    return "\n\n".join(parts)


def plan_of(request: Request) -> Plan:
    """Returns what is measured.

    Raises:
        BackendError: a backend or device is not there.
    """
    if request.backends:
        found = [registry.resolve(name, request.device) for name in request.backends]
        backends, device = tuple(dict.fromkeys(name for name, _ in found)), found[0][1]
    else:
        _, device = registry.resolve("torch", request.device)
        backends = tuple(
            status.name for status in registry.available_backends()
            if device in status.devices and not status.missing)
    size = QUICK if request.quick else SIZES[request.scene]
    if request.gaussians is not None:
        size = replace(size, gaussians=request.gaussians)
    if request.size is not None:
        width, height = pixels(request.size)
        size = replace(size, width=width, height=height)
    threads = request.threads or machine.usable_threads()
    return Plan(size, request.sh_degree, backends, device, threads, request.count)


def check(request: Request, plan: Plan) -> Mapping[str, Any] | None:
    """Returns the record to compare with, if any, once all outputs are known to be possible.

    Raises:
        ReconError: an output cannot be written, or the earlier run cannot be compared with.
    """
    if request.plot is not None:
        bench_plot.check_picture(request.plot)
    if request.markdown is not None:
        bench_compare.check_page(request.markdown)
    if request.compare is None:
        return None
    old = read_record(request.compare)
    settings = {"gaussians": plan.size.gaussians, "width": plan.size.width,
                "height": plan.size.height, "sh_degree": plan.sh_degree}
    check_comparable(old, request.scene, settings, plan.threads)
    return old


def _write(request: Request, result: Result) -> None:
    if request.json_file is not None:
        atomic.write_json(request.json_file, result.record())
    if request.plot is not None:
        bench_plot.draw(result, request.plot)
    if request.markdown is not None:
        tables = [table.markdown() for table in bench_report.tables(result)]
        bench_compare.write_page(
            request.markdown, "\n\n".join([bench_report.head(result) + ".", *tables]))
