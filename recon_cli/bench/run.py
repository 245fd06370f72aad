"""From a request to tables and files: checks everything, measures once, then writes."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from recon_cli import atomic, machine
from recon_cli.bench import page, picture, report
from recon_cli.bench.compare import check_comparable, compared, other_machine
from recon_cli.bench.host import examine
from recon_cli.bench.measure import Plan, measure
from recon_cli.bench.request import Request, pixels
from recon_cli.bench.result import Result, read_record
from recon_cli.bench.scenes import QUICK, SIZES
from recon_cli.bench.warm_start import warm_start
from recon_cli.progress import Progress
from recon_cli.render import registry

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
    parts = [report.head(result), *(table.text() for table in report.tables(result))]
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
        picture.check_picture(request.plot)
    if request.markdown is not None:
        page.check_page(request.markdown)
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
        picture.draw(result, request.plot)
    if request.markdown is not None:
        tables = [table.markdown() for table in report.tables(result)]
        page.write_page(request.markdown, "\n\n".join([report.head(result) + ".", *tables]))
