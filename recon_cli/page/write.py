"""Writes the page, whole or not at all, to where it harms nothing."""

from __future__ import annotations

from pathlib import Path

from recon_cli import atomic
from recon_cli.errors import ConfigError, WorkspaceError
from recon_cli.execute import Job, last_sources
from recon_cli.page.compose import compose
from recon_cli.report import megabytes
from recon_cli.workspace import disk_errors

FILE = "report.html"
_ENDINGS = (".html", ".htm")


def write(job: Job, out: Path | None) -> str:
    """Writes the page of a workspace and returns where it is, in words.

    Args:
        job: whose workspace it is; nothing in it is run or changed.
        out: the file; None is report.html in the workspace.

    Raises:
        StageError: nothing was read in yet.
        ConfigError: the file would lie where it changes a result or an input, or is no page.
        ManifestError: the manifest of ingest cannot be trusted.
        WorkspaceError: the file cannot be written.
    """
    path = (job.workspace.root / FILE if out is None else out).absolute()
    _check(job, path)
    with disk_errors(job.workspace.root, "reading the workspace"):
        page = compose(job)
    try:
        with disk_errors(path.parent, "writing the report"):
            path.parent.mkdir(parents=True, exist_ok=True)
            atomic.write_bytes(path, page)
    except OSError as error:
        raise WorkspaceError(
            f"{path} cannot be written: {error.strerror}.",
            hint="Give another file with -o.") from error
    return f"{path}: {megabytes(len(page))}"


def _check(job: Job, path: Path) -> None:
    """Refuses a file that is no page, or that a stage would take for its own or for an input."""
    if path.suffix.lower() not in _ENDINGS or path.is_dir():
        raise ConfigError(
            f"{path} is no name of a page.", hint="Give a file that ends in .html with -o.")
    root, real = job.workspace.root.resolve(), path.resolve()
    taken = [root / name for name in (".partial", ".old", *(row.name for row in job.table))]
    sources = [Path(source.path).resolve() for source in last_sources(job, "ingest")]
    for folder in taken:
        if real.is_relative_to(folder):
            raise ConfigError(
                f"{path} lies in the folder of a stage, whose files are checked one by one.",
                hint="Give a file elsewhere with -o.")
    for folder in sources:
        if real.is_relative_to(folder) and not real.is_relative_to(root):
            raise ConfigError(
                f"{path} lies in {folder}, which was read in: it would count as a new input.",
                hint="Give a file elsewhere with -o.")
