"""From a request to tables and files: what has been run before is taken from the records."""

from __future__ import annotations

import importlib.util
import logging
from pathlib import Path

from recon_cli import atomic, lock
from recon_cli.bench.host import Host, examine
from recon_cli.bench.training.scenes import checked, opened
from recon_cli.bench.training.trial import stand
from recon_cli.errors import WorkspaceError
from recon_cli.execute import rendering
from recon_cli.progress import Progress
from recon_cli.stages.context import StageContext
from recon_cli.study import picture, report
from recon_cli.study.records import Records
from recon_cli.study.request import Request
from recon_cli.study.result import Result
from recon_cli.study.work import Ground, Work
from recon_cli.workspace import disk_errors

logger = logging.getLogger("recon")


def run(request: Request, progress: Progress) -> str:
    """Runs what is missing, writes the files, and returns what the terminal shows.

    Raises:
        ReconError: something cannot be done; what can be known is found before training.
    """
    paths = checked(request.scenes)
    _make_folder(request.out)
    with (disk_errors(request.out, "running study"),
          lock.held(request.out, "study", other="another folder with --out")):
        ctx = rendering(request.compute, progress)
        host = examine(ctx.threads, ctx.device)
        records = Records(request.out)
        grounds = [_ground(name, path, request, ctx) for name, path in paths.items()]
        work = Work(request, records, _machine(host))
        logger.warning("%s", work.announced(grounds, progress))
        scenes = {one.stand.name: work.done(one, progress) for one in grounds}
        result = Result(host, request.seeds, request.base, request.clock, scenes)
        _write(request.out, result)
    return report.text(result)


def _make_folder(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise WorkspaceError(
            f"The folder {out} cannot be made: {error.strerror}.",
            hint="Give another folder with --out.") from error


def _machine(host: Host) -> str:
    return f"{host.cpu}, {host.device}, {host.threads} threads"


def _ground(name: str, path: Path, request: Request, ctx: StageContext) -> Ground:
    place = opened(
        name, path, request.out / "scenes", request.settings, request.compute, ctx.progress)
    return Ground(stand(place, "test", request.base, ctx), place.digest)


def _write(out: Path, result: Result) -> None:
    atomic.write_json(out / "study.json", result.record())
    atomic.write_bytes(out / "study.md", report.markdown(result).encode())
    if importlib.util.find_spec("matplotlib") is None:
        logger.warning("no picture: matplotlib is missing; pip install 'recon-cli[plot]'")
        return
    picture.draw(result, out / "study.svg")
